"""Start values for robots whose file leaves the time offset or the track open, such as those of imported recordings.

The wide sigmas of the file stay: the map estimates both with everything else.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from groundsbot.calib.robot import TIME_OFFSET, NoiseParameters, Robot, split_camera_parameter
from groundsbot.offline.foundation import Stages, Workers
from groundsbot.offline.local_map import InitialValues
from groundsbot.offline.maps import CalibrationChoice, MapResult
from groundsbot.offline.measurements import Run
from groundsbot.offline.self_calibration.robot import TRACK_SCALE, Correction, OwnedParameter, names_of_cameras
from groundsbot.offline.self_calibration.start_values import StartValues, estimate_start_values, with_start_values
from groundsbot.offline.self_calibration.time_offset_search import TimeOffsetSearch


class StartedRobots(NamedTuple):
    """Runs with start values in their robots' files, these corrections, searches of time offsets, initial values."""

    runs: list[Run]
    choices: tuple[CalibrationChoice, ...]
    searches: dict[OwnedParameter, TimeOffsetSearch]
    starts: dict[str, InitialValues]


def group_by_robot(runs: Sequence[Run]) -> list[list[int]]:
    """Return indices of runs, grouped by robot file."""
    groups: dict[tuple[str, str], list[int]] = {}
    for i, run in enumerate(runs):
        groups.setdefault((run.robot_id, run.robot.model_dump_json()), []).append(i)
    return list(groups.values())


def initialise_open_robots(
    runs: Sequence[Run],
    noise: NoiseParameters,
    stages: Stages,
    workers: Workers,
    extending: MapResult | None = None,
) -> StartedRobots:
    """Estimate start values robot by robot; robots whose file leaves nothing open are not changed.

    Runs share parameters only if their robots' files are equal, so a robot of the map that is extended keeps that
    map's start values.

    Args:
        runs: runs of any robots.
        noise: initial noise of wheels and tag observations.
        stages: notified of progress, and records times.
        workers: worker processes among which the robots are divided.
        extending: a map whose runs are solved again with these.
    """
    found = [_as_in_map(run, extending) if extending is not None else run for run in runs]
    known = {run.robot_id for run, own in zip(runs, found, strict=True) if own is not run}
    new = {run.robot_id for run, own in zip(runs, found, strict=True) if own is run}
    choices = [each for each in extending.choices if each.owner in known - new] if extending is not None else []
    searches: dict[OwnedParameter, TimeOffsetSearch] = {}
    initial: dict[str, InitialValues] = {}
    groups = [own for own in group_by_robot(runs) if runs[own[0]].robot.is_left_open and found[own[0]] is runs[own[0]]]
    items = [([runs[i] for i in own], noise) for own in groups]
    starts = workers.map(_estimate, items, [runs[own[0]].robot_id for own in groups], stages, "start values of robots")
    for own, start in zip(groups, starts, strict=True):
        robot = runs[own[0]].robot
        initial |= start.of_segments
        searches |= {OwnedParameter(robot.robot_id, name): each for name, each in start.searches.items()}
        for i in own:
            found[i] = with_start_values(runs[i], start.corrections)
        choices += [_choice(robot, name, each) for name, each in start.corrections.items() if each.value]
    return StartedRobots(found, tuple(choices), searches, initial)


def _as_in_map(run: Run, extending: MapResult) -> Run:
    """Return the run with the start values of the map if its robot, so corrected, is one of the map; else the run."""
    if not run.robot.is_left_open:
        return run
    learnt = dict.fromkeys((*names_of_cameras(run.robot, TIME_OFFSET), TRACK_SCALE), Correction(0.0, 0.0))
    learnt |= {
        each.name: Correction(each.value, each.sigma)
        for each in extending.choices
        if each.owner == run.robot_id and each.is_freed and each.name in learnt
    }
    changed = with_start_values(run, learnt)
    files = {each.robot_json for each in extending.archived_segments}
    return changed if changed.robot.model_dump_json() in files else run


def _estimate(item: tuple[list[Run], NoiseParameters], _stages: Stages) -> StartValues:
    """Return the start values of one robot."""
    return estimate_start_values(*item)


def _choice(robot: Robot, name: str, learnt: Correction) -> CalibrationChoice:
    parameter, camera = split_camera_parameter(name)
    sigmas = {
        TIME_OFFSET: robot.with_camera(camera or robot.camera_names[0]).time_offset_s_sigma,
        TRACK_SCALE: robot.wheels.track_m_sigma / robot.wheels.track_m,
    }
    return CalibrationChoice(
        owner=robot.robot_id,
        name=name,
        is_freed=True,
        value=learnt.value,
        sigma=learnt.sigma,
        prior_sigma=sigmas[parameter],
        off_sigmas=abs(learnt.value) / float(np.hypot(learnt.sigma, sigmas[parameter])),
        held_out_gain=None,
        reason="",
    )
