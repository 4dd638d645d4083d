"""Detection of breaks of odometry: motions that the wheels do not measure, as of a robot that is lifted or pushed.

The drive is solved incrementally from its beginning as far as its observations fit together, and likewise backwards
from its end. The break lies between these two parts. If they overlap, it is at the place without whose motion the whole
costs least. The drive is split there under three conditions. The cost must decrease significantly, given the number of
candidate places. Two tags or more, observed on both sides, must agree on the motion. A person must be able to move a
robot so far in that time.

This takes hundreds of solves. They are at the keyframes with observations and some between, since the others hold no
information on a break. They use what the solve of the drive left of its budget. If that does not suffice, the
drive is not split, and a warning is given.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import hypot
from typing import Final, NamedTuple

import numpy as np
from scipy.special import bdtrc, chdtri

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.calib.geometry import chain_motions, se2
from groundsbot.offline.alignment import Alignment, align, condense
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.local_map import LocalMap, solve_local_map
from groundsbot.offline.measurements import Segment, coarsen, informative_keyframes
from groundsbot.offline.outliers.grown_segments import (
    COST_TOLERANCE,
    FALSE_ALARM,
    SolvedPart,
    grow_parts,
    limit_of,
    noise_factor,
)
from groundsbot.offline.sam import Budget, Graph, Problem, Solution, State, build_graph, solve

_MOST_PLACES: Final = 24
# Places whose costs differ by less than this cannot be distinguished (half of chi-square, false alarm rate 1e-3).
_SAME_COST: Final = 0.5 * float(chdtri(3, 1e-3))
_IN_A_ROW_M: Final = 2.5
# Shares of the remaining budget: for the solve of one side of a place, and for the first of two parts.
_SHARE_OF_A_SOLVE: Final = 0.2
# Largest translation of a robot that is lifted or pushed: this far, and this much more in each second, as in running. A
# larger one would lower the cost of a map in a wrong local minimum as well, and is no break.
_LONGEST_M: Final = 1.0
_FASTEST_M_S: Final = 5.0
_FREED: Final = 1e-4  # factor of the whitening of a freed motion, which then costs almost nothing


@dataclass(frozen=True)
class Break:
    """A motion of a drive that its wheels do not measure.

    Attributes:
        end: index of the last keyframe before the break, plus one.
        begin: index of the first keyframe after the break.
        reach: indices of the first and the last keyframe of the interval in which a break explains the drive as well.
        jump: (3,) pose after it (m, m, rad) in the frame of the pose that the wheels predict.
        chi_square: decrease of the cost, in squared sigmas, if the motion is freed.
        bound: largest decrease that chance explains, at a false alarm rate of 1e-3 over all candidate places.
    """

    end: int
    begin: int
    reach: tuple[int, int]
    jump: FloatArray
    chi_square: float
    bound: float


class _BreakPlace(NamedTuple):
    """Place of a break: one beyond the last keyframe before it, and the first keyframe after it."""

    end: int
    begin: int


class _BothSides(NamedTuple):
    """Local maps of the parts of a drive before and after a place."""

    before: LocalMap
    after: LocalMap


class _Start(NamedTuple):
    """Place of a break, and the initial state of a solve without the motion there."""

    place: _BreakPlace
    state: State


def find_break(local_map: LocalMap, budget: Budget | None = None) -> Break | None:
    """Return the break that lowers the cost of a drive most.

    The result is None if the drive fits, if no break is significant, or if the budget is spent.

    Args:
        local_map: local map of the drive.
        budget: what may be spent; None: the budget of the whole log.
    """
    if fits_as_one(local_map) or local_map.is_noisy:
        return None
    keyframes = informative_keyframes(local_map.segment)
    found = _find_break(at_keyframes(local_map, keyframes), budget or budget_of_log(local_map))
    if found is None:
        return None
    reach = int(keyframes[found.reach[0]]), int(keyframes[found.reach[1]])
    return replace(found, end=int(keyframes[found.end - 1]) + 1, begin=int(keyframes[found.begin]), reach=reach)


def at_keyframes(local_map: LocalMap, keyframes: IntArray) -> LocalMap:
    """Return a map solved at some of its keyframes, among them all with observations, and under its noise.

    Args:
        local_map: solved at all keyframes.
        keyframes: (k,) increasing indices, including the first and the last keyframe.
    """
    state, graph = local_map.solution.state, build_graph([coarsen(local_map.segment, keyframes)])
    solution = solve(graph.problem, replace(state, poses=state.poses[keyframes]), COST_TOLERANCE)
    return replace(local_map, segment=graph.segments[0], graph=graph, solution=solution)


def _find_break(local_map: LocalMap, budget: Budget) -> Break | None:
    """Return the break of a map at its informative keyframes that lowers the cost most, or None as `find_break`."""
    segment = local_map.segment
    grown = [grow_parts(segment, budget, backwards=backwards) for backwards in (False, True)]
    factor = noise_factor(grown)
    ahead, behind = (limit_of(segment, parts, max(1.0, factor), budget) for parts in grown)
    # Persistent errors have a larger variance than scatter. Beside it a break that is significant from one end of the
    # drive may not be from the other; there the scatter decides.
    if ahead is None and behind is not None:
        ahead = limit_of(segment, grown[0], factor, budget)
    elif behind is None and ahead is not None:
        behind = limit_of(segment, grown[1], factor, budget)
    if ahead is None or behind is None:
        return None
    places = _places(segment, ahead, behind)
    if not places or budget.is_spent():
        return None
    middle = places[len(places) // 2]
    sides = _solve_apart(segment, middle, budget)
    starts = [
        _start(local_map.graph, ahead, behind, place, T_ahead_behind)
        for T_ahead_behind in _alignments(sides, behind, middle)
        for place in places
    ]
    if not starts:
        return None
    solutions = _solve_from(starts, local_map.graph.problem, budget)
    if budget.is_spent():
        return None
    costs = np.array([solution.cost for solution in solutions])
    equal = np.flatnonzero(costs <= costs.min() + _SAME_COST)
    # The wheels of a carried robot stand still, so of equal places the one that lasts longest is the most likely.
    best = max(equal.tolist(), key=lambda i: _seconds_between(segment, starts[i].place))
    if starts[best].place != middle:
        sides = _solve_apart(segment, starts[best].place, budget)
    return _test_break(
        local_map, sides, starts[best].place, solutions[best].state, [starts[i].place for i in equal], budget
    )


def budget_of_log(local_map: LocalMap) -> Budget:
    """Return the budget of the whole log of a drive."""
    return Budget.of_log(local_map.segment.run.log_bytes, local_map.segment.run.inputs)


def fits_as_one(local_map: LocalMap) -> bool:
    """Return whether a drive fits as a whole, in each motion between two observations, and in its observations.

    A solve distributes the error of the motion between two observations optimally over its keyframes. So the squared
    residuals there sum to those of the whole motion: chi-square with 3 degrees of freedom at most.
    """
    problem, state = local_map.graph.problem, local_map.solution.state
    if len(local_map.segment.tags) < 2 or not len(problem.odometry.first):
        return True
    is_observing = np.zeros(len(problem.columns.poses), dtype=np.bool_)
    is_observing[problem.observations.pose] = True
    between = np.cumsum(is_observing)[problem.odometry.first]
    squares = np.bincount(between, (problem.odometry.residual(state) ** 2).sum(axis=1))
    is_significant = squares > chdtri(3, FALSE_ALARM / len(squares))
    return local_map.goodness.fits and not is_significant.any() and not _has_outliers_in_a_row(local_map)


def _has_outliers_in_a_row(local_map: LocalMap) -> bool:
    """Return whether a tag has more outlying observations in a part of the drive than by chance.

    Odometry is so certain that a solve may reject the observations around a slip, whose robust loss is bounded.
    """
    segment, observations = local_map.segment, local_map.graph.problem.observations
    squares = (observations.residual(local_map.solution.state) ** 2).sum(axis=1)
    squares /= max(1.0, local_map.goodness.observation_factor) ** 2
    part = (segment.along_m[segment.observations.keyframe] / _IN_A_ROW_M).astype(int)
    _, cell = np.unique(part * len(segment.tags) + segment.observations.tag, return_inverse=True)
    n_outliers = np.bincount(cell, squares > chdtri(2, FALSE_ALARM))
    probability = np.asarray(bdtrc(n_outliers - 1, np.bincount(cell), FALSE_ALARM))
    return bool((probability < FALSE_ALARM / len(probability)).any())


def _places(segment: Segment, ahead: SolvedPart, behind: SolvedPart) -> list[_BreakPlace]:
    """Return the candidate places of a break: that between the two parts, or several where they overlap.

    Places with all observations on one side are left out, since no tag is then observed on both. A place with a single
    keyframe on one side is included. It cannot be a break, since no part can be solved there. But if it lowers the cost
    most, none of the others is a break either.
    """
    candidates = [_BreakPlace(ahead.end, behind.first)]
    if behind.first <= ahead.end:
        observation = np.unique(segment.observations.keyframe)
        cuts = np.unique(np.r_[observation, observation + 1, behind.first, ahead.end])
        cuts = cuts[(cuts >= behind.first) & (cuts <= ahead.end)]
        cuts = cuts[np.unique(np.linspace(0, len(cuts) - 1, _MOST_PLACES).round().astype(np.int64))]
        candidates = [_BreakPlace(cut, cut) for cut in cuts.tolist()]
    places = dict.fromkeys(_between_observations(segment, each) for each in candidates)
    return [each for each in places if each.end > 0 and each.begin < len(segment.stamps_ns)]


def _seconds_between(segment: Segment, place: _BreakPlace) -> float:
    """Return the duration of a place, from the last keyframe before it to the first after it."""
    return float(segment.stamps_ns[place.begin] - segment.stamps_ns[place.end - 1]) * 1e-9


def _between_observations(segment: Segment, place: _BreakPlace) -> _BreakPlace:
    """Extend a place to the observations before and after it, since between these it cannot be located."""
    observation = np.unique(segment.observations.keyframe)
    before, after = observation[observation < place.end], observation[observation >= place.begin]
    n = len(segment.stamps_ns)
    return _BreakPlace(int(before[-1]) + 1 if len(before) else 0, int(after[0]) if len(after) else n)


def _alignments(sides: _BothSides | None, behind: SolvedPart, place: _BreakPlace) -> list[FloatArray]:
    """Return transforms (3,) from the part behind to the part ahead, by the tags on both sides of a place."""
    alignment = None if sides is None else _align(*sides)
    if alignment is None:
        return []
    at_begin = behind.poses[place.begin - behind.first]
    return [se2.compose(each.T_a_b, se2.inverse(at_begin)) for each in (alignment, *alignment.alternatives)]


def _solve_from(starts: Sequence[_Start], problem: Problem, budget: Budget) -> list[Solution]:
    """Solve with a break at the place of each start, until the budget is spent."""
    found: list[Solution] = []
    for start in starts:
        if budget.is_spent():
            break
        freed = _without_motions(problem, *start.place)
        found.append(solve(freed, start.state, COST_TOLERANCE, most_tries=budget.max_linearisations(freed, 1.0)))
        budget.spend(found[-1], is_built=True)
    return found


def _solve_apart(segment: Segment, place: _BreakPlace, budget: Budget) -> _BothSides | None:
    """Solve the parts before and after a place separately; None if one of them cannot be solved."""
    n = len(segment.stamps_ns)
    if not 1 < place.end <= place.begin < n - 1:
        return None
    found = []
    for part in (segment.part(0, place.end), segment.part(place.begin, n)):
        own = budget.take(_SHARE_OF_A_SOLVE)
        try:
            found.append(solve_local_map(part, own))
        except OfflineError:
            return None
        budget.give_back(own)
    return _BothSides(*found)


def _align(before: LocalMap, after: LocalMap) -> Alignment | None:
    shared = sorted(set(before.graph.tags) & set(after.graph.tags))
    return align(condense(before, shared), condense(after, shared)) if len(shared) > 1 else None


def _start(
    graph: Graph, ahead: SolvedPart, behind: SolvedPart, place: _BreakPlace, T_ahead_behind: FloatArray
) -> _Start:
    """Return the initial state of the whole drive with a break at a place."""
    before, after = ahead.poses[: place.end], behind.poses[place.begin - behind.first :]
    between = chain_motions(graph.segments[0].odometry.motion[place.end - 1 : place.begin - 1], before[-1])[1:]
    poses = np.concatenate([before, between, se2.compose(T_ahead_behind, after)])
    tags = {tag: se2.apply(T_ahead_behind, at) for tag, at in behind.tags.items()} | ahead.tags
    return _Start(place, graph.start(poses, tags, ahead.calibration))


def _test_break(
    local_map: LocalMap,
    sides: _BothSides | None,
    place: _BreakPlace,
    start: State,
    equal: Sequence[_BreakPlace],
    budget: Budget,
) -> Break | None:
    """Return the break, else None.

    Two tags on both sides must agree on it, it must lower the cost significantly, and the robot can have moved so far.
    """
    segment, problem = local_map.segment, local_map.graph.problem
    alignment = None if sides is None else _align(*sides)
    if sides is None or alignment is None or not alignment.is_accepted:
        return None
    freed = _without_motions(problem, *place)
    with_break = solve(freed, start, COST_TOLERANCE, most_tries=budget.max_linearisations(freed, 1.0))
    budget.spend(with_break)
    without_break = solve(problem, with_break.state, COST_TOLERANCE, most_tries=budget.max_linearisations(problem, 1.0))
    budget.spend(without_break)
    factor = max(1.0, *(max(part.goodness.odometry_factor, part.goodness.observation_factor) for part in sides))
    observation = np.unique(segment.observations.keyframe)
    # The motions between two observations count as one: freeing more than one of them adds no degrees of freedom.
    n_freed = 3 * (1 + int(((observation >= place.end) & (observation < place.begin)).sum()))
    bound = factor**2 * chdtri(n_freed, FALSE_ALARM / len(observation))
    chi_square = 2.0 * (min(local_map.solution.cost, without_break.cost) - with_break.cost)
    if chi_square <= bound:
        return None
    jump = unexplained_motion(local_map.graph, with_break.state, *place)
    reach = min(other.end for other in equal) - 1, max(other.begin for other in equal)
    seconds = 1e-9 * float(segment.stamps_ns[reach[1]] - segment.stamps_ns[reach[0]])
    if hypot(*jump[:2]) > _LONGEST_M + _FASTEST_M_S * seconds:
        return None
    return Break(place.end, place.begin, reach, jump, chi_square, float(bound))


def _without_motions(problem: Problem, end: int, begin: int) -> Problem:
    """Return the problem with the motions from keyframe end - 1 to begin freed."""
    inside = (problem.odometry.first >= end - 1) & (problem.odometry.first < begin)
    weak = np.where(inside[:, None, None], _FREED * problem.odometry.whitening, problem.odometry.whitening)
    return problem.reweigh(weak, problem.observations.whitening)


def unexplained_motion(graph: Graph, state: State, end: int, begin: int) -> FloatArray:
    """Return the pose (3,) of keyframe `begin` in the frame of that which the wheels predict from keyframe end - 1."""
    odometry = graph.segments[0].odometry.part(end - 1, begin)
    by_wheels = odometry.dead_reckon(graph.odometry_calibration(state, 0))[-1]
    return se2.between(by_wheels, se2.between(state.poses[end - 1], state.poses[begin]))
