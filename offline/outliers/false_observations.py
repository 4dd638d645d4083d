"""Observations of one tag that were taken for another: one or two at a time, metres from where their tag is.

A tag that was moved is read in several pictures from its new place; a misread code is in one picture or two. So a
observation far from the others of its pass, or a pass of one or two that lies beyond chance from its tag, which other
passes with more observations place, is no second tag.
"""

from dataclasses import replace
from typing import Final

import numpy as np
from scipy.stats import chi2

from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray
from groundsbot.offline.local_map import LocalMap
from groundsbot.offline.measurements import FEW_OBSERVATIONS, MOST_MISREAD, passes_of
from groundsbot.offline.outliers.search import FALSE_ALARM
from groundsbot.offline.sam import build_graph, solve

# A standard deviation is so many times the median of normal numbers' sizes.
_SIGMA_BY_MEDIAN: Final = 1.4826
# Observations scatter with heavy tails: a tenth of a percent of them lies beyond 13 of a Student distribution of 3
# degrees.
_FAR_SIGMAS: Final = 13.0
_LEAST_FAR_M: Final = 0.5  # a drive that stands for long scatters by next to nothing


def false_observations(local_map: LocalMap) -> BoolArray:
    """(M,) observations of the map's segment that are of another tag, or of none.

    Args:
        local_map: solved under noise that its observations fit.
    """
    if not len(local_map.segment.observations):
        return np.zeros(0, dtype=np.bool_)
    return _far_within_pass(local_map) | _far_passes(local_map)


def _far_within_pass(local_map: LocalMap) -> BoolArray:
    """Return (M,) whether an observation places its tag far from its pass, by the scatter of this drive's passes."""
    pass_of = passes_of(local_map.segment)
    places = local_map.graph.problem.observations.places_in_map(local_map.solution.state)
    middle = np.column_stack([_medians(places[:, axis], pass_of) for axis in (0, 1)])
    off_m = np.linalg.norm(places - middle[pass_of], axis=1)
    several = np.bincount(pass_of)[pass_of] > FEW_OBSERVATIONS
    if not several.any():
        return several
    bound_m = max(_FAR_SIGMAS * _SIGMA_BY_MEDIAN * float(np.median(off_m[several])), _LEAST_FAR_M)
    return np.asarray(several & (off_m > bound_m))


def _far_passes(local_map: LocalMap) -> BoolArray:
    """(M,) observations of passes of one or two that lie elsewhere than passes of more place their tag."""
    observations, pass_of = local_map.segment.observations, passes_of(local_map.segment)
    n_in_pass = np.bincount(pass_of)
    squares = (local_map.graph.problem.observations.residual(local_map.solution.state) ** 2).sum(axis=1)
    is_few = n_in_pass <= FEW_OBSERVATIONS
    least = np.full(len(n_in_pass), np.inf)
    np.minimum.at(least, pass_of, squares)
    tag_of = np.zeros(len(n_in_pass), dtype=np.int64)
    tag_of[pass_of] = observations.tag
    is_placed = np.zeros(len(local_map.segment.tags), dtype=np.bool_)
    is_placed[tag_of[~is_few]] = True
    is_false = is_few & is_placed[tag_of] & (least > chi2.isf(FALSE_ALARM / max(int(is_few.sum()), 1), 2))
    # So many are the noise's, not misread.
    return np.asarray(is_false[pass_of] & (is_false[pass_of].mean() <= MOST_MISREAD))


def _medians(values: FloatArray, group: IntArray) -> FloatArray:
    """(G,) of values (M,) in groups (M,) numbered from 0 without gaps."""
    order = np.lexsort((values, group))
    n = np.bincount(group)
    first = np.cumsum(n) - n
    low, high = order[first + (n - 1) // 2], order[first + n // 2]
    return np.asarray(0.5 * (values[low] + values[high]))


def without_false_detections(local_map: LocalMap) -> LocalMap:
    """The map solved without them, but with all others; the segment's warnings say how many there were."""
    local_map = _with_all_observations(local_map)
    wrong = false_observations(local_map)
    n, n_all, name = int(wrong.sum()), len(wrong), local_map.segment.name
    told = f"{name}: {n} of {n_all} observations lie far from their tags, single ones: taken for misread, left out"
    segment = local_map.segment.with_observations(~wrong)
    if n:
        segment = replace(segment, warnings=(*segment.warnings, told))
    graph = build_graph([segment])
    start = graph.start(local_map.T_start_base, local_map.tags_m, local_map.calibration)
    solution = solve(graph.problem, start)
    graph.problem.arrowhead.without_scratch()
    return replace(local_map, segment=segment, graph=graph, solution=solution, n_misread=n)


def _with_all_observations(local_map: LocalMap) -> LocalMap:
    """The map, not solved again, with the observations that were left out of it because nothing confirmed them."""
    segment = local_map.unfiltered
    if segment is None:
        return local_map
    graph = build_graph([segment])
    state = graph.start(local_map.T_start_base, local_map.tags_m, local_map.calibration)
    solution = replace(local_map.solution, state=state, problem=graph.problem)
    return replace(local_map, segment=segment, graph=graph, solution=solution, unfiltered=None)
