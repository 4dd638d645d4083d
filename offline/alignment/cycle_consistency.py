"""Consistency of alignments between many local maps: transforms must compose to identity around cycles."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Final

import numpy as np
from scipy.stats import chi2

from groundsbot.calib.foundation import FloatArray
from groundsbot.calib.geometry import se2

# False alarm rate of the test of a cycle.
_FALSE_ALARM: Final = 1e-4
_GATE: Final = float(chi2.isf(_FALSE_ALARM, 3))


@dataclass(frozen=True, eq=False)
class Link:
    """The pose of the second of two maps, given by index, in the first.

    Attributes:
        T_a_b: (3,)
        covariance: (3, 3) of its right tangent.
        log_bayes_factor: log Bayes factor of the alignment over chance.
        names: of both maps; they break ties.
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
    contradictions = []
    rings = _three_cycles(left)
    while any(gap[1] > _GATE for _, gap in rings):
        worst = _worst(rings)
        contradictions.append(_contradiction(worst, rings))
        left.remove(worst)
        rings = [ring for ring in rings if worst not in ring[0]]
    return _links_that_close(left, contradictions), contradictions


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


def path(links: Sequence[Link], begin: int, end: int) -> list[Link]:
    """Return the links of a tree from one map to another; empty if they are not connected."""
    before: dict[int, Link] = {}
    queue, seen = [begin], {begin}
    while queue:
        here = queue.pop(0)
        for link in links:
            if here in (link.a, link.b):
                there = link.b if here == link.a else link.a
                if there not in seen:
                    seen.add(there)
                    before[there] = link
                    queue.append(there)
    found = []
    here = end
    while here != begin and here in before:
        found.append(before[here])
        here = before[here].a if before[here].b == here else before[here].b
    return found[::-1]


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


_Cycle = tuple[tuple[Link, Link, Link], tuple[FloatArray, float]]


def _three_cycles(links: Sequence[Link]) -> list[_Cycle]:
    """Return all cycles of three links, with their closure errors."""
    of = {frozenset((link.a, link.b)): link for link in links}
    partners: dict[int, set[int]] = {}
    for link in links:
        partners.setdefault(link.a, set()).add(link.b)
        partners.setdefault(link.b, set()).add(link.a)
    rings: list[_Cycle] = []
    for i in sorted(partners):
        for j, k in combinations(sorted(p for p in partners[i] if p > i), 2):
            if k in partners[j]:
                ring = of[frozenset((i, j))], of[frozenset((j, k))], of[frozenset((k, i))]
                rings.append((ring, closure_error(ring, i)))
    return rings


def _worst(rings: Sequence[_Cycle]) -> Link:
    """Return the link in most inconsistent cycles, less consistent ones."""
    against: dict[Link, int] = {}
    suspects: set[Link] = set()
    for members, (_, square) in rings:
        for link in members:
            against[link] = against.get(link, 0) + (1 if square > _GATE else -1)
        if square > _GATE:
            suspects.update(members)
    return max(suspects, key=lambda link: (against[link], link.sort_key))


def _contradiction(link: Link, rings: Sequence[_Cycle]) -> Contradiction:
    """Return the contradiction of the link's worst cycle."""
    members, (gap, square) = max((ring for ring in rings if link in ring[0]), key=lambda ring: ring[1][1])
    return Contradiction(link, tuple(sorted({m.a for m in members} | {m.b for m in members})), gap, square**0.5)


def _links_that_close(links: Sequence[Link], contradictions: list[Contradiction]) -> list[Link]:
    """Return the links that close with the tree; the others are appended to the contradictions."""
    tree = spanning_tree(links)
    kept = list(tree)
    for link in links:
        if link in tree:
            continue
        ring = [*path(tree, link.b, link.a), link]
        gap, square = closure_error(ring, link.b)
        if square <= _GATE:
            kept.append(link)
        else:
            members = tuple(sorted({m.a for m in ring} | {m.b for m in ring}))
            contradictions.append(Contradiction(link, members, gap, square**0.5))
    return kept
