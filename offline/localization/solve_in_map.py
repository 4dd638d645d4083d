"""Solves the segments of a run together in a finished map, whose tags and calibration have a joint prior.

The map's tags are variables with the map's joint covariance as their prior, so the covariance of the trajectory
includes the map's. Their estimates are not written to the map. A tag that moved since gets a position of its own, as in
`outliers.outliers`. A tag with the map's prior is tested by the residual of the prior against its covariance (data
snooping: Baarda, "A testing procedure for use in geodetic networks", 1968). A tag without it is compared with its
prediction from the map and the tags that have it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.special import chdtri

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
    """The offset of a tag in the run from its prediction.

    Attributes:
        known: the map's tag.
        position_m: (2,) estimated by the run.
        offset_m: (2,) from the prediction by the map and all other measurements.
        chi2: squared sigmas of the offset, with two degrees of freedom where the tag did not move.
    """

    known: TagKey
    position_m: FloatArray
    offset_m: FloatArray
    chi2: float


@dataclass(frozen=True)
class RunInMap:
    """A run solved in a map.

    Attributes:
        graph: graph with tags under the map's names where they have the map's prior.
        solution: solution of the graph.
        map_tags: for each member, the map's tags whose prior constrains it.
        moved: for each member, the tags that moved.
        names: for each member, the graph's name of each of its tags that may be in the map.
    """

    graph: Graph
    solution: Solution
    map_tags: tuple[tuple[TagKey, ...], ...]
    moved: tuple[tuple[TagOffset, ...], ...]
    names: tuple[dict[TagKey, TagKey], ...]


def solve_in_map(
    members: Sequence[LocalMap],
    T_map_start: FloatArray,
    matches: Sequence[dict[TagKey, TagKey]],
    mismatches: Sequence[dict[TagKey, TagKey]],
    known: MapPrior,
) -> RunInMap:
    """Solve segments in a map, and remove the map's prior from tags that moved.

    Args:
        members: local maps of the n segments.
        T_map_start: (n, 3) start poses, from their alignments.
        matches: for each member, the map's tag for each of its tags that fits.
        mismatches: for each member, the map's tag for each of its tags that does not fit; reported as moved unless they
            fit in the solution.
        known: the map.
    """
    assignment = _TagAssignment(known, members, [dict(each) for each in matches], [dict(each) for each in mismatches])
    graph, solution = _solve(members, T_map_start, assignment, known)
    test = _TagTest(graph, solution, known)
    for _ in range(_MOST_CHANGES):
        if not assignment.update(test):
            break
        graph, solution = _solve(members, solution.state.poses[graph.first_pose], assignment, known)
        test = _TagTest(graph, solution, known)
    offsets = assignment.loose_offsets(test)
    return RunInMap(
        graph,
        solution,
        tuple(tuple(each.values()) for each in assignment.held),
        tuple(
            tuple(each for (i, _), each in offsets.items() if i == m and each.chi2 > assignment.bound)
            for m in range(len(members))
        ),
        tuple(assignment.names(m) for m in range(len(members))),
    )


class _TagAssignment:
    """The assignment of each member's tags to tags of the map.

    Attributes:
        held: for each member, the map's tag for each of its tags that has the map's prior.
        loose: for each member, the map's tag for each of its tags that does not have it.
        bound: bound on chi2, beyond which a tag has moved.
    """

    def __init__(
        self,
        known: MapPrior,
        members: Sequence[LocalMap],
        held: list[dict[TagKey, TagKey]],
        loose: list[dict[TagKey, TagKey]],
    ) -> None:
        self.known, self.members, self.held, self.loose = known, members, held, loose
        self._changed: set[tuple[int, TagKey]] = set()  # changed once and not again, so that the iteration ends
        n_tags = sum(len(each) for each in (*held, *loose))
        self.bound = float(chdtri(2, FALSE_ALARM / max(n_tags, 1)))

    def names(self, member: int) -> dict[TagKey, TagKey]:
        """Return the name of each tag in the solve: the map's where the tag is held, else a unique one."""
        own = {tag: _own_name(self.members[member], tag) for tag in self.loose[member]}
        return self.held[member] | own

    def update(self, test: "_TagTest") -> bool:
        """Release the worst held tag beyond the bound, else hold the best loose tag within it; False where none is."""
        offsets = {key: test.held_offset(tag) for key, tag in _entries(self.held)}
        worst = max(offsets, key=lambda key: offsets[key].chi2, default=None)
        if worst is not None and offsets[worst].chi2 > self.bound and len(offsets) > 2:
            # Released in all members, so that each is compared with the map by its own observations.
            for i, own in [key for key, each in offsets.items() if each.known == offsets[worst].known]:
                self.loose[i][own] = self.held[i].pop(own)
                self._changed.add((i, own))
            return True
        loose = {key: each for key, each in self.loose_offsets(test).items() if key not in self._changed}
        best = min(loose, key=lambda key: loose[key].chi2, default=None)
        if best is None or loose[best].chi2 > self.bound:
            return False
        i, own = best
        self.held[i][own] = self.loose[i].pop(own)
        self._changed.add(best)
        return True

    def loose_offsets(self, test: "_TagTest") -> "dict[tuple[int, TagKey], TagOffset]":
        """Return the offsets of the loose tags from their predictions, by member and tag."""
        return {
            (i, own): test.loose_offset(tag, _own_name(self.members[i], own)) for (i, own), tag in _entries(self.loose)
        }


def _solve(
    members: Sequence[LocalMap],
    T_map_start: FloatArray,
    assignment: "_TagAssignment",
    known: MapPrior,
) -> tuple[Graph, Solution]:
    renamed = [rename_tags(each, assignment.names(i)) for i, each in enumerate(members)]
    graph = unheld(build_graph([each.segment for each in renamed]))
    of_map = {tag: tag for each in assignment.held for tag in each.values()}
    graph = known.constrain(graph, of_map)
    poses = np.concatenate([se2.compose(T, each.T_start_base) for T, each in zip(T_map_start, members, strict=True)])
    tags = {
        tag: se2.apply(T, place)
        for T, each in zip(T_map_start, renamed, strict=True)
        for tag, place in each.tags_m.items()
    }
    tags |= {tag: known.places_m[known.index[tag]] for tag in of_map}
    calibration = {parameter: value for each in renamed for parameter, value in each.calibration.items()}
    return graph, solve(graph.problem, graph.start(poses, tags, calibration))


def _own_name(member: LocalMap, tag: TagKey) -> TagKey:
    """Return a unique name for a tag without the map's prior."""
    return tag._replace(instance=f"{_MOVED}{member.segment.name} {tag.instance}")


def _entries(groups: Sequence[dict[TagKey, TagKey]]) -> list[tuple[tuple[int, TagKey], TagKey]]:
    return [((i, own), tag) for i, group in enumerate(groups) for own, tag in group.items()]


class _TagTest:
    """Tests of the map's tags in a solution."""

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
        self._weighted_off = information @ self._off
        self._residual_information = information - information @ self._joint[:n, :n] @ information

    def held_offset(self, tag: TagKey) -> TagOffset:
        """Return the offset of a tag with the map's prior from its position there, by data snooping."""
        at = 2 * self._held.index(tag)
        rows = slice(at, at + 2)
        # Singular where only the prior determines the tag, so nothing can contradict it.
        information = self._residual_information[rows, rows]
        covariance = np.asarray(np.linalg.pinv(information, rcond=1e-9, hermitian=True), dtype=np.float64)
        return self._offset(tag, tag, covariance @ self._weighted_off[rows], covariance)

    def loose_offset(self, tag: TagKey, own: TagKey) -> TagOffset:
        """Return the offset of a tag without the map's prior from its prediction by the map.

        Args:
            tag: tag of the map.
            own: its name in the graph.
        """
        known, n = self._known, len(self._off)
        rows, others = known.rows([tag]), known.rows(self._held, list(self._numbers.values()))
        by = np.linalg.solve(known.covariance[np.ix_(others, others)], known.covariance[np.ix_(others, rows)]).T
        predicted = known.mean[rows] + by @ self._off
        at = slice(self._at[own], self._at[own] + 2)
        cross = self._joint[at, :n] @ by.T
        covariance = self._joint[at, at] - cross - cross.T + by @ self._joint[:n, :n] @ by.T
        covariance += known.covariance[np.ix_(rows, rows)] - by @ known.covariance[np.ix_(others, rows)]
        return self._offset(tag, own, self._state.tags[self._index[own]] - predicted, covariance)

    def _offset(self, tag: TagKey, own: TagKey, offset_m: FloatArray, covariance: FloatArray) -> TagOffset:
        inflated = covariance + UNMODELLED_SIGMA_M**2 * np.eye(2)
        distance = float(squared_sigmas(offset_m[None], inflated[None])[0])
        return TagOffset(tag, self._state.tags[self._index[own]], offset_m, distance)
