"""The segments of a run solved together in a finished map: its tags and calibration are known beforehand, jointly.

The map's tags are variables with the map's joint covariance as their prior, so the trajectory carries its uncertainty;
what the run makes of them is not kept. A tag that was moved since is given a place of its own. It is looked for as in
`outliers.outliers`, by what all else foretells for it: for a tag that is held, the prior's residual by what the
estimate takes of it (data snooping: Baarda, "A testing procedure for use in geodetic networks", 1968), for one that is
not, its place against that which the map foretells from the tags that are.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.stats import chi2

from groundsbot.calib.foundation import FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.alignment import squared_sigmas
from groundsbot.offline.local_map import LocalMap
from groundsbot.offline.localization.map_prior import MapPrior
from groundsbot.offline.measurements import UNMODELLED_SIGMA_M, TagKey
from groundsbot.offline.outliers import FALSE_ALARM, rename_tags
from groundsbot.offline.sam import Graph, Solution, State, build_graph, solve, unheld

_MOST_CHANGES: Final = 20
_MOVED: Final = "moved, "


@dataclass(frozen=True)
class TagOffset:
    """A tag of the run against the map's: how far it lies from where the map and all else foretell it."""

    known: TagKey
    position_m: FloatArray  # (2,) as the run has it
    off_m: FloatArray  # (2,)
    squares: float  # chi-square with two degrees of freedom where it hangs where it did


@dataclass(frozen=True)
class RunInMap:
    """Where the solve ended.

    Attributes:
        graph: its tags bear the map's names where they are the map's.
        solution: of it.
        held: the map's tags that hold each member.
        elsewhere: those that do not, by member.
        called: for each member, the graph's name of each of its tags that may be the map's.
    """

    graph: Graph
    solution: Solution
    held: tuple[tuple[TagKey, ...], ...]
    elsewhere: tuple[tuple[TagOffset, ...], ...]
    called: tuple[dict[TagKey, TagKey], ...]


def solve_in_map(
    members: Sequence[LocalMap],
    T_map_start: FloatArray,
    names: Sequence[dict[TagKey, TagKey]],
    maybe: Sequence[dict[TagKey, TagKey]],
    known: MapPrior,
) -> RunInMap:
    """Solves segments in a map, and frees the tags of it that were moved.

    Args:
        members: their local maps.
        T_map_start: (n, 3) where their alignments put them.
        names: for each, the map's tag of each of its tags that fits one.
        maybe: for each, that of its tags that did not fit; named as moved unless they fit after all.
        known: the map.
    """
    split = _TagAssignment(known, members, [dict(each) for each in names], [dict(each) for each in maybe])
    graph, solution = _solve(members, T_map_start, split, known)
    judge = _TagTest(graph, solution, known)
    for _ in range(_MOST_CHANGES):
        if not split.update(judge):
            break
        graph, solution = _solve(members, solution.state.poses[graph.first_pose], split, known)
        judge = _TagTest(graph, solution, known)
    off = split.elsewhere(judge)
    return RunInMap(
        graph,
        solution,
        tuple(tuple(each.values()) for each in split.held),
        tuple(
            tuple(each for (i, _), each in off.items() if i == m and each.squares > split.bound)
            for m in range(len(members))
        ),
        tuple(split.name_of(m) for m in range(len(members))),
    )


class _TagAssignment:
    """Which of the map's tags hold which segment, and which are loose."""

    def __init__(
        self,
        known: MapPrior,
        members: Sequence[LocalMap],
        held: list[dict[TagKey, TagKey]],
        loose: list[dict[TagKey, TagKey]],
    ) -> None:
        self.known, self.members, self.held, self.loose = known, members, held, loose
        self._settled: set[tuple[int, TagKey]] = set()  # changed once: not again
        n_tags = sum(len(each) for each in (*held, *loose))
        self.bound = float(chi2.isf(FALSE_ALARM / max(n_tags, 1), 2))

    def name_of(self, member: int) -> dict[TagKey, TagKey]:
        """The name of each tag in the solve: the map's where it is held, else one of its own."""
        own = {tag: _own_name(self.members[member], tag) for tag in self.loose[member]}
        return self.held[member] | own

    def update(self, judge: "_TagTest") -> bool:
        """Frees the tag that all else contradicts most, or holds the one that fits after all; False for none."""
        off = {key: judge.tag_offset(tag) for key, tag in _entries(self.held)}
        worst = max(off, key=lambda key: off[key].squares, default=None)
        if worst is not None and off[worst].squares > self.bound and len(off) > 2:
            # In all segments that saw it: where each has it is told apart from the map's place.
            for i, own in [key for key, each in off.items() if each.known == off[worst].known]:
                self.loose[i][own] = self.held[i].pop(own)
                self._settled.add((i, own))
            return True
        back = {key: each for key, each in self.elsewhere(judge).items() if key not in self._settled}
        best = min(back, key=lambda key: back[key].squares, default=None)
        if best is None or back[best].squares > self.bound:
            return False
        i, own = best
        self.held[i][own] = self.loose[i].pop(own)
        self._settled.add(best)
        return True

    def elsewhere(self, judge: "_TagTest") -> "dict[tuple[int, TagKey], TagOffset]":
        """The loose ones against where the map foretells them."""
        return {(i, own): judge.free(tag, _own_name(self.members[i], own)) for (i, own), tag in _entries(self.loose)}


def _solve(
    members: Sequence[LocalMap],
    T_map_start: FloatArray,
    split: "_TagAssignment",
    known: MapPrior,
) -> tuple[Graph, Solution]:
    called = [rename_tags(each, split.name_of(i)) for i, each in enumerate(members)]
    graph = unheld(build_graph([each.segment for each in called]))
    of_map = {tag: tag for each in split.held for tag in each.values()}
    graph = known.constrain(graph, of_map)
    poses = np.concatenate([se2.compose(T, each.T_start_base) for T, each in zip(T_map_start, members, strict=True)])
    tags = {
        tag: se2.apply(T, place)
        for T, each in zip(T_map_start, called, strict=True)
        for tag, place in each.tags_m.items()
    }
    tags |= {tag: known.places_m[known.index[tag]] for tag in of_map}
    calibration = {parameter: value for each in called for parameter, value in each.calibration.items()}
    return graph, solve(graph.problem, graph.start(poses, tags, calibration))


def _own_name(member: LocalMap, tag: TagKey) -> TagKey:
    """Of a tag whose place in the map does not count."""
    return tag._replace(instance=f"{_MOVED}{member.segment.name} {tag.instance}")


def _entries(groups: Sequence[dict[TagKey, TagKey]]) -> list[tuple[tuple[int, TagKey], TagKey]]:
    return [((i, own), tag) for i, group in enumerate(groups) for own, tag in group.items()]


class _TagTest:
    """What a solution says of tags of the map."""

    def __init__(self, graph: Graph, solution: Solution, known: MapPrior) -> None:
        self._known = known
        self._state: State = solution.state
        self._index = {tag: i for i, tag in enumerate(graph.tags)}
        factor = graph.problem.measured.known
        self._held = [graph.tags[i] for i in factor.tags]
        self._numbers = known.numbers_among(graph.parameters)
        free = [i for i in range(len(graph.tags)) if i not in set(factor.tags.tolist())]
        columns = graph.problem.columns
        self._at = {graph.tags[i]: len(factor.mean) + 2 * n for n, i in enumerate(free)}
        self._joint = solution.covariance(np.concatenate([factor.columns(columns), columns.tags[free].reshape(-1)]))
        n = len(factor.mean)
        information = factor.whitening.T @ factor.whitening
        self._off = factor.off(self._state)
        self._pull = information @ self._off
        self._checked = information - information @ self._joint[:n, :n] @ information

    def tag_offset(self, tag: TagKey) -> TagOffset:
        """A tag that is held."""
        at = 2 * self._held.index(tag)
        rows = slice(at, at + 2)
        ways, shares = self._checked[rows, rows], self._pull[rows]
        # Nothing else tells where it is, where the map alone holds it: then nothing can contradict.
        covariance = np.asarray(np.linalg.pinv(ways, rcond=1e-9, hermitian=True), dtype=np.float64)
        return self._tag_offset(tag, tag, covariance @ shares, covariance)

    def free(self, tag: TagKey, own: TagKey) -> TagOffset:
        """A tag of the map that the run has under a name of its own."""
        known, n = self._known, len(self._off)
        rows, others = known.rows([tag]), known.rows(self._held, list(self._numbers.values()))
        by = np.linalg.solve(known.covariance[np.ix_(others, others)], known.covariance[np.ix_(others, rows)]).T
        foretold = known.mean[rows] + by @ self._off
        at = slice(self._at[own], self._at[own] + 2)
        across = self._joint[at, :n] @ by.T
        covariance = self._joint[at, at] - across - across.T + by @ self._joint[:n, :n] @ by.T
        covariance += known.covariance[np.ix_(rows, rows)] - by @ known.covariance[np.ix_(others, rows)]
        return self._tag_offset(tag, own, self._state.tags[self._index[own]] - foretold, covariance)

    def _tag_offset(self, tag: TagKey, own: TagKey, off_m: FloatArray, covariance: FloatArray) -> TagOffset:
        spread = covariance + UNMODELLED_SIGMA_M**2 * np.eye(2)
        squares = float(squared_sigmas(off_m[None], spread[None])[0])
        return TagOffset(tag, self._state.tags[self._index[own]], off_m, squares)
