"""A sparse symmetric system solved by fronts: the multifrontal method, on dense blocks that LAPACK eliminates.

Columns are eliminated at the nodes of a tree, children before parents. A node's front holds its own columns and those
further up that its factors, or what its children left over, couple them with. Duff and Reid, "The multifrontal solution
of indefinite sparse symmetric linear equations" (1983).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import linalg

from calib.arrays import FloatArray, IntArray


class NotPositiveError(ValueError):
    """A matrix without a square root: something is not tied down."""


@dataclass(frozen=True)
class Front:
    """One node: its own columns, then those further up; where these are in its parent's front."""

    columns: IntArray
    n_own: int
    parent: int
    in_parent: IntArray
    offset: int  # of its matrix among all fronts' entries


@dataclass(frozen=True)
class Fronts:
    """The order of elimination, and where each entry of each factor's normal matrix goes.

    Attributes:
        n: number of columns.
        fronts: children before parents; the last one is the root.
        entries: for each kind of factor (M, k, k) positions among all fronts' entries.
        columns: for each kind of factor (M, k).
        n_entries: of all fronts; the position n_entries takes what is held.
    """

    n: int
    fronts: tuple[Front, ...]
    entries: tuple[IntArray, ...]
    columns: tuple[IntArray, ...]
    n_entries: int

    @cached_property
    def diagonal(self) -> IntArray:
        """(n,) position of each column's diagonal entry in the front that eliminates it."""
        at = np.empty(self.n, dtype=np.int64)
        for front in self.fronts:
            at[front.columns[: front.n_own]] = front.offset + np.arange(front.n_own) * (len(front.columns) + 1)
        return at

    def assembled(self, normals: Sequence[FloatArray]) -> FloatArray:
        """All fronts' entries from the normal matrices (M, k, k) of each kind of factor."""
        total = np.zeros(self.n_entries + 1)
        for entries, normal in zip(self.entries, normals, strict=True):
            total += np.bincount(entries.reshape(-1), normal.reshape(-1), len(total))
        return total[:-1]

    def summed(self, vectors: Sequence[FloatArray]) -> FloatArray:
        """(n,) from the vectors (M, k) of each kind of factor."""
        flat = np.concatenate([columns.reshape(-1) for columns in self.columns])
        values = np.concatenate([vector.reshape(-1) for vector in vectors])
        held = flat < 0
        total: FloatArray = np.bincount(np.where(held, self.n, flat), values, self.n + 1)[:-1].astype(np.float64)
        return total

    def factorise(self, entries: FloatArray, raised: FloatArray | None = None) -> "FrontFactor":
        """R with R^T R the matrix, its diagonal raised by (n,).

        Raises:
            NotPositiveError: it has none.
        """
        entries = entries.copy()
        if raised is not None:
            entries[self.diagonal] += raised
        matrices = [entries[f.offset : f.offset + len(f.columns) ** 2].reshape(len(f.columns), -1) for f in self.fronts]
        lowers, rows = [], []
        for front, matrix in zip(self.fronts, matrices, strict=True):
            k = front.n_own
            lower, above = matrix[:k, :k], matrix[:k, k:]
            if k:
                lower, info = linalg.lapack.dpotrf(lower, lower=1)
                if info:
                    raise NotPositiveError(f"column {front.columns[max(info - 1, 0)]} has no positive pivot")
                above = _solved(lower, above)
            if front.parent >= 0 and len(front.in_parent):
                parent = matrices[front.parent]
                parent[np.ix_(front.in_parent, front.in_parent)] += matrix[k:, k:] - above.T @ above
            lowers.append(lower)
            rows.append(above)
        return FrontFactor(self, tuple(lowers), tuple(rows))


@dataclass(frozen=True)
class FrontFactor:
    """R with R^T R = H, by fronts: R^T of the own columns, and their rows in the columns further up."""

    order: Fronts
    lowers: tuple[FloatArray, ...]
    rows: tuple[FloatArray, ...]

    def solve(self, vector: FloatArray) -> FloatArray:
        """H^-1 vector (n,)."""
        x = vector.copy()
        for front, lower, above in zip(self.order.fronts, self.lowers, self.rows, strict=True):
            own, up = front.columns[: front.n_own], front.columns[front.n_own :]
            x[own] = _solved(lower, x[own])
            x[up] -= x[own] @ above
        for front, lower, above in zip(self.order.fronts[::-1], self.lowers[::-1], self.rows[::-1], strict=True):
            own, up = front.columns[: front.n_own], front.columns[front.n_own :]
            x[own] = _solved(lower, x[own] - above @ x[up], transposed=True)
        return x

    def log_determinant(self) -> float:
        """Of H."""
        return 2.0 * float(sum(np.log(np.diagonal(lower)).sum() for lower in self.lowers))

    def covariance(self, columns: IntArray) -> FloatArray:
        """Joint covariance (k, k) of k columns: their block of H^-1; 0 where held (-1).

        E^T H^-1 E = Z^T Z with R^T Z = E, and a column of Z is zero but on the path from its node to the root.
        """
        free = np.flatnonzero(columns >= 0)
        x = np.zeros((self.order.n, len(free)))
        x[columns[free], np.arange(len(free))] = 1.0
        inner = np.zeros((len(free), len(free)))
        for front, lower, above in zip(self.order.fronts, self.lowers, self.rows, strict=True):
            own, up = front.columns[: front.n_own], front.columns[front.n_own :]
            active = np.flatnonzero(x[own].any(axis=0))
            if not len(active):
                continue
            z = _solved(lower, x[np.ix_(own, active)])
            x[np.ix_(up, active)] -= above.T @ z
            inner[np.ix_(active, active)] += z.T @ z
        covariance = np.zeros((len(columns), len(columns)))
        covariance[np.ix_(free, free)] = inner
        return covariance


def _solved(lower: FloatArray, right: FloatArray, *, transposed: bool = False) -> FloatArray:
    """L^-1 or L^-T times a vector or matrix; either may be empty, which LAPACK would refuse."""
    if not right.size:
        return right
    solution: FloatArray = linalg.lapack.dtrtrs(lower, right, lower=1, trans=int(transposed))[0]
    return solution


def build_fronts(n: int, node_of: IntArray, parent: IntArray, kinds: Sequence[IntArray]) -> Fronts:
    """Settles the fronts.

    Args:
        n: number of columns.
        node_of: (n,) the node that eliminates each column.
        parent: (N,) of each node, a later one; -1 for the root, which is the last.
        kinds: for each kind of factor (M, k) its columns, -1 where held; those of one factor lie on one path to the
            root.
    """
    n_nodes = len(parent)
    nodes = [_node_of_factors(columns, node_of, n_nodes) for columns in kinds]
    coupled = np.unique(
        np.concatenate(
            [(node[:, None] * n + columns)[columns >= 0] for node, columns in zip(nodes, kinds, strict=True)]
            + [node_of * n + np.arange(n)]
        )
    )
    members: list[IntArray] = np.split(coupled % n, np.searchsorted(coupled // n, np.arange(1, n_nodes)))
    sorted_members: list[IntArray] = []
    fronts, offset = [], 0
    pending: list[list[IntArray]] = [[] for _ in range(n_nodes)]
    for i in range(n_nodes):
        own_and_up = np.unique(np.concatenate([members[i], *pending[i]])) if pending[i] else members[i]
        is_own = node_of[own_and_up] == i
        columns = np.concatenate([own_and_up[is_own], own_and_up[~is_own]])
        if parent[i] >= 0:
            pending[parent[i]].append(own_and_up[~is_own])
        fronts.append((columns, int(is_own.sum()), offset))
        sorted_members.append(own_and_up)
        offset += len(columns) ** 2
    keys = np.concatenate([i * n + columns for i, (columns, _, _) in enumerate(fronts)])
    order = np.argsort(keys)
    place = np.concatenate([np.arange(len(columns)) for columns, _, _ in fronts])[order]
    keys = keys[order]

    def places(node: IntArray, columns: IntArray) -> IntArray:
        return np.asarray(place[np.minimum(np.searchsorted(keys, node * n + columns), len(keys) - 1)])

    whole = tuple(
        Front(
            columns,
            n_own,
            int(parent[i]),
            places(np.full(len(columns) - n_own, parent[i]), columns[n_own:]) if parent[i] >= 0 else columns[:0],
            first,
        )
        for i, (columns, n_own, first) in enumerate(fronts)
    )
    sizes, offsets = np.array([len(f.columns) for f in whole]), np.array([f.offset for f in whole])
    entries = []
    for node, columns in zip(nodes, kinds, strict=True):
        at = places(node[:, None], np.maximum(columns, 0) if columns.size else columns)
        held = columns < 0
        flat = offsets[node][:, None, None] + at[:, :, None] * sizes[node][:, None, None] + at[:, None, :]
        flat[held[:, :, None] | held[:, None, :]] = offset
        entries.append(flat)
    return Fronts(n, whole, tuple(entries), tuple(kinds), offset)


def _node_of_factors(columns: IntArray, node_of: IntArray, n_nodes: int) -> IntArray:
    """(M,) where the first of each factor's columns is eliminated; the root where all are held."""
    nodes = np.where(columns >= 0, node_of[np.maximum(columns, 0)], n_nodes - 1)
    return np.asarray(nodes.min(axis=1, initial=n_nodes - 1))


def common_ancestor(nodes: Sequence[int], parent: IntArray) -> int:
    """The lowest node on the paths of all to the root."""
    left = set(nodes)
    while len(left) > 1:
        first = min(left)
        left.remove(first)
        left.add(int(parent[first]))
    return left.pop()
