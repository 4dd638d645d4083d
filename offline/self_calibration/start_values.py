"""Time offset and track of a robot of which both are unknown: before anything else, since the rest is to first order.

A camera that is half a second late, or wheels that turn the robot by half as much again as they say, would lead every
later stage astray. The time offset is searched for in passes of tags (`time_offset_search`); then each drive is solved
alone at few keyframes, with all that its file leaves open, and what enters the motions to first order only, the track
and the time offset, is put into the file, until it stays. The sigmas of the file stay as they are.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from groundsbot.calib.robot import TIME_OFFSET, NoiseParameters
from groundsbot.offline.local_map import WindowNoise, first_solution, noise_of_windows
from groundsbot.offline.measurements import Run, coarse_keyframes, coarsen, segments_of, without_unconfirmed_tracks
from groundsbot.offline.sam import Graph, Solution
from groundsbot.offline.self_calibration.robot import TRACK_SCALE, Correction
from groundsbot.offline.self_calibration.time_offset_search import TimeOffsetSearch, search_time_offset

_MOST_ROUNDS: Final = 4
# What is left to first order then errs by its square: a percent of the turn, a millimetre at a metre a second.
_SMALL: Final = {TRACK_SCALE: 0.03, TIME_OFFSET: 0.03}


class StartValues(NamedTuple):
    """Corrections to a robot's file by name, TRACK_SCALE and TIME_OFFSET, and the search that they began with."""

    learnt: dict[str, Correction]
    searched: TimeOffsetSearch | None


def estimate_start_values(runs: Sequence[Run], noise: NoiseParameters) -> StartValues:
    """Estimates both from the drives of one robot, whose file leaves them open.

    Args:
        runs: all with the same robot.yaml.
        noise: where the noise of wheels and readings begins.
    """
    searched = search_time_offset(runs)
    found = dict.fromkeys(_SMALL, Correction(0.0, 0.0))
    if searched is not None:
        found[TIME_OFFSET] = Correction(searched.offset_s, searched.sigma_s)
    shown: dict[str, WindowNoise] = {}
    for _ in range(_MOST_ROUNDS):
        more = _estimate([with_start_values(run, found) for run in runs], noise, shown)
        if all(abs(more[name].value) < small for name, small in _SMALL.items() if name in more):
            break
        found = {name: _together(name, each, more.get(name)) for name, each in found.items()}
    return StartValues(found, searched)


def with_start_values(run: Run, learnt: dict[str, Correction]) -> Run:
    """The run with time offset and track put into its robot's file, whose sigmas stay."""
    late_s, track = learnt[TIME_OFFSET].value, learnt[TRACK_SCALE].value
    robot = run.robot
    wheels = robot.wheels.model_copy(
        update={
            "track_m": robot.wheels.track_m * (1.0 + track),
            "track_m_sigma": robot.wheels.track_m_sigma * (1.0 + track),
        }
    )
    changed = robot.model_copy(update={"time_offset_s": robot.time_offset_s + late_s, "wheels": wheels})
    return replace(run.shift_stamps(late_s), robot=changed)


def _estimate(runs: Sequence[Run], noise: NoiseParameters, shown: dict[str, WindowNoise]) -> dict[str, Correction]:
    """Time offset and track by each drive alone, the mean by their information.

    Args:
        runs: of one robot.
        noise: where the noise begins.
        shown: by segment, what windows show of it; what is missing is added.
    """
    solved: list[tuple[Graph, Solution]] = []
    for run in runs:
        for segment in segments_of(run, noise):
            if segment.tags and len(segment.stamps_ns) > 1:
                likely = without_unconfirmed_tracks(segment)
                coarse = coarsen(likely, coarse_keyframes(likely))
                if segment.name not in shown:
                    shown[segment.name] = noise_of_windows(coarse)
                solved.append(first_solution(coarse, shown[segment.name]))
    found: dict[str, Correction] = {}
    for name in _SMALL:
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


def _together(name: str, before: Correction, more: Correction | None) -> Correction:
    """Two corrections, one after the other; a turn of c to first order is one of 1 / (1 - c) of the track."""
    if more is None:
        return before
    if name == TRACK_SCALE:
        turn = float(np.clip(1.0 - more.value, 0.3, 3.0))
        return Correction((1.0 + before.value) / turn - 1.0, more.sigma / turn**2)
    return Correction(before.value + more.value, more.sigma)
