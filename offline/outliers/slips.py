"""Slips: short motions that the wheels do not explain, since the robot slipped, was pushed, or hit something.

They are searched in drives whose noise was fitted. A fitted variance models errors along the whole drive, but not a
single turn of 25 degrees in a second. Such a turn distorts the map on both sides and makes tags seem to move. A motion
between two observations is freed if that lowers the cost significantly; only tags then determine it. The test is
chi-square with the three degrees of freedom of a motion, Bonferroni-corrected for all motions of the drive. The motion
with the largest residual is tested first. A robot that slips or is pushed moves no faster than a person walks. A larger
jump would lower the cost of a map in a wrong local minimum as well, and is no slip.
"""

from dataclasses import replace
from math import degrees, hypot
from typing import Final, NamedTuple

import numpy as np
from scipy.special import chdtri

from groundsbot.calib.foundation import FloatArray, IntArray, plural
from groundsbot.offline.local_map import LocalMap
from groundsbot.offline.measurements import Segment, informative_keyframes
from groundsbot.offline.outliers.grown_segments import COST_TOLERANCE, FALSE_ALARM
from groundsbot.offline.outliers.odometry_breaks import at_keyframes, unexplained_motion
from groundsbot.offline.sam import State, build_graph, solve, whitening

# Squared residual of a motion below which it is not tested; 1 % exceed it by chance.
_LEAST_TESTED: Final = float(chdtri(3, 1e-2))
_MOST_TRIES: Final = 40
# Variance of each component of a freed motion, in m^2 and rad^2: almost no information.
_FREED: Final = 1.0
_MOST_NAMED: Final = 3
# Largest translation of a slip: this far, and this much more in each second that it lasts.
_LONGEST_M: Final = 1.0
_FASTEST_M_S: Final = 1.5


class Slip(NamedTuple):
    """A motion between two observations that the wheels do not explain.

    Attributes:
        first, end: the keyframes before and after it.
        jump: (3,) pose at keyframe `end` (m, m, rad) in the frame of the pose that the wheels predict.
        chi_square: decrease of the cost, in squared sigmas, if the motion is freed.
    """

    first: int
    end: int
    jump: FloatArray
    chi_square: float


def without_slips(local_map: LocalMap) -> tuple[LocalMap, list[Slip]]:
    """Free the slips of a map; return the map and its slips in order of time.

    Args:
        local_map: solved under the noise that was fitted to its drive.
    """
    keyframes = informative_keyframes(local_map.segment)
    found = _find_slips(at_keyframes(local_map, keyframes))
    if not found:
        return local_map, []
    motions = keyframes[np.array([motion for motion, _ in found])]
    graph = build_graph([_free_motions(local_map.segment, motions)])
    solution = solve(graph.problem, local_map.solution.state, local_map.cost_tolerance)
    slips = [
        Slip(first, end, unexplained_motion(local_map.graph, solution.state, first + 1, end), gain)
        for (first, end), (_, gain) in zip(motions.tolist(), found, strict=True)
    ]
    freed_map = replace(local_map, segment=graph.segments[0], graph=graph, solution=solution)
    return freed_map, sorted(slips, key=lambda each: each.first)


def _find_slips(local_map: LocalMap) -> list[tuple[tuple[int, int], float]]:
    """Return the slips of a map: the keyframes before and after each, and its chi-square."""
    motions = _motions_between_observations(local_map)
    if len(motions) < 2:
        return []
    bound = float(chdtri(3, FALSE_ALARM / len(motions)))
    found: dict[int, float] = {}
    tried: set[int] = set()
    problem, solution = local_map.graph.problem, local_map.solution
    for _ in range(_MOST_TRIES):
        squares = (problem.odometry.residual(solution.state) ** 2).sum(axis=1)
        of_motion = np.diff(np.append(0.0, np.cumsum(squares))[motions])[:, 0]
        of_motion[list(tried)] = 0.0
        worst = int(np.argmax(of_motion))
        if of_motion[worst] < _LEAST_TESTED:
            break
        tried.add(worst)
        segment = _free_motions(local_map.segment, motions[[*found, worst]])
        freed = local_map.graph.problem.reweigh(whitening(segment.odometry.covariance), problem.observations.whitening)
        other = solve(freed, solution.state, COST_TOLERANCE)
        gain = 2.0 * (solution.cost - other.cost)
        if gain > bound and _is_possible(local_map, other.state, *motions[worst].tolist()):
            found[worst] = gain
            problem, solution = freed, other
    return [((int(motions[i, 0]), int(motions[i, 1])), gain) for i, gain in found.items()]


def _is_possible(local_map: LocalMap, state: State, first: int, end: int) -> bool:
    """Return whether a robot can slip or be pushed as far as a state has it between two keyframes."""
    stamps_ns = local_map.segment.stamps_ns
    jump = unexplained_motion(local_map.graph, state, first + 1, end)
    return hypot(*jump[:2]) < _LONGEST_M + _FASTEST_M_S * float(stamps_ns[end] - stamps_ns[first]) * 1e-9


def slip_warning(local_map: LocalMap, slips: list[Slip]) -> str:
    """Return the warning about the slips of a drive, with the times and sizes of the most significant ones."""
    seconds = (local_map.segment.stamps_ns - local_map.segment.stamps_ns[0]) * 1e-9
    worst = sorted(sorted(slips, key=lambda each: -each.chi_square)[:_MOST_NAMED], key=lambda each: each.first)
    places = ", ".join(
        f"{seconds[each.first]:.1f} s to {seconds[each.end]:.1f} s by {hypot(*each.jump[:2]):.2f} m and "
        f"{round(degrees(each.jump[2]))} deg"
        for each in worst
    )
    most = ", most significantly from " if len(slips) > _MOST_NAMED else ": from "
    return (
        f"{local_map.segment.name}: in {plural(len(slips), 'place')} the robot moved in a way that its wheels do not "
        f"explain{most}{places} (times since its start). Only tags determine these motions; if it was not lifted or "
        "pushed, check its wheels for slip"
    )


def _motions_between_observations(local_map: LocalMap) -> IntArray:
    """Return the first and the last keyframe (N, 2) of each motion between consecutive keyframes with observations."""
    observation = np.unique(local_map.graph.problem.observations.pose)
    return np.stack([observation[:-1], observation[1:]], axis=-1)


def _free_motions(segment: Segment, motions: IntArray) -> Segment:
    """Return the segment with the variance of a freed motion added to some motions (N, 2)."""
    covariance = segment.odometry.covariance.copy()
    for first, end in motions.tolist():
        covariance[first:end] += _FREED * np.eye(3)
    return replace(segment, odometry=replace(segment.odometry, covariance=covariance))
