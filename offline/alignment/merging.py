"""Merge many local maps into components with one frame each: which segments shared tags join, and where each starts.

The result does not depend on the order of the maps, except for the frame: pairs are aligned and ties broken by names.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import log, pi
from typing import Final, NamedTuple

import numpy as np

from groundsbot.calib.foundation import FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.alignment.condensed_map import CondensedMap, condense
from groundsbot.offline.alignment.cycle_consistency import Contradiction, Link, consistent_links, spanning_tree
from groundsbot.offline.alignment.pairwise import Alignment, align
from groundsbot.offline.foundation import Stages, Workers
from groundsbot.offline.local_map import LocalMap
from groundsbot.offline.measurements import Placement, TagKey
from groundsbot.offline.sam import Budget, BudgetSpentError

# For all pairs, whose number grows with the square of the logs' size. Ten drives past eighty tags each need a small
# part of it.
_FREE_WORK: Final = 30e9
_WORK_AT_A_MIB: Final = 10e9
_UNLIMITED_WORK: Final = 1e300  # of runs that are not from logs
_STAGE: Final = "aligning local maps"
# Shared out at a time, each with all of the budget that is left then.
_PAIRS_AT_A_TIME: Final = 64


@dataclass(frozen=True)
class PairAlignment:
    """Alignment of a pair of local maps, given by index.

    Attributes:
        a: the map whose name comes first.
        b: the other.
        shared: the tags in both.
        alignment: alignment from these; None where no two of them fit together.
        placement: measured by a person, between the starts.
        is_searched: whether the budget sufficed to search for an alignment.
    """

    a: int
    b: int
    shared: tuple[TagKey, ...]
    alignment: Alignment | None
    placement: Placement | None = None
    is_searched: bool = True


@dataclass(frozen=True)
class Group:
    """Segments that alignments join.

    Attributes:
        members: indices of local maps in the order given; the first one's start is the frame.
        T_frame_start: (n, 3) initial values of the members' starts.
    """

    members: tuple[int, ...]
    T_frame_start: FloatArray


@dataclass(frozen=True)
class Merge:
    """Components of maps, and the alignments that join them.

    Attributes:
        pairs: all that share a tag or a measured placement, in order of the maps' names.
        links: accepted links, most certain first.
        contradictions: rejected links.
        groups: largest first.
    """

    pairs: tuple[PairAlignment, ...]
    links: tuple[Link, ...]
    contradictions: tuple[Contradiction, ...]
    groups: tuple[Group, ...]


def merge(
    maps: Sequence[LocalMap],
    placements: Mapping[tuple[int, int], Placement] | None = None,
    variance_factors: Sequence[float] | None = None,
    stages: Stages | None = None,
    workers: Workers | None = None,
) -> Merge:
    """Align all pairs, keep the consistent alignments, and place the maps that they join.

    Args:
        maps: solved, of distinct names.
        placements: measured poses of the second map's start in the first one's, by indices.
        variance_factors: variance factors of each map's covariance; None: from the residuals of its solve, at least 1.
        stages: notified of progress, and records times.
        workers: processes that share the maps and pairs; None: this process. The result does not depend on them.
    """
    stages, workers = stages or Stages(), workers or Workers()
    factors = variance_factors or [variance_factor(each) for each in maps]
    condensed = _condense_maps(maps, factors, stages, workers)
    pairs = tuple(_align_pairs(maps, condensed, placements or {}, stages, workers))
    with stages.stage(_STAGE):
        links, contradictions = consistent_links([link for pair in pairs for link in _links(pair, maps, condensed)])
        return Merge(pairs, tuple(links), tuple(contradictions), tuple(_groups(maps, spanning_tree(links))))


def variance_factor(local_map: LocalMap) -> float:
    """Return chi-square per degree of freedom, at least 1: smaller residuals than assumed prove nothing.

    Where the parts of a map do not fit together within their noise, an unmodelled error deforms it. Its covariance is
    then too small by the excess of that test.
    """
    problem = local_map.graph.problem
    n_priors = int((problem.prior.sigma > 0.0).sum())
    freedom = problem.n_residuals + n_priors - problem.columns.n
    factor = max(1.0, 2.0 * local_map.solution.cost / freedom) if freedom > 0 else 1.0
    goodness = local_map.goodness
    return factor if goodness.fits else max(factor, goodness.chi_square / max(goodness.expected, 1))


def _condense_maps(
    maps: Sequence[LocalMap], factors: Sequence[float], stages: Stages, workers: Workers
) -> list[CondensedMap | None]:
    """Return each map reduced to the tags that other maps have too; None where there are none."""
    count: dict[TagKey, int] = {}
    for local_map in maps:
        for tag in local_map.graph.tags:
            count[tag] = count.get(tag, 0) + 1
    shared = [[tag for tag in local_map.graph.tags if count[tag] > 1] for local_map in maps]
    items = ((m.without_systems(), tags, factor) for m, tags, factor in zip(maps, shared, factors, strict=True))
    return workers.map(_condense, items, [m.segment.name for m in maps], stages, "local maps on shared tags")


def _condense(item: tuple[LocalMap, list[TagKey], float], _stages: Stages) -> CondensedMap | None:
    local_map, tags, factor = item
    return condense(local_map, tags, factor) if tags else None


class _Pair(NamedTuple):
    """Two maps to align, by index and condensed, and the work that may be spent on them."""

    a: int
    b: int
    map_a: CondensedMap | None
    map_b: CondensedMap | None
    placement: Placement | None
    work: float


def _align_pairs(
    maps: Sequence[LocalMap],
    condensed: Sequence[CondensedMap | None],
    placements: Mapping[tuple[int, int], Placement],
    stages: Stages,
    workers: Workers,
) -> list[PairAlignment]:
    numbers = _pairs_with_something_in_common(maps, condensed, placements)
    n_bytes = sum({m.segment.run.name: m.segment.run.log_bytes for m in maps}.values())
    work = _FREE_WORK + _WORK_AT_A_MIB * (n_bytes / 2**20) ** 2 if n_bytes else _UNLIMITED_WORK
    n_at_a_time = 1 if workers.is_this_process else _PAIRS_AT_A_TIME
    found: list[PairAlignment] = []
    for first in range(0, len(numbers), n_at_a_time):
        items = [
            _Pair(a, b, condensed[a], condensed[b], _placement_of(a, b, placements), work)
            for a, b in numbers[first : first + n_at_a_time]
        ]
        names = [f"{maps[each.a].segment.name} and {maps[each.b].segment.name}" for each in items]
        for pair, spent in workers.map(_align_pair, items, names, stages, _STAGE):
            # As if aligned one after another: what was spent beyond the budget counts as not searched.
            work -= spent
            is_over = spent > 0.0 and work < 0.0
            found.append(replace(pair, alignment=None, is_searched=False) if is_over else pair)
    return [pair for pair in found if pair.shared or pair.placement is not None]


def _placement_of(a: int, b: int, placements: Mapping[tuple[int, int], Placement]) -> Placement | None:
    return placements.get((a, b)) or (placements[b, a].inverse() if (b, a) in placements else None)


def _align_pair(item: _Pair, _stages: Stages) -> tuple[PairAlignment, float]:
    """Return the alignment of a pair, and the work that it took."""
    a, b, map_a, map_b, placement, work = item
    if map_a is None or map_b is None:
        return PairAlignment(a, b, (), None, placement), 0.0
    shared = tuple(sorted(set(map_a.tags) & set(map_b.tags)))
    budget = Budget(work)
    try:
        alignment = align(map_a, map_b, placement, budget)
    except BudgetSpentError:
        alignment = None
    return PairAlignment(a, b, shared, alignment, placement), budget.allowed - budget.left


def _pairs_with_something_in_common(
    maps: Sequence[LocalMap],
    condensed: Sequence[CondensedMap | None],
    placements: Mapping[tuple[int, int], Placement],
) -> list[tuple[int, int]]:
    """Return the pairs of maps that share a tag or have a placement, in order of both names."""
    by_name = sorted(range(len(maps)), key=lambda i: maps[i].segment.name)
    place = {m: i for i, m in enumerate(by_name)}
    with_tag: dict[TagKey, list[int]] = {}
    found = {(min(place[a], place[b]), max(place[a], place[b])) for a, b in placements}
    for i, m in enumerate(by_name):
        each = condensed[m]
        for tag in () if each is None else each.tags:
            earlier = with_tag.setdefault(tag, [])
            found.update((other, i) for other in earlier)
            earlier.append(i)
    return [(by_name[i], by_name[j]) for i, j in sorted(found)]


def _links(pair: PairAlignment, maps: Sequence[LocalMap], condensed: Sequence[CondensedMap | None]) -> list[Link]:
    """Return at most one link for a pair: by its tags, or else by the measured placement."""
    names = maps[pair.a].segment.name, maps[pair.b].segment.name
    alignment, placement = pair.alignment, pair.placement
    if alignment is not None and alignment.is_accepted:
        return [Link(pair.a, pair.b, alignment.T_a_b, alignment.covariance, alignment.log_bayes_factor, names)]
    if placement is None:
        return []
    # A link relates the frames that the maps' roots carry, a measurement the starts themselves.
    frame_a, frame_b = condensed[pair.a], condensed[pair.b]
    covariance = placement.covariance.copy()
    if frame_a is not None:
        back = se2.adjoint(se2.inverse(placement.T_a_b))
        covariance += back @ frame_a.frame_covariance @ back.T
    if frame_b is not None:
        covariance += frame_b.frame_covariance
    # The null hypothesis is a start anywhere within a kilometre.
    evidence_nats = log(2.0 * pi * 1e6) - 0.5 * float(np.linalg.slogdet(2.0 * pi * covariance)[1])
    return [Link(pair.a, pair.b, placement.T_a_b, covariance, evidence_nats, names)]


def _groups(maps: Sequence[LocalMap], tree: Sequence[Link]) -> list[Group]:
    """Return the components of the maps under a forest of links, largest first."""
    neighbours: dict[int, list[Link]] = {i: [] for i in range(len(maps))}
    for link in tree:
        neighbours[link.a].append(link)
        neighbours[link.b].append(link)
    groups = []
    placed: dict[int, FloatArray] = {}
    for first in sorted(range(len(maps)), key=lambda i: maps[i].segment.name):
        if first in placed:
            continue
        placed[first] = np.zeros(3)
        members = [first]
        for here in members:
            for link in neighbours[here]:
                there, T_here_there, _ = link.transform_from(here)
                if there not in placed:
                    placed[there] = se2.compose(placed[here], T_here_there)
                    members.append(there)
        members.sort()
        groups.append(Group(tuple(members), se2.between(placed[members[0]], np.array([placed[m] for m in members]))))
    return sorted(groups, key=lambda group: size_rank(maps, group))


def size_rank(maps: Sequence[LocalMap], group: Group) -> tuple[int, int, int]:
    """Return the sort key of groups, largest first: most tags, then most keyframes."""
    tags = {tag for m in group.members for tag in maps[m].graph.tags}
    return -len(tags), -sum(len(maps[m].T_start_base) for m in group.members), group.members[0]
