"""Calibration of robots and tags by their own drives, where these are more certain than robot.yaml."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from groundsbot.calib.camera import CameraModel
from groundsbot.calib.robot import (
    FOCAL_SCALE,
    IMPORTED_BATCH,
    MOUNT_PARAMETERS,
    RANGE_OFFSET,
    TAG_SCALE,
    TIME_OFFSET,
    NoiseParameters,
    camera_parameter,
    split_camera_parameter,
    without_camera,
)
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.foundation import Stages, Workers
from groundsbot.offline.local_map import InitialValues, solve_local_map
from groundsbot.offline.maps import CalibrationChoice, CalibrationResult
from groundsbot.offline.measurements import Run, segments_of, without_unconfirmed_tracks
from groundsbot.offline.sam import budgets_of
from groundsbot.offline.self_calibration.information import RobotInformation, robot_information, stack_information
from groundsbot.offline.self_calibration.left_open import group_by_robot
from groundsbot.offline.self_calibration.robot import (
    TRACK_SCALE,
    Correction,
    OwnedParameter,
    correct_robot,
    freed_sigma,
    names_of_cameras,
    open_parameters,
    with_unknown_calibration,
)
from groundsbot.offline.self_calibration.selection import DISTRUSTED_NAMES, choose, is_overruled
from groundsbot.offline.self_calibration.start_values import StartValues, estimate_start_values, with_start_values
from groundsbot.offline.self_calibration.time_offset_search import TimeOffsetSearch

# Corrected before the map is made, which estimates them to first order or, on the floor, not at all. Wheel readings are
# in metres and stamps on one clock by then; both remain estimated to first order.
_SCALES: Final = frozenset({"track_scale", TAG_SCALE, FOCAL_SCALE})
N_MAPPINGS: Final = 2  # how often runs are mapped when self-calibration precedes their map
# What sections of a grossly wrong robot still estimate; time offset and track are start values.
_ESTIMATED_BY_SECTIONS: Final = DISTRUSTED_NAMES - {TIME_OFFSET, TRACK_SCALE}
_ADDED: Final = frozenset({*MOUNT_PARAMETERS, "mount_roll_rad", "mount_pitch_rad", TIME_OFFSET, RANGE_OFFSET})


_NOTHING: Final = Correction(0.0, 0.0)


# Sections of drives lose little of their say on a number whose prior is this many times as wide as their estimate.
_EMPIRICAL_SIGMAS: Final = 3.0


class FreedRobots(NamedTuple):
    """Result of self-calibration.

    Attributes:
        runs: runs with wide sigmas for freed parameters in their files.
        choices: which parameters were freed, and why the others were not.
        applied: corrections already applied to the runs' files.
        searches: searches of time offsets.
        sigmas: prior sigmas of the freed parameters of robots whose files are complete.
        starts: initial values of segments of robots whose files leave parameters open.
    """

    runs: list[Run]
    choices: tuple[CalibrationChoice, ...]
    applied: dict[OwnedParameter, Correction]
    searches: dict[OwnedParameter, TimeOffsetSearch]
    sigmas: dict[OwnedParameter, float]
    starts: dict[str, InitialValues]


def free_parameters(
    runs: Sequence[Run],
    noise: NoiseParameters,
    names: Collection[str],
    stages: Stages,
    workers: Workers,
    *,
    corners: bool,
) -> FreedRobots:
    """Free the parameters that the drives observe and robot.yaml has wrong.

    Each robot is first solved with wide sigmas. The information of sections of its drives is a quadratic form about
    these estimates, against which the numbers of robot.yaml are tested one by one (`selection`). Robots whose file
    leaves them open are estimated in the map as they are.

    Args:
        runs: runs with the numbers of robot.yaml.
        noise: noise of wheels and tag observations, or its initial value.
        names: parameters to free whether or not they contradict robot.yaml, for all cameras of a robot where no camera
            is named; if empty, those that do.
        stages: notified of progress, and records times.
        workers: worker processes among which the robots are divided.
        corners: the map will be refined on corners, which also observe the focal length.
    """
    _check_cameras(runs, names)
    groups = [[runs[i] for i in own] for own in group_by_robot(runs) if not runs[own[0]].robot.is_left_open]
    if not groups:
        return FreedRobots(list(runs), (), {}, {}, {}, {})
    robots = [own[0].robot_id for own in groups]
    items = [_RobotDrives(own, noise, corners) for own in groups]
    found = workers.map(_information_of_robot, items, robots, stages, "self-calibration")
    information = stack_information([each.information for each in found])
    starts = {
        OwnedParameter(robot, name): correction
        for robot, each in zip(robots, found, strict=True)
        for name, correction in each.start.corrections.items()
    }
    searches = {
        OwnedParameter(robot, name): search
        for robot, each in zip(robots, found, strict=True)
        for name, search in each.start.searches.items()
    }
    late_s = {owned: each.offset_s for owned, each in searches.items()}
    choices = choose(information.relative_to({owned: each.value for owned, each in starts.items()}), names, late_s)
    freed = {OwnedParameter(each.owner, each.name): freed_sigma(each.name) for each in choices if each.is_freed}
    right = applied_corrections(choices)
    if is_overruled(choices):
        freed |= {
            OwnedParameter(each.owner, each.name): empirical_sigma(each)
            for each in choices
            if each.is_freed and without_camera(each.name) in _ESTIMATED_BY_SECTIONS
        }
        # Sections of a grossly wrong robot may be in different minima; the solve of all runs then estimates these
        # numbers.
        right = {
            owned: each for owned, each in right.items() if without_camera(owned.name) not in DISTRUSTED_NAMES
        } | starts
    return FreedRobots([_free(run, right, freed) for run in runs], tuple(choices), right, searches, freed, {})


def _check_cameras(runs: Sequence[Run], names: Collection[str]) -> None:
    """Refuse to free parameters of a camera that no robot has.

    Raises:
        OfflineError: naming the parameter.
    """
    known = dict.fromkeys(camera for run in runs for camera in run.robot.cameras)
    for name in names:
        camera = split_camera_parameter(name)[1]
        if camera and camera not in known:
            raise OfflineError(
                f"--calibrate: {name}: no robot of these drives has a camera {camera!r}; their cameras by name are "
                f"{', '.join(known) or 'none'}"
            )


def free_as_before(runs: Sequence[Run], before: FreedRobots) -> FreedRobots:
    """Return runs with the start values and freed parameters that earlier parts of the same drives have."""
    found = []
    for run in runs:
        own = {each.name: each for each in before.choices if each.owner == run.robot_id and each.is_freed}
        starts = {
            name: Correction(own[name].value, own[name].sigma) if name in own else _NOTHING
            for name in (*names_of_cameras(run.robot, TIME_OFFSET), TRACK_SCALE)
        }
        is_open = run.robot.is_left_open
        found.append(with_start_values(run, starts) if is_open else _free(run, before.applied, before.sigmas))
    return before._replace(runs=found)


def _free(run: Run, right: Mapping[OwnedParameter, Correction], sigmas: Mapping[OwnedParameter, float]) -> Run:
    """Return a run with corrections of its robot's file and wide sigmas, unless the file leaves its numbers open."""
    if run.robot.is_left_open:
        return run
    times = names_of_cameras(run.robot, TIME_OFFSET)
    late_s = [right.get(OwnedParameter(run.robot_id, name), _NOTHING).value for name in times]
    shifted = correct_focal_lengths(run, right).shift_stamps(*late_s)
    return replace(shifted, robot=open_parameters(correct_robot(run.robot, right), sigmas))


def empirical_sigma(choice: CalibrationChoice) -> float:
    """Return the prior sigma of a freed number about that of robot.yaml, as large as its error may be by the sections.

    With the width for any robot a number that robot.yaml has right may end metres off, in a wrong minimum (empirical
    Bayes: Efron and Morris, "Data analysis using Stein's estimator and its generalizations", 1975).
    """
    error = _EMPIRICAL_SIGMAS * float(np.hypot(choice.value, choice.sigma))
    return min(freed_sigma(choice.name), max(choice.prior_sigma, error))


class _RobotDrives(NamedTuple):
    """The drives of one robot, the initial noise, and whether corners in pixels are used."""

    runs: list[Run]
    noise: NoiseParameters
    corners: bool


class _StartAndInformation(NamedTuple):
    """Start values of one robot, and what its drives say of its calibration relative to these."""

    start: StartValues
    information: RobotInformation


def _information_of_robot(drives: _RobotDrives, _stages: Stages) -> _StartAndInformation:
    """Solve the drives of one robot alone with wide sigmas, from start values, and return their information."""
    robot, noise = drives.runs[0].robot, drives.noise
    # Refuses a log with more tags than its size allows before any of its sections is solved.
    budgets_of([segment for run in drives.runs for segment in segments_of(run, noise)], N_MAPPINGS)
    start = estimate_start_values([replace(run, robot=with_unknown_calibration(robot)) for run in drives.runs], noise)
    started = [with_start_values(run, start.corrections) for run in drives.runs]
    opened = [replace(run, robot=with_unknown_calibration(run.robot)) for run in started]
    segments = [without_unconfirmed_tracks(segment) for run in opened for segment in segments_of(run, noise)]
    budgets = budgets_of(segments, N_MAPPINGS)
    maps = [
        solve_local_map(segment, budget, noise_is_open=True).without_factorisation()
        for segment, budget in zip(segments, budgets, strict=True)
    ]
    information = robot_information(maps, started[0].robot, noise, budgets, corners=drives.corners)
    return _StartAndInformation(start, information)


def correct_focal_lengths(run: Run, learnt: Mapping[OwnedParameter, Correction]) -> Run:
    """Return the run with corrected focal lengths of its cameras; its robot's file stays."""

    def correct(model: CameraModel, camera: str) -> CameraModel:
        focal = learnt.get(OwnedParameter(run.robot_id, camera_parameter(FOCAL_SCALE, camera)))
        if focal is None:
            return model
        return replace(model, fx_px=model.fx_px * (1.0 + focal.value), fy_px=model.fy_px * (1.0 + focal.value))

    return replace(
        run,
        camera=None if run.camera is None else correct(run.camera, run.robot.camera_names[0]),
        named_cameras={name: correct(model, name) for name, model in run.named_cameras.items()},
    )


def relative_to_files(
    calibration: Sequence[CalibrationResult], put_in: Mapping[OwnedParameter, Correction]
) -> list[CalibrationResult]:
    """Return corrections relative to the files as they were given: those applied before plus the map's."""
    found = []
    for each in calibration:
        before = put_in.get(OwnedParameter(each.owner, each.name), _NOTHING).value
        found.append(replace(each, value=_compose(each.name, before, each.value)))
    return found


def applied_corrections(choices: Sequence[CalibrationChoice]) -> dict[OwnedParameter, Correction]:
    """Return the corrections applied to robots' files before the map; two of one parameter are composed."""
    right: dict[OwnedParameter, Correction] = {}
    for each in choices:
        if (
            each.is_freed
            and without_camera(each.name) in _SCALES | _ADDED
            and not each.owner.startswith(IMPORTED_BATCH)
        ):
            owned = OwnedParameter(each.owner, each.name)
            before = right.get(owned, _NOTHING).value
            right[owned] = Correction(_compose(each.name, before, each.value), each.sigma)
    return right


def _compose(name: str, before: float, after: float) -> float:
    """Return the composition of two corrections of one parameter: relative ones multiply, others add."""
    return before + after + (before * after if without_camera(name) in _SCALES else 0.0)
