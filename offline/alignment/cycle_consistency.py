"""Which alignments between many local maps go together: where they close a ring, they must close it."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Final

import numpy as np
from scipy.stats import chi2

from groundsbot.calib.foundation import FloatArray
from groundsbot.calib.geometry import se2

# A ring that closes is taken for one that does not so rarely.
_FALSE_ALARM: Final = 1e-4
_GATE: Final = float(chi2.isf(_FALSE_ALARM, 3))


@dataclass(frozen=True, eq=False)
class Link:
    """Two maps, by index, and how the second lies in the first.

    Attributes:
        T_a_b: (3,)
        covariance: (3, 3) of its right tangent.
        evidence_nats: how sure it is.
        names: of both, which settle what evidence leaves open.
    """

    a: int
    b: int
    T_a_b: FloatArray
    covariance: FloatArray
    evidence_nats: float
    names: tuple[str, str]

    @property
    def rank(self) -> tuple[float, tuple[str, str]]:
        """Sorts the surest first."""
        return -self.evidence_nats, self.names

    def transform_from(self, index: int) -> tuple[int, FloatArray, FloatArray]:
        """The other map, T_index_other, and its right tangent's covariance."""
        if index == self.a:
            return self.b, self.T_a_b, self.covariance
        turned = se2.adjoint(self.T_a_b)
        return self.a, se2.inverse(self.T_a_b), turned @ self.covariance @ turned.T


@dataclass(frozen=True)
class Contradiction:
    """A link that was left out, by how far the ring that it closes gapes, and the maps of that ring in order."""

    link: Link
    ring: tuple[int, ...]
    gap: FloatArray  # (3,)
    sigmas: float


def consistent_links(links: Sequence[Link]) -> tuple[list[Link], list[Contradiction]]:
    """The links left when those are gone that contradict others, surest first; the same in any order of the links.

    Of three maps that are all linked, the ring must close. The link goes that is in most rings which do not, counted
    against those which do; among equals the least sure one. Then the links that join all maps without a ring, surest
    first, have the say over what remains.
    """
    left = sorted(links, key=lambda link: link.rank)
    contradictions = []
    rings = _triangles(left)
    while any(gap[1] > _GATE for _, gap in rings):
        worst = _worst(rings)
        contradictions.append(_contradiction(worst, rings))
        left.remove(worst)
        rings = [ring for ring in rings if worst not in ring[0]]
    return _closing(left, contradictions), contradictions


def spanning_tree(links: Sequence[Link]) -> list[Link]:
    """Links that join all maps which any link joins, without a ring; surest first (Kruskal's)."""
    root: dict[int, int] = {}

    def find(i: int) -> int:
        while root.setdefault(i, i) != i:
            i = root[i]
        return i

    tree = []
    for link in sorted(links, key=lambda link: link.rank):
        if find(link.a) != find(link.b):
            root[find(link.a)] = find(link.b)
            tree.append(link)
    return tree


def path(links: Sequence[Link], begin: int, end: int) -> list[Link]:
    """The links of a tree from one map to another; empty where they are not joined."""
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


def gap_of(links: Sequence[Link], begin: int) -> tuple[FloatArray, float]:
    """Where a ring of links ends that should end where it began: (3,) twist, and its squared sigmas.

    Links that share a map share its errors, in a way that they do not know. Whatever it is, the variance of a sum of n
    errors is at most n times the sum of their variances: that is what the gap is held against.
    """
    T, covariance, here = np.zeros(3), np.zeros((3, 3)), begin
    for link in links:
        here, T_here_there, own = link.transform_from(here)
        carried = se2.adjoint(se2.inverse(T_here_there))
        T = se2.compose(T, T_here_there)
        covariance = carried @ covariance @ carried.T + own
    gap = se2.log(T)
    return gap, float(gap @ np.linalg.solve(len(links) * covariance, gap))


_Ring = tuple[tuple[Link, Link, Link], tuple[FloatArray, float]]


def _triangles(links: Sequence[Link]) -> list[_Ring]:
    """All rings of three, and how they gape."""
    of = {frozenset((link.a, link.b)): link for link in links}
    partners: dict[int, set[int]] = {}
    for link in links:
        partners.setdefault(link.a, set()).add(link.b)
        partners.setdefault(link.b, set()).add(link.a)
    rings: list[_Ring] = []
    for i in sorted(partners):
        for j, k in combinations(sorted(p for p in partners[i] if p > i), 2):
            if k in partners[j]:
                ring = of[frozenset((i, j))], of[frozenset((j, k))], of[frozenset((k, i))]
                rings.append((ring, gap_of(ring, i)))
    return rings


def _worst(rings: Sequence[_Ring]) -> Link:
    """Of the links in rings that do not close, the one most often so, counted against those which do close."""
    against: dict[Link, int] = {}
    suspects: set[Link] = set()
    for members, (_, square) in rings:
        for link in members:
            against[link] = against.get(link, 0) + (1 if square > _GATE else -1)
        if square > _GATE:
            suspects.update(members)
    return max(suspects, key=lambda link: (against[link], link.rank))


def _contradiction(link: Link, rings: Sequence[_Ring]) -> Contradiction:
    """Told of the ring that gapes most."""
    members, (gap, square) = max((ring for ring in rings if link in ring[0]), key=lambda ring: ring[1][1])
    return Contradiction(link, tuple(sorted({m.a for m in members} | {m.b for m in members})), gap, square**0.5)


def _closing(links: Sequence[Link], contradictions: list[Contradiction]) -> list[Link]:
    """Without those that do not close with the tree; they are added to the contradictions."""
    tree = spanning_tree(links)
    kept = list(tree)
    for link in links:
        if link in tree:
            continue
        ring = [*path(tree, link.b, link.a), link]
        gap, square = gap_of(ring, link.b)
        if square <= _GATE:
            kept.append(link)
        else:
            members = tuple(sorted({m.a for m in ring} | {m.b for m in ring}))
            contradictions.append(Contradiction(link, members, gap, square**0.5))
    return kept
