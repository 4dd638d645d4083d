"""Start values of time offset and track, for robots of which both are unknown; everything later is to first order.

A camera that is half a second late, or a track wrong by half, would make every later stage fail. The time offset is
found by a search in passes of tags (`time_offset_search`). Then each drive is solved alone on few keyframes with
everything free that its file leaves open. Track and time offset enter the motions to first order only, so they are
applied to the file and solved again until they converge. The sigmas of the file stay. A time offset that the file has
as measured is replaced only where the search contradicts it.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np
from scipy.special import ndtri

from groundsbot.calib.robot import TIME_OFFSET, CameraFields, NoiseParameters, Robot, camera_parameter, without_camera
from groundsbot.offline.local_map import InitialValues, WindowNoise, first_solution, noise_of_windows
from groundsbot.offline.measurements import Run, coarse_keyframes, coarsen, segments_of, without_unconfirmed_tracks
from groundsbot.offline.sam import Graph, Solution
from groundsbot.offline.self_calibration.robot import TRACK_SCALE, Correction, names_of_cameras
from groundsbot.offline.self_calibration.time_offset_search import TimeOffsetSearch, search_time_offset

_MOST_ROUNDS: Final = 4
# Chance that a measured time offset that is right is replaced.
_FALSE_ALARM: Final = 1e-3
# The remaining second-order errors are the squares of these: a thousandth of the turn, a millimetre at 1 m/s.
_SMALL: Final = {TRACK_SCALE: 0.03, TIME_OFFSET: 0.03}


class StartValues(NamedTuple):
    """Start values of one robot.

    Attributes:
        corrections: to its file by name: TRACK_SCALE, and TIME_OFFSET of each camera.
        searches: searches by name of the time offset, without those that found none.
        of_segments: initial values of the drives' segments by name, from the last of these solves.
    """

    corrections: dict[str, Correction]
    searches: dict[str, TimeOffsetSearch]
    of_segments: dict[str, InitialValues]


def estimate_start_values(runs: Sequence[Run], noise: NoiseParameters) -> StartValues:
    """Estimate the time offset of each camera and the track from the drives of one robot, whose file leaves them open.

    Args:
        runs: all with the same robot.yaml.
        noise: initial noise of wheels and tag observations.
    """
    times, searches = names_of_cameras(runs[0].robot, TIME_OFFSET), {}
    found, unknown = dict.fromkeys((TRACK_SCALE, *times), Correction(0.0, 0.0)), [TRACK_SCALE]
    for camera, name in enumerate(times):
        of_camera = [run.with_camera(camera) for run in runs]
        searched = search_time_offset(of_camera)
        if searched is not None:
            searches[name] = searched
        if _is_unknown(of_camera[0].robot, searched):
            unknown.append(name)
            found[name] = Correction(0.0, 0.0) if searched is None else Correction(searched.offset_s, searched.sigma_s)
    shown: dict[str, WindowNoise] = {}
    starts: dict[str, InitialValues] = {}
    for _ in range(_MOST_ROUNDS):
        solved = _solve_alone([with_start_values(run, found) for run in runs], noise, shown, starts)
        starts = {graph.segments[0].name: InitialValues.of_solution(graph, each.state, 1) for graph, each in solved}
        more = _estimate(solved, unknown)
        if all(abs(each.value) < _SMALL[without_camera(name)] for name, each in more.items()):
            break
        found = {name: _compose(name, each, more.get(name)) for name, each in found.items()}
    return StartValues(found, searches, starts)


def _is_unknown(robot: Robot, searched: TimeOffsetSearch | None) -> bool:
    """Return whether the time offset of a robot with a single camera is open, or contradicted by the search."""
    if robot.is_clock_left_open or searched is None:
        return robot.is_clock_left_open
    sigma_s = float(np.hypot(searched.sigma_s, robot.time_offset_s_sigma))
    return abs(searched.offset_s) > float(-ndtri(_FALSE_ALARM / 2.0)) * sigma_s


def with_start_values(run: Run, learnt: dict[str, Correction]) -> Run:
    """Return the run with time offsets and track corrected in its robot's file; the sigmas stay."""
    robot, track = run.robot, learnt[TRACK_SCALE].value

    def of_camera(camera: str, fields: CameraFields) -> dict[str, object]:
        return {"time_offset_s": fields.time_offset_s + learnt[camera_parameter(TIME_OFFSET, camera)].value}

    wheels = robot.wheels.model_copy(
        update={
            "track_m": robot.wheels.track_m * (1.0 + track),
            "track_m_sigma": robot.wheels.track_m_sigma * (1.0 + track),
        }
    )
    changed = robot.update_cameras(of_camera).model_copy(update={"wheels": wheels})
    late_s = [learnt[name].value for name in names_of_cameras(robot, TIME_OFFSET)]
    return replace(run.shift_stamps(*late_s), robot=changed)


def _solve_alone(
    runs: Sequence[Run], noise: NoiseParameters, shown: dict[str, WindowNoise], starts: Mapping[str, InitialValues]
) -> list[tuple[Graph, Solution]]:
    """Solve each segment of the runs alone, at few of its keyframes.

    Args:
        runs: runs of one robot.
        noise: initial noise.
        shown: noise estimated from windows, by segment; missing ones are added.
        starts: initial values by segment, from robot files with other start values.
    """
    solved: list[tuple[Graph, Solution]] = []
    for run in runs:
        for segment in segments_of(run, noise):
            if segment.tags and len(segment.stamps_ns) > 1:
                likely = without_unconfirmed_tracks(segment)
                coarse = coarsen(likely, coarse_keyframes(likely))
                if segment.name not in shown:
                    shown[segment.name] = noise_of_windows(coarse)
                solved.append(first_solution(coarse, shown[segment.name], starts.get(segment.name)))
    return solved


def _estimate(solved: Sequence[tuple[Graph, Solution]], names: Iterable[str]) -> dict[str, Correction]:
    """Return the information-weighted mean of time offsets and track over drives that were solved alone.

    Args:
        solved: drives of one robot.
        names: names of time offsets and track. One that the drives do not have is missing in what is returned.
    """
    found: dict[str, Correction] = {}
    for name in names:
        values, informations = [], []
        for graph, solution in solved:
            for parameter, column, value in zip(
                graph.parameters,
                graph.problem.columns.calibration.tolist(),
                solution.state.calibration.tolist(),
                strict=True,
            ):
                if parameter.name == name and column >= 0:
                    values.append(value)
                    informations.append(1.0 / float(solution.covariance(np.array([column]))[0, 0]))
        if values:
            found[name] = Correction(
                float(np.average(values, weights=informations)), float(np.sum(informations) ** -0.5)
            )
    return found


def _compose(name: str, before: Correction, more: Correction | None) -> Correction:
    """Return the composition of two corrections; a turn of c is to first order a track scale of 1 / (1 - c)."""
    if more is None:
        return before
    if name == TRACK_SCALE:
        turn = float(np.clip(1.0 - more.value, 0.3, 3.0))
        return Correction((1.0 + before.value) / turn - 1.0, more.sigma / turn**2)
    return Correction(before.value + more.value, more.sigma)
