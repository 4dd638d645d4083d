"""Start values for robots whose file leaves the time offset or the track open, such as those of imported recordings.

The wide sigmas of the file stay: the map estimates both with everything else.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from groundsbot.calib.robot import TIME_OFFSET, NoiseParameters, Robot
from groundsbot.offline.foundation import Stages, Workers
from groundsbot.offline.maps import CalibrationChoice
from groundsbot.offline.measurements import Run
from groundsbot.offline.self_calibration.robot import TRACK_SCALE, Correction
from groundsbot.offline.self_calibration.start_values import StartValues, estimate_start_values, with_start_values
from groundsbot.offline.self_calibration.time_offset_search import TimeOffsetSearch


class StartedRobots(NamedTuple):
    """Runs with start values in their robots' files, these corrections, and the time offset searches by robot."""

    runs: list[Run]
    choices: tuple[CalibrationChoice, ...]
    searches: dict[str, TimeOffsetSearch]


def group_by_robot(runs: Sequence[Run]) -> list[list[int]]:
    """Return indices of runs, grouped by robot file."""
    groups: dict[tuple[str, str], list[int]] = {}
    for i, run in enumerate(runs):
        groups.setdefault((run.robot_id, run.robot.model_dump_json()), []).append(i)
    return list(groups.values())


def initialise_open_robots(
    runs: Sequence[Run], noise: NoiseParameters, stages: Stages, workers: Workers
) -> StartedRobots:
    """Estimate start values robot by robot; robots whose file leaves nothing open are not changed.

    Args:
        runs: of any robots.
        noise: initial noise of wheels and tag observations.
        stages: notified of progress, and records times.
        workers: worker processes among which the robots are divided.
    """
    found = list(runs)
    choices: list[CalibrationChoice] = []
    searches: dict[str, TimeOffsetSearch] = {}
    groups = [own for own in group_by_robot(runs) if runs[own[0]].robot.is_left_open]
    items = [([runs[i] for i in own], noise) for own in groups]
    starts = workers.map(_estimate, items, [runs[own[0]].robot_id for own in groups], stages, "start values of robots")
    for own, start in zip(groups, starts, strict=True):
        robot = runs[own[0]].robot
        if start.search is not None:
            searches[robot.robot_id] = start.search
        for i in own:
            found[i] = with_start_values(runs[i], start.corrections)
        choices += [_choice(robot, name, each) for name, each in start.corrections.items() if each.value]
    return StartedRobots(found, tuple(choices), searches)


def _estimate(item: tuple[list[Run], NoiseParameters], _stages: Stages) -> StartValues:
    """Return the start values of one robot."""
    return estimate_start_values(*item)


def _choice(robot: Robot, name: str, learnt: Correction) -> CalibrationChoice:
    sigmas = {
        TIME_OFFSET: robot.time_offset_s_sigma,
        TRACK_SCALE: robot.wheels.track_m_sigma / robot.wheels.track_m,
    }
    return CalibrationChoice(
        owner=robot.robot_id,
        name=name,
        is_freed=True,
        value=learnt.value,
        sigma=learnt.sigma,
        prior_sigma=sigmas[name],
        off_sigmas=abs(learnt.value) / float(np.hypot(learnt.sigma, sigmas[name])),
        held_out_gain=None,
        reason="",
    )
