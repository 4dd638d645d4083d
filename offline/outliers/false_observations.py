"""Removal of misread observations: one or two at a time, metres from the position of their tag.

A tag that was moved is observed in several pictures at its new position, a misread code only in one or two. So two
kinds of observations are misread: those far from the others of their track, and tracks of one or two observations that
lie significantly off another track of their tag.
"""

from dataclasses import replace
from typing import Final

import numpy as np
from scipy.special import chdtri

from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray
from groundsbot.offline.local_map import LocalMap
from groundsbot.offline.measurements import FEW_OBSERVATIONS, MOST_MISREAD, passes_of
from groundsbot.offline.outliers.search import FALSE_ALARM
from groundsbot.offline.sam import Solution, build_graph, solve, stack

# Ratio of the standard deviation to the median absolute deviation of normal numbers.
_SIGMA_BY_MEDIAN: Final = 1.4826
# Observations have heavy tails: 0.1 % of a Student distribution with 3 degrees of freedom lies beyond 13.
_FAR_SIGMAS: Final = 13.0
_LEAST_FAR_M: Final = 0.5  # the scatter of a robot that stands for long is near zero


def false_observations(local_map: LocalMap, solved_without: Solution | None = None) -> BoolArray:
    """Return whether each observation (M,) of the map's segment is of another tag, or of none.

    Args:
        local_map: solved under noise that its observations fit.
        solved_without: solution of the same variables without the unconfirmed tracks; None: they are in the map's.
    """
    if not len(local_map.segment.observations):
        return np.zeros(0, dtype=np.bool_)
    track_of = passes_of(local_map.segment)
    return _far_within_track(local_map, track_of) | _far_tracks(local_map, track_of, solved_without)


def _far_within_track(local_map: LocalMap, track_of: IntArray) -> BoolArray:
    """Return whether each observation (M,) lies far from its track (M,), by the scatter of this drive's tracks."""
    places = local_map.graph.problem.observations.places_in_map(local_map.solution.state)
    middle = np.column_stack([_medians(places[:, axis], track_of) for axis in (0, 1)])
    distance_m = np.linalg.norm(places - middle[track_of], axis=1)
    several = np.bincount(track_of)[track_of] > FEW_OBSERVATIONS
    if not several.any():
        return several
    bound_m = max(_FAR_SIGMAS * _SIGMA_BY_MEDIAN * float(np.median(distance_m[several])), _LEAST_FAR_M)
    return np.asarray(several & (distance_m > bound_m))


def _far_tracks(local_map: LocalMap, track_of: IntArray, solved_without: Solution | None) -> BoolArray:
    """Return whether each observation (M,) is of a track of one or two that contradicts another track of its tag.

    Of a tag without a longer track nothing says which one is right, so all of them are misread. The whole tag is lost
    then, so drift must not explain the contradiction either.
    """
    n_in_track = np.bincount(track_of)
    is_few = n_in_track <= FEW_OBSERVATIONS
    tag_of = np.zeros(len(n_in_track), dtype=np.int64)
    tag_of[track_of] = local_map.segment.observations.tag
    is_placed = _flags(tag_of[~is_few], len(local_map.segment.tags))
    squares = (local_map.graph.problem.observations.residual(local_map.solution.state) ** 2).sum(axis=1)
    bound = float(chdtri(2, FALSE_ALARM / max(int(is_few.sum()), 1)))
    if solved_without is not None:
        far = np.flatnonzero(~is_placed[tag_of[track_of]] & (squares > bound))
        squares[far] = _predicted_squares(local_map, far, solved_without)
    least = np.full(len(n_in_track), np.inf)
    np.minimum.at(least, track_of, squares)
    is_false = is_few & (least > bound)
    is_false |= (_flags(tag_of[is_false], len(is_placed)) & ~is_placed)[tag_of]
    # More than this share cannot be misread, so they are noise.
    return np.asarray(is_false[track_of] & (is_false[track_of].mean() <= MOST_MISREAD))


def _flags(numbers: IntArray, n: int) -> BoolArray:
    """Return (n,) whether each number from 0 to n - 1 is among some."""
    found = np.zeros(n, dtype=np.bool_)
    found[numbers] = True
    return found


def _predicted_squares(local_map: LocalMap, which: IntArray, solved_without: Solution) -> FloatArray:
    """Return squared residuals (K,) of observations in sigmas of their prediction by a solution without them.

    The prediction is as uncertain as pose, tag and calibration are: after a long way an observation may lie far off its
    tag by the drift of the wheels.
    """
    problem = local_map.graph.problem
    at = problem.observations.linearise(local_map.solution.state, problem.columns)
    jacobian, residual = stack((at,), problem.columns.n)
    squares = np.empty(len(which))
    for i, m in enumerate(which.tolist()):
        rows = jacobian[2 * m : 2 * m + 2].toarray()
        covariance = np.eye(2) + rows @ solved_without.factorisation.solve_many(rows.T)
        r = residual[2 * m : 2 * m + 2]
        squares[i] = r @ np.linalg.solve(covariance, r)
    return squares


def _medians(values: FloatArray, group: IntArray) -> FloatArray:
    """Return the median (G,) of values (M,) by group (M,), numbered from 0 without gaps."""
    order = np.lexsort((values, group))
    n = np.bincount(group)
    first = np.cumsum(n) - n
    low, high = order[first + (n - 1) // 2], order[first + n // 2]
    return np.asarray(0.5 * (values[low] + values[high]))


def without_false_detections(local_map: LocalMap) -> LocalMap:
    """Solve a map without its misread observations, but with those that were unconfirmed before.

    The number of removed observations is in the segment's warnings and in the map's `n_misread`.
    """
    solved_without = None if local_map.unfiltered is None else local_map.solution
    local_map = _with_all_observations(local_map)
    is_false = false_observations(local_map, solved_without)
    n = int(is_false.sum())
    segment = local_map.segment.with_observations(~is_false)
    if n:
        warning = (
            f"{segment.name}: {n} of {len(is_false)} observations are single ones far from their tags; they are taken "
            "for misread codes and left out"
        )
        segment = replace(segment, warnings=(*segment.warnings, warning))
    graph = build_graph([segment])
    start = graph.start(local_map.T_start_base, local_map.tags_m, local_map.calibration)
    solution = solve(graph.problem, start, local_map.cost_tolerance)
    graph.problem.arrowhead.without_scratch()
    return replace(local_map, segment=segment, graph=graph, solution=solution, n_misread=n)


def _with_all_observations(local_map: LocalMap) -> LocalMap:
    """Return the map with the observations that were left out as unconfirmed, without another solve."""
    segment = local_map.unfiltered
    if segment is None:
        return local_map
    graph = build_graph([segment])
    state = graph.start(local_map.T_start_base, local_map.tags_m, local_map.calibration)
    solution = replace(local_map.solution, state=state, problem=graph.problem)
    return replace(local_map, segment=segment, graph=graph, solution=solution, unfiltered=None)
