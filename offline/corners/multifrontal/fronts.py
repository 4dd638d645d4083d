"""A sparse symmetric system solved by fronts: the multifrontal method, on dense blocks (`multifrontal.kernels`).

Columns are eliminated at the nodes of a tree, children before parents. A node's front holds its own columns and those
further up that its factors, or what its children left over, couple them with. Duff and Reid, "The multifrontal solution
of indefinite sparse symmetric linear equations" (1983).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray
from groundsbot.offline.corners.multifrontal.kernels import (
    Factors,
    FrontalSystem,
    Kind,
    Nodes,
    add_vectors,
    assemble,
    factorise,
    settle,
    substitute_down,
    substitute_up,
    whiten,
)


class Normal(NamedTuple):
    """J^T W J (M, k, k) and J^T W r (M, k) of a kind of factor."""

    matrix: FloatArray
    gradient: FloatArray


class NotPositiveError(ValueError):
    """A matrix without a square root: something is not tied down."""


@dataclass(frozen=True)
class EliminationFronts:
    """The order of elimination, and where each entry of each factor's normal matrix goes.

    Attributes:
        n: number of columns.
        nodes: their fronts, children before parents; the last one is the root.
        kinds: of factors.
    """

    n: int
    nodes: Nodes
    kinds: tuple[Kind, ...]

    @cached_property
    def _diagonals(self) -> tuple[IntArray, BoolArray]:
        """(S,) positions of all fronts' diagonal entries, and which are of the front's own columns."""
        nodes, sizes = self.nodes, np.diff(self.nodes.start)
        of_column = np.repeat(np.arange(len(sizes)), sizes)
        place = np.arange(len(nodes.columns)) - nodes.start[of_column]
        return nodes.offset[of_column] + place * (sizes[of_column] + 1), place < nodes.n_own[of_column]

    @property
    def is_own(self) -> BoolArray:
        """(S,) which columns of the fronts are eliminated there."""
        return self._diagonals[1]

    @cached_property
    def diagonal(self) -> IntArray:
        """(n,) position of each column's diagonal entry in the front that eliminates it."""
        positions, is_own = self._diagonals
        at = np.empty(self.n, dtype=np.int64)
        at[self.nodes.columns[is_own]] = positions[is_own]
        return at

    def diagonal_of(self, system: FrontalSystem) -> FloatArray:
        """(n,) of the whole matrix, of which each front has what its factors add."""
        total: FloatArray = np.bincount(self.nodes.columns, system.entries[self._diagonals[0]], self.n).astype(
            np.float64
        )
        return total

    @property
    def n_bytes(self) -> int:
        """What the entries of a matrix take, or of its factor."""
        return 8 * int(self.nodes.offset[-1])

    def empty(self, *, is_whole: bool = True) -> FrontalSystem:
        """Zeros for factors to be added to; without room for matrices unless all is wanted."""
        return FrontalSystem(self.nodes, np.zeros(self.nodes.offset[-1] if is_whole else 0), np.zeros(self.n))

    def add(self, system: FrontalSystem, first: int, normals: Sequence[Normal]) -> None:
        """Adds the normal equations of kinds of factors, from the first of these on; no matrices without room."""
        for kind, normal in zip(self.kinds[first:], normals, strict=False):
            if not len(normal.gradient):
                continue
            add_vectors(kind, normal.gradient, system.gradient)
            if len(system.entries):
                assemble(kind, normal.matrix, system)

    def factorise(self, system: FrontalSystem, raised: FloatArray | None = None) -> "FrontFactor":
        """R with R^T R the matrix; R takes the place of the system's entries.

        Args:
            system: complete.
            raised: (n,) added to the diagonal.

        Raises:
            NotPositiveError: it has none.
        """
        if raised is not None:
            system.entries[self.diagonal] += raised
        failed = factorise(self.nodes, system.entries)
        if failed >= 0:
            raise NotPositiveError(f"column {failed} has no positive pivot")
        return FrontFactor(self, system.entries)


@dataclass(frozen=True)
class FrontFactor:
    """R with R^T R = H: in each front the rows of its own columns."""

    order: EliminationFronts
    entries: FloatArray

    def solve(self, vector: FloatArray) -> FloatArray:
        """H^-1 vector (n,)."""
        x: FloatArray = self.whiten(vector[None])[0]
        substitute_down(self.order.nodes, self.entries, x)
        return x

    def whiten(self, vectors: FloatArray) -> FloatArray:
        """R^-T of each of some vectors (k, n): their products with each other are those by H^-1 of the vectors."""
        Z = vectors.copy()
        substitute_up(self.order.nodes, self.entries, Z)
        return Z

    def log_determinant(self) -> float:
        """Of H."""
        return 2.0 * float(np.log(self.entries[self.order.diagonal]).sum())

    def covariance(self, columns: IntArray) -> FloatArray:
        """Joint covariance (k, k) of k columns: their block of H^-1; 0 where held (-1).

        E^T H^-1 E = Z^T Z with R^T Z = E, and a column of Z is zero but on the path from its node to the root.
        """
        nodes, free = self.order.nodes, np.flatnonzero(columns >= 0)
        wanted = np.zeros(self.order.n, dtype=np.bool_)
        wanted[columns[free]] = True
        on_path = np.zeros(len(nodes.parent), dtype=np.bool_)
        of_front, is_own = np.repeat(np.arange(len(nodes.parent)), np.diff(nodes.start)), self.order.is_own
        on_path[of_front[is_own & wanted[nodes.columns]]] = True
        for i, above in enumerate(nodes.parent.tolist()):
            on_path[above] |= on_path[i]
        rows = nodes.columns[is_own & on_path[of_front]]
        row = np.full(self.order.n, -1)
        row[rows] = np.arange(len(rows))
        Z = np.zeros((len(rows), len(free)))
        Z[row[columns[free]], np.arange(len(free))] = 1.0
        whiten(nodes, self.entries, np.flatnonzero(on_path), row, Z)
        if len(free) == len(columns):
            return np.asarray(Z.T @ Z)
        covariance = np.zeros((len(columns), len(columns)))
        covariance[np.ix_(free, free)] = Z.T @ Z
        return covariance


def build_fronts(n: int, node_of: IntArray, parent: IntArray, kinds: Sequence[IntArray]) -> EliminationFronts:
    """Settles the fronts.

    Args:
        n: number of columns.
        node_of: (n,) the node that eliminates each column.
        parent: (N,) of each node, a later one; -1 for the root, which is the last.
        kinds: for each kind of factor (M, k) its columns, -1 where held; those of one factor lie on one path to the
            root.
    """
    n_nodes = len(parent)
    kinds = [np.ascontiguousarray(columns) for columns in kinds]
    node = [_node_of_factors(columns, node_of, n_nodes) for columns in kinds]
    flat = np.concatenate([columns.reshape(-1) for columns in kinds])
    lengths = np.concatenate([np.full(len(columns), columns.shape[1]) for columns in kinds])
    of_factor = np.concatenate(node)
    factors = Factors(
        _begins(of_factor, n_nodes), np.argsort(of_factor, kind="stable"), _ends(lengths), flat, np.full(len(flat), -1)
    )
    own_begin = _begins(node_of, n_nodes)
    nodes = Nodes(
        np.ascontiguousarray(parent), np.diff(own_begin), np.zeros(n_nodes + 1, dtype=np.int64), flat[:0], flat[:0],
        flat[:0],
    )  # fmt: skip
    columns, in_parent = settle(factors, own_begin, np.argsort(node_of, kind="stable"), nodes)
    nodes = nodes._replace(offset=_ends(np.diff(nodes.start) ** 2), columns=columns, in_parent=in_parent)
    bounds = np.cumsum([columns.size for columns in kinds])[:-1]
    places = np.split(factors.place, bounds)
    found = [Kind(own, at, each.reshape(own.shape)) for own, at, each in zip(kinds, node, places, strict=True)]
    return EliminationFronts(n, nodes, tuple(found))


def _begins(node: IntArray, n_nodes: int) -> IntArray:
    """(N + 1,) where each node's own begin among all, sorted."""
    return _ends(np.bincount(node, minlength=n_nodes))


def _ends(lengths: IntArray) -> IntArray:
    return np.concatenate([[0], np.cumsum(lengths)])


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
