"""Where a drive's wheels do not tell how it moved: lifted, pushed, or slipping for metres.

Only tags tell. From the beginning on the drive is built up as far as its observations fit together, and likewise
backwards from its end. What lies between them, the wheels cannot explain; where they overlap, it is that place without
whose motion the whole costs least. The drive is split there if that pays: the whole costs less by more than chance
explains, however many places there were to choose from, and two or more tags seen on both sides agree on how the robot
moved.

That takes hundreds of solves. They share what the drive's own solve has left of what its log is worth; where it does
not suffice the drive stays whole, and that is said.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import degrees, hypot
from typing import Final, NamedTuple

import numpy as np
from scipy.stats import binom, chi2

from groundsbot.calib.foundation import FloatArray
from groundsbot.calib.geometry import chain_motions, se2
from groundsbot.offline.alignment import Alignment, align, condense
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.local_map import LocalMap, solve_local_map
from groundsbot.offline.measurements import Segment
from groundsbot.offline.outliers.grown_segments import (
    COST_TOLERANCE,
    FALSE_ALARM,
    SolvedPart,
    grow_parts,
    limit_of,
    noise_factor,
)
from groundsbot.offline.sam import Graph, Problem, Solution, SolveBudget, State, solve

_MOST_BREAKS: Final = 10  # in one drive; more are no breaks but another robot's file
_MOST_PLACES: Final = 24
# Half of what chance adds to a place once in a thousand times: with less, observations do not tell which it was.
_SAME_COST: Final = 0.5 * float(chi2.isf(1e-3, 3))
_IN_A_ROW_M: Final = 2.5
# Of the effort that is left: for either side of a place solved on its own, and for the first of two parts.
_SHARE_OF_A_SOLVE: Final = 0.2
_SHARE_OF_A_PART: Final = 0.5
_FREED: Final = 1e-4  # of a motion's whitening: metres and turns for nothing


@dataclass(frozen=True)
class Break:
    """A part of a drive that its wheels do not tell.

    Attributes:
        end: of what comes before, one beyond its last keyframe.
        begin: the first keyframe of what comes after.
        reach: the keyframes between which it may be as well.
        jump: (3,) how the robot moved besides, seen from the last keyframe before.
        chi_square: by how much more it costs to believe the wheels.
        bound: what chance explains of that.
    """

    end: int
    begin: int
    reach: tuple[int, int]
    jump: FloatArray
    chi_square: float
    bound: float


class SplitMaps(NamedTuple):
    """The segments and local maps of all runs after those that broke were split, and sentences that say so."""

    maps: list[LocalMap]
    warnings: list[str]


class _BreakPlace(NamedTuple):
    """Of a break: one beyond the last keyframe before it, and the first after it."""

    end: int
    begin: int


class _BothSides(NamedTuple):
    """The local maps of what comes before a place of a drive and of what comes after it."""

    before: LocalMap
    after: LocalMap


class _SplitDrive(NamedTuple):
    """Of a drive.

    Attributes:
        parts: its segments.
        breaks: with the keyframe at which the part begins that each is told of.
        is_searched: whether the effort sufficed to look for breaks in all of it.
    """

    parts: list[LocalMap]
    breaks: list[tuple[int, Break]]
    is_searched: bool


class _Start(NamedTuple):
    """Where to begin a solve with a break."""

    place: _BreakPlace
    state: State


def split_at_breaks(maps: Sequence[LocalMap], efforts: Sequence[SolveBudget] | None = None) -> SplitMaps:
    """Splits each drive where its wheels do not tell how it moved, and solves the segments on their own.

    Args:
        maps: of the drives.
        efforts: what is left of what each of them is worth; the whole log's where None.
    """
    mended, warnings = [], []
    for whole, effort in zip(maps, efforts or [_all_of(each) for each in maps], strict=True):
        split = _split(whole, _MOST_BREAKS, effort)
        mended += split.parts
        warnings += [_sentence(whole.segment, each) for each in split.breaks]
        if not split.is_searched:
            warnings.append(_not_searched(whole.segment))
    return SplitMaps(_rename_segments(mended) if warnings else mended, warnings)


def find_break(local_map: LocalMap, effort: SolveBudget | None = None) -> Break | None:
    """The break that explains most of what does not fit in a drive; None where it fits, or none explains it.

    Nor is there one where the effort is spent before it is found; the whole log's where None.
    """
    segment, effort = local_map.segment, effort or _all_of(local_map)
    if _fits(local_map) or local_map.is_noisy:
        return None
    grown = [grow_parts(segment, effort, backwards=backwards) for backwards in (False, True)]
    factor = noise_factor(grown)
    ahead, behind = (limit_of(segment, parts, factor, effort) for parts in grown)
    if ahead is None or behind is None:
        return None
    places = _places(segment, ahead, behind)
    if not places or effort.is_spent():
        return None
    middle = places[len(places) // 2]
    sides = _solve_apart(segment, middle, effort)
    starts = [
        _start(local_map.graph, ahead, behind, place, T_ahead_behind)
        for T_ahead_behind in _ways_to_align(sides, behind, middle)
        for place in places
    ]
    if not starts:
        return None
    apart = _solve_from(starts, local_map.graph.problem, effort)
    if effort.is_spent():
        return None
    costs = np.array([solution.cost for solution in apart])
    equal = np.flatnonzero(costs <= costs.min() + _SAME_COST)
    best = max(equal.tolist(), key=lambda i: _seconds_between(segment, starts[i].place))
    if starts[best].place != middle:
        sides = _solve_apart(segment, starts[best].place, effort)
    return _test_break(
        local_map, sides, starts[best].place, apart[best].state, [starts[i].place for i in equal], effort
    )


def _all_of(local_map: LocalMap) -> SolveBudget:
    return SolveBudget.of_log(local_map.segment.run.log_bytes, local_map.segment.run.inputs)


def _split(whole: LocalMap, most: int, effort: SolveBudget) -> _SplitDrive:
    found = find_break(whole, effort) if most else None
    if found is None:
        return _SplitDrive([whole], [], is_searched=not effort.is_spent() or _fits(whole))
    segment = whole.segment
    split = _SplitDrive([], [(0, found)], is_searched=True)
    ends = (0, found.end), (found.begin, len(segment.stamps_ns))
    left = [_without_ends(segment.part(*each), *each, segment) for each in ends]
    for (first, _), part in zip(ends, left, strict=True):
        own = effort.take(_SHARE_OF_A_PART if part is left[0] else 1.0)
        inner = _split(solve_local_map(part, own), most - 1, own)
        effort.give_back(own)
        breaks = [(first + offset, each) for offset, each in inner.breaks]
        split = _SplitDrive(split.parts + inner.parts, split.breaks + breaks, split.is_searched and inner.is_searched)
    return split


def _without_ends(part: Segment, first: int, end: int, whole: Segment) -> Segment:
    """Without what was read where the break is: pictures of one standing pose may show two places."""
    keyframe = part.observations.keyframe
    kept = (keyframe > 0) | (first == 0)
    kept &= (keyframe < len(part.stamps_ns) - 1) | (end == len(whole.stamps_ns))
    observations = part.observations.where(kept)
    seen, tag = np.unique(observations.tag, return_inverse=True)
    return replace(part, tags=tuple(part.tags[i] for i in seen), observations=replace(observations, tag=tag))


def _fits(local_map: LocalMap) -> bool:
    """Whether the whole fits together, no segment between two observations strains the wheels beyond chance, nor a tag.

    What is between two observations is laid out as the wheels like it best, so that its squares add up to those of the
    motion from one observation to the next: chi-square with 3 degrees of freedom at most.
    """
    problem, state = local_map.graph.problem, local_map.solution.state
    if len(local_map.segment.tags) < 2 or not len(problem.odometry.first):
        return True
    reads = np.zeros(len(problem.columns.poses), dtype=np.bool_)
    reads[problem.observations.pose] = True
    between = np.cumsum(reads)[problem.odometry.first]
    squares = np.bincount(between, (problem.odometry.residual(state) ** 2).sum(axis=1))
    strained = squares > chi2.isf(FALSE_ALARM / len(squares), 3)
    return local_map.goodness.fits and not strained.any() and not _wild_in_a_row(local_map)


def _wild_in_a_row(local_map: LocalMap) -> bool:
    """Whether more observations of a tag in a part of the way are wild than chance makes so.

    The wheels are known so well that a solve may rather give up the observations around a slip, whose loss is bounded.
    """
    segment, observations = local_map.segment, local_map.graph.problem.observations
    squares = (observations.residual(local_map.solution.state) ** 2).sum(axis=1)
    squares /= max(1.0, local_map.goodness.observation_factor) ** 2
    part = (segment.along_m[segment.observations.keyframe] / _IN_A_ROW_M).astype(int)
    _, cell = np.unique(part * len(segment.tags) + segment.observations.tag, return_inverse=True)
    n_wild = np.bincount(cell, squares > chi2.isf(FALSE_ALARM, 2))
    by_chance = np.asarray(binom.sf(n_wild - 1, np.bincount(cell), FALSE_ALARM))
    return bool((by_chance < FALSE_ALARM / len(by_chance)).any())


def _places(segment: Segment, ahead: SolvedPart, behind: SolvedPart) -> list[_BreakPlace]:
    """Where the break may be: what lies between the two parts, or wherever they overlap.

    Not where all was read on one side, for nothing tells of a break there. A place with a single keyframe on one side
    stays: it cannot be a break, since no part can be solved there, but where it explains most none other may.
    """
    wanted = [_BreakPlace(ahead.end, behind.first)]
    if behind.first <= ahead.end:
        observation = np.unique(segment.observations.keyframe)
        cuts = np.unique(np.r_[observation, observation + 1, behind.first, ahead.end])
        cuts = cuts[(cuts >= behind.first) & (cuts <= ahead.end)]
        cuts = cuts[np.unique(np.linspace(0, len(cuts) - 1, _MOST_PLACES).round().astype(np.int64))]
        wanted = [_BreakPlace(cut, cut) for cut in cuts.tolist()]
    places = dict.fromkeys(_between_observations(segment, each) for each in wanted)
    return [each for each in places if each.end > 0 and each.begin < len(segment.stamps_ns)]


def _seconds_between(segment: Segment, place: _BreakPlace) -> float:
    """Who carries a robot has it stand meanwhile."""
    return float(segment.stamps_ns[place.begin] - segment.stamps_ns[place.end - 1]) * 1e-9


def _between_observations(segment: Segment, place: _BreakPlace) -> _BreakPlace:
    """As far as nothing was read: nobody knows where in there it happened."""
    observation = np.unique(segment.observations.keyframe)
    before, after = observation[observation < place.end], observation[observation >= place.begin]
    n = len(segment.stamps_ns)
    return _BreakPlace(int(before[-1]) + 1 if len(before) else 0, int(after[0]) if len(after) else n)


def _ways_to_align(sides: _BothSides | None, behind: SolvedPart, place: _BreakPlace) -> list[FloatArray]:
    """Return transforms from the part behind to the part ahead, by the tags on both sides of a place."""
    if sides is None:
        return []
    at_begin = behind.poses[place.begin - behind.first]
    alignment = _align(*sides)
    ways = [] if alignment is None else [alignment, *alignment.alternatives]
    return [se2.compose(way.T_a_b, se2.inverse(at_begin)) for way in ways]


def _solve_from(starts: Sequence[_Start], problem: Problem, effort: SolveBudget) -> list[Solution]:
    """With a break, wherever it may be; not from all starts where there is no effort left."""
    found: list[Solution] = []
    for start in starts:
        if effort.is_spent():
            break
        freed = _without_motions(problem, *start.place)
        found.append(solve(freed, start.state, COST_TOLERANCE, most_tries=effort.max_linearisations(freed, 1.0)))
        effort.spend(found[-1], is_built=True)
    return found


def _solve_apart(segment: Segment, place: _BreakPlace, effort: SolveBudget) -> _BothSides | None:
    """Solve what comes before a place and what comes after, each on its own; None where one of them cannot be."""
    n = len(segment.stamps_ns)
    if not 1 < place.end <= place.begin < n - 1:
        return None
    found = []
    for part in (segment.part(0, place.end), segment.part(place.begin, n)):
        own = effort.take(_SHARE_OF_A_SOLVE)
        try:
            found.append(solve_local_map(part, own))
        except OfflineError:
            return None
        effort.give_back(own)
    return _BothSides(*found)


def _align(before: LocalMap, after: LocalMap) -> Alignment | None:
    shared = sorted(set(before.graph.tags) & set(after.graph.tags))
    return align(condense(before, shared), condense(after, shared)) if len(shared) > 1 else None


def _start(
    graph: Graph, ahead: SolvedPart, behind: SolvedPart, place: _BreakPlace, T_ahead_behind: FloatArray
) -> _Start:
    """Starting values for the whole with a break in that place."""
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
    effort: SolveBudget,
) -> Break | None:
    """Return the break if two tags on both sides agree on it and it lowers the cost by more than chance explains."""
    segment, problem = local_map.segment, local_map.graph.problem
    alignment = None if sides is None else _align(*sides)
    if sides is None or alignment is None or not alignment.is_accepted:
        return None
    freed = _without_motions(problem, *place)
    apart = solve(freed, start, most_tries=effort.max_linearisations(freed, 1.0))
    effort.spend(apart)
    together = solve(problem, apart.state, most_tries=effort.max_linearisations(problem, 1.0))
    effort.spend(together)
    joined = min(local_map.solution.cost, together.cost)
    factor = max(1.0, *(max(part.goodness.odometry_factor, part.goodness.observation_factor) for part in sides))
    observation = np.unique(segment.observations.keyframe)
    # Between two observations all motions are one: freeing the others as well lets nothing else go.
    n_freed = 3 * (1 + int(((observation >= place.end) & (observation < place.begin)).sum()))
    bound = factor**2 * chi2.isf(FALSE_ALARM / len(observation), n_freed)
    chi_square = 2.0 * (joined - apart.cost)
    if chi_square <= bound:
        return None
    jump = unexplained_motion(local_map.graph, apart.state, *place)
    reach = min(other.end for other in equal) - 1, max(other.begin for other in equal)
    return Break(place.end, place.begin, reach, jump, chi_square, float(bound))


def _without_motions(problem: Problem, end: int, begin: int) -> Problem:
    """Without the motions from keyframe end - 1 to begin."""
    inside = (problem.odometry.first >= end - 1) & (problem.odometry.first < begin)
    weak = np.where(inside[:, None, None], _FREED * problem.odometry.whitening, problem.odometry.whitening)
    return replace(problem, odometry=replace(problem.odometry, whitening=weak))


def unexplained_motion(graph: Graph, state: State, end: int, begin: int) -> FloatArray:
    """(3,) the motion that the wheels do not have."""
    odometry = graph.segments[0].odometry.part(end - 1, begin)
    told = odometry.dead_reckon(graph.odometry_calibration(state, 0))[-1]
    return se2.between(told, se2.between(state.poses[end - 1], state.poses[begin]))


def _rename_segments(maps: Sequence[LocalMap]) -> list[LocalMap]:
    """Segments named after their run and their place in it."""
    count: dict[str, int] = {}
    numbered = []
    for each in maps:
        run = each.segment.run.name
        count[run] = count.get(run, 0) + 1
        segment = replace(each.segment, name=run if count[run] == 1 else f"{run}_stretch{count[run]}")
        numbered.append(replace(each, segment=segment, graph=replace(each.graph, segments=(segment,))))
    return numbered


def _not_searched(segment: Segment) -> str:
    return (
        f"{segment.name}: its observations do not fit together, and where its wheels may have lost the way was not "
        "searched to the end: that takes more work than a log of this size is worth; was the robot lifted or pushed, "
        "map what was recorded before and after as runs of their own, or leave out some of the looks"
    )


def _sentence(segment: Segment, told: tuple[int, Break]) -> str:
    """When, how much, how sure, and what became of it."""
    first, found = told
    keyframes = np.array([found.end - 1, found.begin, *found.reach]) + first
    begin_s, end_s, earliest_s, latest_s = (segment.stamps_ns[keyframes] - segment.stamps_ns[0]) * 1e-9
    or_else = ""
    if (earliest_s, latest_s) != (begin_s, end_s):
        or_else = f"; observations would as well have it anywhere from {earliest_s:.1f} s to {latest_s:.1f} s"
    x_m, y_m, theta_rad = found.jump
    return (
        f"{segment.name}: between {begin_s:.1f} s and {end_s:.1f} s after its start the robot moved by "
        f"{hypot(x_m, y_m):.2f} m and {round(degrees(theta_rad))} deg that its wheels do not explain (chi-square "
        f"{found.chi_square:.0f}, chance explains {found.bound:.0f}): lifted, pushed, or slipping? The run is split "
        f"there into segments, which only tags join{or_else}"
    )
