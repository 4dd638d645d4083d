"""Multifrontal Cholesky factorisation of a sparse symmetric system, on dense blocks (`multifrontal.kernels`).

Columns are eliminated at the nodes of a tree, children before parents. A node's front contains its own columns and the
columns of ancestors that they are coupled with, by factors or by Schur complements of children. See Duff and Reid, "The
multifrontal solution of indefinite sparse symmetric linear equations" (1983).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray
from groundsbot.offline.sam.multifrontal.kernels import (
    Factors,
    FrontalSystem,
    Kind,
    Nodes,
    add_vectors,
    assemble,
    factorise,
    lay_out_fronts,
    substitute_down,
    substitute_up,
    whiten,
)


class Normal(NamedTuple):
    """The normal equations J^T W J (M, k, k) and J^T W r (M, k) of one kind of factor."""

    matrix: FloatArray
    gradient: FloatArray


class NotPositiveError(ValueError):
    """The error of a matrix that is not positive definite, since not all variables are observable."""


@dataclass(frozen=True)
class EliminationFronts:
    """The order of elimination, and the position of each factor's normal matrix in the fronts.

    Attributes:
        n: number of columns.
        nodes: fronts, children before parents; the last one is the root.
        kinds: kinds of factors.
    """

    n: int
    nodes: Nodes
    kinds: tuple[Kind, ...]

    @cached_property
    def _diagonals(self) -> tuple[IntArray, BoolArray]:
        """Positions (S,) of the diagonal entries of all fronts, and a mask (S,) of the fronts' own columns."""
        nodes, sizes = self.nodes, np.diff(self.nodes.start)
        of_column = np.repeat(np.arange(len(sizes)), sizes)
        place = np.arange(len(nodes.columns)) - nodes.start[of_column]
        return nodes.offset[of_column] + place * (sizes[of_column] + 1), place < nodes.n_own[of_column]

    @property
    def is_own(self) -> BoolArray:
        """Mask (S,) of the columns of fronts that are eliminated there."""
        return self._diagonals[1]

    @cached_property
    def diagonal(self) -> IntArray:
        """Position (n,) of each column's diagonal entry in the front that eliminates it."""
        positions, is_own = self._diagonals
        at = np.empty(self.n, dtype=np.int64)
        at[self.nodes.columns[is_own]] = positions[is_own]
        return at

    def diagonal_of(self, system: FrontalSystem) -> FloatArray:
        """Return the diagonal (n,) of the assembled matrix, summed over all fronts."""
        total: FloatArray = np.bincount(self.nodes.columns, system.entries[self._diagonals[0]], self.n).astype(
            np.float64
        )
        return total

    @property
    def n_bytes(self) -> int:
        """Size of the entries of a matrix, or of its factor, in bytes."""
        return 8 * int(self.nodes.offset[-1])

    def empty(self, *, is_whole: bool = True) -> FrontalSystem:
        """Return a system of zeros, without matrices unless `is_whole`."""
        return FrontalSystem(self.nodes, np.zeros(self.nodes.offset[-1] if is_whole else 0), np.zeros(self.n))

    def add(self, system: FrontalSystem, first: int, normals: Sequence[Normal]) -> None:
        """Add normal equations of consecutive kinds from `first` on; only gradients if the system has no matrices."""
        for kind, normal in zip(self.kinds[first:], normals, strict=False):
            if not len(normal.gradient):
                continue
            add_vectors(kind, normal.gradient, system.gradient)
            if len(system.entries):
                assemble(kind, normal.matrix, system)

    def factorise(self, system: FrontalSystem, raised: FloatArray | None = None) -> "FrontFactor":
        """Factorise the matrix as R^T R; R overwrites the system's entries.

        Args:
            system: system with matrices.
            raised: (n,) values that are added to the diagonal.

        Raises:
            NotPositiveError: the matrix is not positive definite.
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
        """Return H^-1 vector (n,)."""
        x: FloatArray = self.whiten(vector[None])[0]
        substitute_down(self.order.nodes, self.entries, x)
        return x

    def whiten(self, vectors: FloatArray) -> FloatArray:
        """Return Z = (R^-T V^T)^T of vectors V (k, n), such that Z Z^T = V H^-1 V^T."""
        Z = vectors.copy()
        substitute_up(self.order.nodes, self.entries, Z)
        return Z

    def log_determinant(self) -> float:
        """Return the log determinant of H."""
        return 2.0 * float(np.log(self.entries[self.order.diagonal]).sum())

    def covariance(self, columns: IntArray) -> FloatArray:
        """Return the joint covariance (k, k) of k columns, their block of H^-1; 0 where fixed (-1).

        E^T H^-1 E = Z^T Z with R^T Z = E, and a column of Z is nonzero only on the path from its node to the root.
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
    """Lay out the fronts.

    Args:
        n: number of columns.
        node_of: (n,) node that eliminates each column.
        parent: (N,) parent of each node, a later node; -1 for the root, which is the last.
        kinds: columns (M, k) of each kind of factor, -1 where fixed; those of one factor must be on one path to the
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
    columns, in_parent = lay_out_fronts(factors, own_begin, np.argsort(node_of, kind="stable"), nodes)
    nodes = nodes._replace(offset=_ends(np.diff(nodes.start) ** 2), columns=columns, in_parent=in_parent)
    bounds = np.cumsum([columns.size for columns in kinds])[:-1]
    places = np.split(factors.place, bounds)
    found = [Kind(own, at, each.reshape(own.shape)) for own, at, each in zip(kinds, node, places, strict=True)]
    return EliminationFronts(n, nodes, tuple(found))


def _begins(node: IntArray, n_nodes: int) -> IntArray:
    """Return the start (N + 1,) of each node's entries in the sorted list."""
    return _ends(np.bincount(node, minlength=n_nodes))


def _ends(lengths: IntArray) -> IntArray:
    return np.concatenate([[0], np.cumsum(lengths)])


def _node_of_factors(columns: IntArray, node_of: IntArray, n_nodes: int) -> IntArray:
    """Return the node (M,) that eliminates the first of each factor's columns; the root if all are fixed."""
    nodes = np.where(columns >= 0, node_of[np.maximum(columns, 0)], n_nodes - 1)
    return np.asarray(nodes.min(axis=1, initial=n_nodes - 1))


def common_ancestor(nodes: Sequence[int], parent: IntArray) -> int:
    """Return the lowest common ancestor of nodes."""
    remaining = set(nodes)
    while len(remaining) > 1:
        first = min(remaining)
        remaining.remove(first)
        remaining.add(int(parent[first]))
    return remaining.pop()
