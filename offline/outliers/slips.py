"""Motions that the wheels of a drive do not explain: it slipped, was pushed, or ran into something.

For drives whose noise was fitted. A fitted variance covers what wheels err by all the way, not one turn of 25 degrees
in a second, which bends the map on either side of it and makes tags seem to move. A motion between two observations is
freed, so that only tags say where the drive goes on, if that lowers the cost by more than chance explains: chi-square
with the three degrees of freedom of a motion, all motions of the drive counted (Bonferroni), the most strained first.
"""

from dataclasses import replace
from math import degrees, hypot
from typing import Final, NamedTuple

import numpy as np
from scipy.stats import chi2

from groundsbot.calib.foundation import FloatArray, IntArray, plural
from groundsbot.offline.local_map import LocalMap
from groundsbot.offline.measurements import Segment
from groundsbot.offline.outliers.grown_segments import FALSE_ALARM
from groundsbot.offline.outliers.odometry_breaks import unexplained_motion
from groundsbot.offline.sam import build_graph, solve

# Motions that are no more strained than one in a hundred is by chance are not tried.
_STRAINED: Final = float(chi2.isf(1e-2, 3))
_MOST_TRIES: Final = 40
# Variance of each component of a freed motion, m^2 and rad^2: next to nothing is known of it.
_FREED: Final = 1.0
_MOST_NAMED: Final = 3


class Slip(NamedTuple):
    """A motion between two observations that the wheels do not explain.

    Attributes:
        first, end: the keyframes before and after it.
        jump: (3,) m and rad, by how much the robot moved besides what the wheels say, seen from `first`.
        chi_square: by how much more it costs to believe the wheels.
    """

    first: int
    end: int
    jump: FloatArray
    chi_square: float


def without_slips(local_map: LocalMap) -> tuple[LocalMap, list[Slip]]:
    """The map with its slips freed, and these in order of time.

    Args:
        local_map: solved under the noise that was fitted to its drive.
    """
    motions = _motions_between_observations(local_map)
    if len(motions) < 2:
        return local_map, []
    bound = float(chi2.isf(FALSE_ALARM / len(motions), 3))
    found: dict[int, float] = {}
    tried: set[int] = set()
    graph, solution = local_map.graph, local_map.solution
    for _ in range(_MOST_TRIES):
        squares = (graph.problem.odometry.residual(solution.state) ** 2).sum(axis=1)
        strain = np.array([squares[first:end].sum() for first, end in motions])
        strain[list(tried)] = 0.0
        worst = int(np.argmax(strain))
        if strain[worst] < _STRAINED:
            break
        tried.add(worst)
        freed = build_graph([_free_motions(local_map.segment, motions[[*found, worst]])])
        other = solve(freed.problem, solution.state)
        gain = 2.0 * (solution.cost - other.cost)
        if gain > bound:
            found[worst] = gain
            graph, solution = freed, other
    if not found:
        return local_map, []
    slips = [
        Slip(first, end, unexplained_motion(local_map.graph, solution.state, first + 1, end), found[i])
        for i, (first, end) in zip(found, motions[list(found)].tolist(), strict=True)
    ]
    freed_map = replace(local_map, segment=graph.segments[0], graph=graph, solution=solution)
    return freed_map, sorted(slips, key=lambda each: each.first)


def sentence(local_map: LocalMap, slips: list[Slip]) -> str:
    """One sentence about the slips of a drive, the largest ones named."""
    seconds = (local_map.segment.stamps_ns - local_map.segment.stamps_ns[0]) * 1e-9
    worst = sorted(sorted(slips, key=lambda each: -each.chi_square)[:_MOST_NAMED], key=lambda each: each.first)
    places = ", ".join(
        f"{seconds[each.first]:.1f} to {seconds[each.end]:.1f} s by {hypot(*each.jump[:2]):.2f} m and "
        f"{round(degrees(each.jump[2]))} deg"
        for each in worst
    )
    most = ", the largest at " if len(slips) > _MOST_NAMED else ": "
    return (
        f"{local_map.segment.name}: in {plural(len(slips), 'place')} the robot moved as its wheels do not explain{most}"
        f"{places}; slipped, pushed or lifted? There only tags say where the drive goes on"
    )


def _motions_between_observations(local_map: LocalMap) -> IntArray:
    """(N, 2) first and last keyframe of each motion from one keyframe with observations to the next."""
    observation = np.unique(local_map.graph.problem.observations.pose)
    return np.stack([observation[:-1], observation[1:]], axis=-1)


def _free_motions(segment: Segment, motions: IntArray) -> Segment:
    covariance = segment.odometry.covariance.copy()
    for first, end in motions.tolist():
        covariance[first:end] += _FREED * np.eye(3)
    return replace(segment, odometry=replace(segment.odometry, covariance=covariance))
