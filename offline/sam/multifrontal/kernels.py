"""Compiled parts of `multifrontal.fronts`: layout of fronts, assembly, partial Cholesky factorisation, substitution.

Only the upper triangle of a front is used. Its eliminated rows become rows of R.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.foundation import (
    FloatBlocks,
    FloatMatrix,
    FloatVector,
    IntMatrix,
    IntVector,
    borrow,
    inner,
    njit,
)
from groundsbot.offline.sam.arrowhead.elimination import eliminate_columns

Unsigned = NDArray[np.uint64]


class Nodes(NamedTuple):
    """The N fronts, children before parents.

    Attributes:
        parent: (N,) parent node; -1 for the root.
        n_own: (N,) number of eliminated columns, the first ones of the front.
        start: (N + 1,) start of the front's columns in `columns`.
        offset: (N + 1,) start of the front's matrix in the entries.
        columns: (S,) columns of all fronts.
        in_parent: (S,) position of each column that is not eliminated in the parent's front.
    """

    parent: IntVector
    n_own: IntVector
    start: IntVector
    offset: IntVector
    columns: IntVector
    in_parent: IntVector


class Factors(NamedTuple):
    """The columns of F factors.

    Attributes:
        begin: (N + 1,) start of each node's factors in `order`.
        order: (F,) factors, sorted by the node that eliminates the first of their columns.
        start: (F + 1,) start of each factor's columns in `columns`.
        columns: columns of all factors, -1 where fixed.
        place: position of each column in its front, set by `lay_out_fronts`.
    """

    begin: IntVector
    order: IntVector
    start: IntVector
    columns: IntVector
    place: IntVector


class Kind(NamedTuple):
    """The positions of one kind of factor in the fronts.

    Attributes:
        columns: (M, k) columns, -1 where fixed.
        node: (M,) node whose front contains the matrix.
        place: (M, k) positions of the columns in that front, -1 where fixed.
    """

    columns: IntMatrix
    node: IntVector
    place: IntMatrix


class FrontalSystem(NamedTuple):
    """The normal equations by fronts: entries of all fronts, and the gradient (n,)."""

    nodes: Nodes
    entries: FloatVector
    gradient: FloatVector


@njit
def lay_out_fronts(factors: Factors, own_begin: IntVector, own: IntVector, nodes: Nodes) -> tuple[IntArray, IntArray]:
    """Compute `Nodes.columns` and `Nodes.in_parent`; set the starts of the nodes and the places of the factors.

    Args:
        factors: factors of all kinds.
        own_begin: (N + 1,) start of each node's columns in `own`.
        own: (n,) columns, sorted by the node that eliminates them.
        nodes: nodes with parents; starts are set.
    """
    n_nodes, n = len(nodes.parent), len(own)
    columns, in_parent = np.empty(2 * n + 64, dtype=np.int64), np.empty(2 * n + 64, dtype=np.int64)
    seen, at = np.full(n, -1), np.empty(n, dtype=np.int64)
    child, sibling = np.full(n_nodes, -1), np.full(n_nodes, -1)
    end = 0
    for i in range(n_nodes):
        first = end
        if end + n > len(columns):
            more = np.empty(len(columns) + n, dtype=np.int64)
            columns, in_parent = np.concatenate((columns, more)), np.concatenate((in_parent, more))
        nodes.start[i] = first
        for k in range(own_begin[i], own_begin[i + 1]):
            end = _add_column(own[k], i, seen, at, columns, first, end)
        for k in range(factors.begin[i], factors.begin[i + 1]):
            factor = factors.order[k]
            for c in range(factors.start[factor], factors.start[factor + 1]):
                if factors.columns[c] >= 0:
                    end = _add_column(factors.columns[c], i, seen, at, columns, first, end)
                    factors.place[c] = at[factors.columns[c]]
        below = child[i]
        while below >= 0:
            for c in range(nodes.start[below] + nodes.n_own[below], nodes.start[below + 1]):
                end = _add_column(columns[c], i, seen, at, columns, first, end)
                in_parent[c] = at[columns[c]]
            below = sibling[below]
        nodes.start[i + 1] = end
        if nodes.parent[i] >= 0:
            sibling[i], child[nodes.parent[i]] = child[nodes.parent[i]], i
    return columns[:end].copy(), in_parent[:end].copy()


@inner
def _add_column(
    column: int, node: int, seen: IntArray, at: IntArray, columns: IntArray, first: int, end: int
) -> int:  # fmt: skip
    """Add a column to a node's front unless it is there; return the front's new end."""
    if seen[column] == node:
        return end
    seen[column], at[column], columns[end] = node, end - first, column
    return end + 1


@njit
def assemble(kind: Kind, normal: FloatBlocks, system: FrontalSystem) -> None:
    """Add the normal matrices J^T W J (M, k, k) of all factors of one kind to the fronts that eliminate them."""
    kind, system = borrow(kind), borrow(system)
    width = kind.place.shape[1]
    free, place = np.empty(width, dtype=np.uint64), np.empty(width, dtype=np.uint64)
    for m in range(len(normal)):
        add_matrix(kind, m, normal[m], 0, width, system, free, place)


@inner
def add_matrix(
    kind: Kind,
    m: int,
    normal: FloatArray,
    first: int,
    last: int,
    system: FrontalSystem,
    free: Unsigned,
    place: Unsigned,
) -> None:
    """Add rows first to last - 1 of the upper triangle of one factor's normal matrix (k, k).

    Free and place are work arrays (k,), unsigned to avoid checks for negative indices.
    """
    node, n, end = kind.node[m], 0, 0
    begin, beyond = system.nodes.offset[node], system.nodes.offset[node + 1]
    front, size = system.entries[begin:beyond], np.uint64(system.nodes.start[node + 1] - system.nodes.start[node])
    for a in range(first, kind.place.shape[1]):
        if kind.place[m, a] >= 0:
            free[n], place[n] = a, kind.place[m, a]
            n += 1
            end = n if a < last else end
    for i in range(end):
        row, own = place[i], normal[free[i]]
        along = row * size
        front[along + row] += own[free[i]]
        for j in range(i + 1, n):
            column = place[j]
            # A repeated column has both mixed terms on the diagonal.
            value = own[free[j]] * (2.0 if row == column else 1.0)
            front[along + column if row < column else column * size + row] += value


@inner
def add_vector(kind: Kind, m: int, vector: FloatArray, out: FloatArray) -> None:
    """Add one factor's vector (k,) to out (n,), except for fixed columns."""
    for a in range(len(vector)):
        if kind.columns[m, a] >= 0:
            out[kind.columns[m, a]] += vector[a]


@inner
def _front(nodes: Nodes, i: int, entries: FloatArray) -> FloatArray:
    size = nodes.start[i + 1] - nodes.start[i]
    return entries[nodes.offset[i] : nodes.offset[i + 1]].reshape(size, size)


@njit
def add_vectors(kind: Kind, vectors: FloatMatrix, out: FloatVector) -> None:
    """Add vectors (M, k) of one kind of factor to out (n,), except for fixed columns."""
    kind = borrow(kind)
    for m in range(len(vectors)):
        add_vector(kind, m, vectors[m], out)


@njit
def factorise(nodes: Nodes, entries: FloatVector) -> int:
    """Factorise all fronts in place; return -1, or the column without a positive pivot."""
    nodes = borrow(nodes)
    for i in range(len(nodes.parent)):
        front, start, n_own = _front(nodes, i, entries), nodes.start[i], nodes.n_own[i]
        failed = eliminate_columns(front, n_own)
        if failed >= 0:
            return int(nodes.columns[start + failed])
        if nodes.parent[i] < 0:
            continue
        above = _front(nodes, nodes.parent[i], entries)
        for a in range(n_own, len(front)):
            row = nodes.in_parent[start + a]
            for b in range(a, len(front)):
                column = nodes.in_parent[start + b]
                above[min(row, column), max(row, column)] += front[a, b]
    return -1


@njit
def substitute_up(nodes: Nodes, entries: FloatVector, X: FloatMatrix) -> None:
    """Replace each row x of X (k, n) by R^-T x, all rows front by front for cache locality."""
    nodes = borrow(nodes)
    own = np.empty(_largest(nodes))  # a row's entries in a front, contiguous
    for i in range(len(nodes.parent)):
        front, columns = _front(nodes, i, entries), nodes.columns[nodes.start[i] : nodes.start[i + 1]]
        for c in range(len(X)):
            for k in range(len(columns)):
                own[k] = X[c, columns[k]]
            for k in range(nodes.n_own[i]):
                own[k] /= front[k, k]
                value, row, rest = own[k], front[k, k + 1 :], own[k + 1 : len(columns)]
                for j in range(len(row)):
                    rest[j] -= row[j] * value
            for k in range(len(columns)):
                X[c, columns[k]] = own[k]


@njit
def substitute_down(nodes: Nodes, entries: FloatVector, x: FloatVector) -> None:
    """Replace x (n,) by R^-1 x."""
    nodes = borrow(nodes)
    own = np.empty(_largest(nodes))
    for i in range(len(nodes.parent) - 1, -1, -1):
        front, columns = _front(nodes, i, entries), nodes.columns[nodes.start[i] : nodes.start[i + 1]]
        for k in range(len(columns)):
            own[k] = x[columns[k]]
        for k in range(nodes.n_own[i] - 1, -1, -1):
            own[k] = (own[k] - _product(front[k, k + 1 :], own[k + 1 : len(columns)])) / front[k, k]
            x[columns[k]] = own[k]


@inner
def _largest(nodes: Nodes) -> int:
    """Return the number of columns of the largest front."""
    largest = 0
    for i in range(len(nodes.parent)):
        largest = max(largest, nodes.start[i + 1] - nodes.start[i])
    return largest


@inner
def _product(a: FloatArray, b: FloatArray) -> float:
    """Return the dot product of a and b, with four independent sums for pipelining."""
    s0, s1, s2, s3, whole = 0.0, 0.0, 0.0, 0.0, len(a) - len(a) % 4
    for j in range(0, whole, 4):
        s0 += a[j] * b[j]
        s1 += a[j + 1] * b[j + 1]
        s2 += a[j + 2] * b[j + 2]
        s3 += a[j + 3] * b[j + 3]
    for j in range(whole, len(a)):
        s0 += a[j] * b[j]
    return (s0 + s1) + (s2 + s3)


@njit
def whiten(nodes: Nodes, entries: FloatVector, path: IntVector, row: IntVector, Z: FloatMatrix) -> None:
    """Replace Z (m, k) by R^-T Z.

    Args:
        nodes: nodes of R.
        entries: entries of R.
        path: nodes on the paths from nonzero rows to the root, in ascending order.
        row: (n,) row of Z for each column of these nodes; other entries are not used.
        Z: changed in place.
    """
    nodes = borrow(nodes)
    for i in path:
        front, columns = _front(nodes, i, entries), nodes.columns[nodes.start[i] : nodes.start[i + 1]]
        for k in range(nodes.n_own[i]):
            own = Z[row[columns[k]]]
            inverse = 1.0 / front[k, k]
            is_zero = True
            for c in range(len(own)):
                own[c] *= inverse
                is_zero &= own[c] == 0.0
            if is_zero:
                continue
            for j in range(k + 1, len(columns)):
                factor, other = front[k, j], Z[row[columns[j]]]
                if factor != 0.0:
                    for c in range(len(own)):
                        other[c] -= factor * own[c]
