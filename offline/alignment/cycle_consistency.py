"""Consistency of alignments between many local maps: transforms must compose to identity around cycles."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from scipy.special import chdtri

from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray
from groundsbot.calib.geometry import se2

# False alarm rate of the test of a cycle.
_FALSE_ALARM: Final = 1e-4
_GATE: Final = float(chdtri(3, _FALSE_ALARM))
_ROUNDING: Final = 1e-6  # relative, of the test of many cycles at a time


@dataclass(frozen=True, eq=False)
class Link:
    """The pose of the second of two maps, given by index, in the first.

    Attributes:
        T_a_b: (3,)
        covariance: (3, 3) of its right tangent.
        log_bayes_factor: log Bayes factor of the alignment over chance.
        names: names of both maps; they break ties.
    """

    a: int
    b: int
    T_a_b: FloatArray
    covariance: FloatArray
    log_bayes_factor: float
    names: tuple[str, str]

    @property
    def sort_key(self) -> tuple[float, tuple[str, str]]:
        """Sort key, most certain link first."""
        return -self.log_bayes_factor, self.names

    def transform_from(self, index: int) -> tuple[int, FloatArray, FloatArray]:
        """Return the other map, T_index_other, and its right tangent's covariance."""
        if index == self.a:
            return self.b, self.T_a_b, self.covariance
        turned = se2.adjoint(self.T_a_b)
        return self.a, se2.inverse(self.T_a_b), turned @ self.covariance @ turned.T


@dataclass(frozen=True)
class Contradiction:
    """A rejected link, the error of the cycle that it closes, and the maps of that cycle in order."""

    link: Link
    cycle: tuple[int, ...]
    closure_error: FloatArray  # (3,)
    sigmas: float


def consistent_links(links: Sequence[Link]) -> tuple[list[Link], list[Contradiction]]:
    """Return mutually consistent links, most certain first, and those rejected; independent of the order of the links.

    Each cycle of three maps is tested for closure. The link is removed that is in the largest number of inconsistent
    cycles less consistent ones; among equals the least certain. This repeats until all such cycles close. Then each
    link that remains must close with the spanning tree of the most certain links.
    """
    left = sorted(links, key=lambda link: link.sort_key)
    contradictions, removed = [], set[int]()
    cycles, is_open = three_cycles(left)
    while is_open.any():
        worst = _worst(cycles, is_open)
        is_its = (cycles == worst).any(axis=1)
        contradictions.append(_contradiction(left, worst, cycles[is_its]))
        cycles, is_open = cycles[~is_its], is_open[~is_its]
        removed.add(worst)
    return _links_that_close([each for i, each in enumerate(left) if i not in removed], contradictions), contradictions


def spanning_tree(links: Sequence[Link]) -> list[Link]:
    """Return the links of a maximum spanning forest, most certain first (Kruskal's algorithm)."""
    root: dict[int, int] = {}

    def find(i: int) -> int:
        while root.setdefault(i, i) != i:
            i = root[i]
        return i

    tree = []
    for link in sorted(links, key=lambda link: link.sort_key):
        if find(link.a) != find(link.b):
            root[find(link.a)] = find(link.b)
            tree.append(link)
    return tree


class _Forest:
    """Trees of links, each with a root, so that the path between two maps takes no search."""

    def __init__(self, links: Sequence[Link]) -> None:
        """Root each tree at one of its maps."""
        of_map: dict[int, list[Link]] = {}
        for link in links:
            of_map.setdefault(link.a, []).append(link)
            of_map.setdefault(link.b, []).append(link)
        self._up: dict[int, tuple[Link, int]] = {}  # for each map but the roots, the link to the next map on the way up
        self._depth: dict[int, int] = {}
        for root in of_map:
            if root in self._depth:
                continue
            self._depth[root] = 0
            reached = [root]
            for here in reached:
                for link in of_map[here]:
                    there = link.b if here == link.a else link.a
                    if there not in self._depth:
                        self._up[there], self._depth[there] = (link, here), self._depth[here] + 1
                        reached.append(there)

    def path(self, begin: int, end: int) -> list[Link]:
        """Return the links from one map to another of the same tree."""
        first, last = list[Link](), list[Link]()
        while begin != end:
            if self._depth[begin] >= self._depth[end]:
                link, begin = self._up[begin]
                first.append(link)
            else:
                link, end = self._up[end]
                last.append(link)
        return first + last[::-1]


def closure_error(links: Sequence[Link], begin: int) -> tuple[FloatArray, float]:
    """Return the closure error of a cycle of links: (3,) twist, and its squared Mahalanobis distance.

    Links that share a map have correlated errors of unknown correlation. The variance of a sum of n errors is at most n
    times the sum of their variances, whatever the correlation; this bound is used.
    """
    T, covariance, here = np.zeros(3), np.zeros((3, 3)), begin
    for link in links:
        here, T_here_there, own = link.transform_from(here)
        carried = se2.adjoint(se2.inverse(T_here_there))
        T = se2.compose(T, T_here_there)
        covariance = carried @ covariance @ carried.T + own
    gap = se2.log(T)
    return gap, float(gap @ np.linalg.solve(len(links) * covariance, gap))


def three_cycles(links: Sequence[Link]) -> tuple[IntArray, BoolArray]:
    """Return the cycles of three links, as indices (C, 3), and which of them do not close (C,).

    A cycle leads from the map of the lowest index to the next higher one, to the highest, and back.
    """
    ends = np.array([(link.a, link.b) for link in links], dtype=np.int64).reshape(-1, 2)
    low, high = ends.min(axis=1, initial=np.iinfo(np.int64).max), ends.max(axis=1, initial=-1)
    n = int(high.max(initial=0)) + 1
    order = np.lexsort((high, low))
    code, first = (low * n + high)[order], np.searchsorted(low[order], np.arange(n + 1))
    found, is_open = [np.zeros((0, 3), dtype=np.int64)], [np.zeros(0, dtype=np.bool_)]
    arrays = _LinkArrays.of(links)
    for i in range(n):
        own = order[first[i] : first[i + 1]]
        j, k = np.triu_indices(len(own), 1)
        wanted = high[own[j]] * n + high[own[k]]
        at = np.minimum(np.searchsorted(code, wanted), len(code) - 1)
        is_cycle = code[at] == wanted
        cycles = np.stack([own[j], order[at], own[k]], axis=-1)[is_cycle]
        found.append(cycles)
        is_open.append(_are_open(links, arrays, i, cycles))
    return np.concatenate(found), np.concatenate(is_open)


class _LinkArrays(NamedTuple):
    """Links as arrays: both maps (L,), transforms (L, 3) and covariances (L, 3, 3)."""

    a: IntArray
    b: IntArray
    T_a_b: FloatArray
    covariance: FloatArray

    @staticmethod
    def of(links: Sequence[Link]) -> "_LinkArrays":
        return _LinkArrays(
            np.array([link.a for link in links], dtype=np.int64),
            np.array([link.b for link in links], dtype=np.int64),
            np.array([link.T_a_b for link in links]).reshape(-1, 3),
            np.array([link.covariance for link in links]).reshape(-1, 3, 3),
        )


def _are_open(links: Sequence[Link], arrays: _LinkArrays, begin: int, cycles: IntArray) -> BoolArray:
    """Return which cycles (C, 3) from a map do not close; `closure_error` decides where rounding matters."""
    T, covariance, here = np.zeros((len(cycles), 3)), np.zeros((len(cycles), 3, 3)), np.full(len(cycles), begin)
    for hop in cycles.T:
        is_forward = arrays.a[hop] == here
        forward, turned = arrays.T_a_b[hop], se2.adjoint(arrays.T_a_b[hop])
        own = arrays.covariance[hop]
        back = turned @ own @ turned.swapaxes(-1, -2)
        step = np.where(is_forward[:, None], forward, se2.inverse(forward))
        carried = se2.adjoint(se2.inverse(step))
        covariance = carried @ covariance @ carried.swapaxes(-1, -2)
        covariance += np.where(is_forward[:, None, None], own, back)
        T, here = se2.compose(T, step), np.where(is_forward, arrays.b[hop], arrays.a[hop])
    gap = se2.log(T)
    square = (gap * np.linalg.solve(3 * covariance, gap[..., None])[..., 0]).sum(axis=-1)
    is_open = square > _GATE
    for i in np.flatnonzero(np.abs(square - _GATE) < _ROUNDING * _GATE):
        is_open[i] = closure_error([links[m] for m in cycles[i]], begin)[1] > _GATE
    return np.asarray(is_open)


def _worst(cycles: IntArray, is_open: BoolArray) -> int:
    """Return the link in most inconsistent cycles less consistent ones; links are in order of their certainty."""
    against = np.bincount(cycles.reshape(-1), np.repeat(np.where(is_open, 1.0, -1.0), 3))
    suspects = np.unique(cycles[is_open])[::-1]
    return int(suspects[np.argmax(against[suspects])])


def _contradiction(links: Sequence[Link], worst: int, cycles: IntArray) -> Contradiction:
    """Return the contradiction of a link's worst cycle, of those (C, 3) that it is in."""
    rings = [[links[m] for m in each] for each in cycles]
    gaps = [closure_error(ring, min(ring[0].a, ring[0].b)) for ring in rings]
    members, (gap, square) = max(zip(rings, gaps, strict=True), key=lambda ring: ring[1][1])
    return Contradiction(links[worst], tuple(sorted({m.a for m in members} | {m.b for m in members})), gap, square**0.5)


def _links_that_close(links: Sequence[Link], contradictions: list[Contradiction]) -> list[Link]:
    """Return the links that close with the tree; the others are appended to the contradictions."""
    tree = spanning_tree(links)
    kept, forest, in_tree = list(tree), _Forest(tree), set(tree)
    for link in links:
        if link in in_tree:
            continue
        ring = [*forest.path(link.b, link.a), link]
        gap, square = closure_error(ring, link.b)
        if square <= _GATE:
            kept.append(link)
        else:
            members = tuple(sorted({m.a for m in ring} | {m.b for m in ring}))
            contradictions.append(Contradiction(link, members, gap, square**0.5))
    return kept
