"""Compiled parts of `fronts`: which columns meet in which front, their Cholesky factors, substitution.

Of a front's matrix only what is on and above the diagonal is used; where columns are eliminated it becomes rows of R.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.foundation import borrow, inner, njit
from groundsbot.offline.sam import eliminate_columns

Unsigned = NDArray[np.uint64]


class Nodes(NamedTuple):
    """N fronts, children before parents.

    Attributes:
        parent: (N,), -1 for the root; n_own: (N,) of the front's columns, which come first.
        start: (N + 1,) of its columns in `columns`; offset: (N + 1,) of its matrix among all entries.
        columns: (S,); in_parent: (S,) where those further up are in the parent's front.
    """

    parent: IntArray
    n_own: IntArray
    start: IntArray
    offset: IntArray
    columns: IntArray
    in_parent: IntArray


class Factors(NamedTuple):
    """Which columns F factors couple.

    Attributes:
        begin: (N + 1,) into `order`, (F,) factors by the node that eliminates the first of their columns.
        start: (F + 1,) into `columns`, -1 where held; place: of each column in its front, set by `settle`.
    """

    begin: IntArray
    order: IntArray
    start: IntArray
    columns: IntArray
    place: IntArray


class Kind(NamedTuple):
    """Where the numbers of one kind of factor go.

    Attributes:
        columns: (M, k), -1 where held.
        node: (M,) whose front takes the matrix; place: (M, k) of the columns there, -1 where held.
    """

    columns: IntArray
    node: IntArray
    place: IntArray


class FrontalSystem(NamedTuple):
    """Normal equations by fronts: all entries, and the gradient (n,)."""

    nodes: Nodes
    entries: FloatArray
    gradient: FloatArray


@njit
def settle(factors: Factors, own_begin: IntArray, own: IntArray, nodes: Nodes) -> tuple[IntArray, IntArray]:
    """The columns of all fronts, and where they are in their parents'; sets the nodes' starts and the factors' places.

    Args:
        factors: of all kinds.
        own_begin: (N + 1,) into `own`.
        own: (n,) columns by the node that eliminates them.
        nodes: with parents; starts are set.
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
            end = _take(own[k], i, seen, at, columns, first, end)
        for k in range(factors.begin[i], factors.begin[i + 1]):
            factor = factors.order[k]
            for c in range(factors.start[factor], factors.start[factor + 1]):
                if factors.columns[c] >= 0:
                    end = _take(factors.columns[c], i, seen, at, columns, first, end)
                    factors.place[c] = at[factors.columns[c]]
        below = child[i]
        while below >= 0:
            for c in range(nodes.start[below] + nodes.n_own[below], nodes.start[below + 1]):
                end = _take(columns[c], i, seen, at, columns, first, end)
                in_parent[c] = at[columns[c]]
            below = sibling[below]
        nodes.start[i + 1] = end
        if nodes.parent[i] >= 0:
            sibling[i], child[nodes.parent[i]] = child[nodes.parent[i]], i
    return columns[:end].copy(), in_parent[:end].copy()


@inner
def _take(
    column: int, node: int, seen: IntArray, at: IntArray, columns: IntArray, first: int, end: int
) -> int:  # fmt: skip
    """Adds a column to a node's front unless it is there; the front's new end."""
    if seen[column] == node:
        return end
    seen[column], at[column], columns[end] = node, end - first, column
    return end + 1


@njit
def assemble(kind: Kind, normal: FloatArray, system: FrontalSystem) -> None:
    """Adds normal matrices (M, k, k) of a kind of factor."""
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
    """Adds rows from the first to before the last of one factor's normal matrix (k, k), on and above the diagonal.

    Free and place are (k,) room, unsigned to spare a look at each sign.
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
            # The same column twice: both its mixed terms are on the diagonal.
            value = own[free[j]] * (2.0 if row == column else 1.0)
            front[along + column if row < column else column * size + row] += value


@inner
def add_vector(kind: Kind, m: int, vector: FloatArray, out: FloatArray) -> None:
    """Adds one factor's vector (k,) to (n,), but for what is held."""
    for a in range(len(vector)):
        if kind.columns[m, a] >= 0:
            out[kind.columns[m, a]] += vector[a]


@inner
def _front(nodes: Nodes, i: int, entries: FloatArray) -> FloatArray:
    size = nodes.start[i + 1] - nodes.start[i]
    return entries[nodes.offset[i] : nodes.offset[i + 1]].reshape(size, size)


@njit
def add_vectors(kind: Kind, vectors: FloatArray, out: FloatArray) -> None:
    """Adds (M, k) of a kind of factor to (n,), but for what is held."""
    kind = borrow(kind)
    for m in range(len(vectors)):
        add_vector(kind, m, vectors[m], out)


@njit
def factorise(nodes: Nodes, entries: FloatArray) -> int:
    """Fronts become rows of R; -1, or the column that has no positive pivot."""
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
def substitute_up(nodes: Nodes, entries: FloatArray, X: FloatArray) -> None:
    """Each row of X (k, n) <- R^-T row. All go through a front while it is at hand."""
    nodes = borrow(nodes)
    own = np.empty(_largest(nodes))  # of a row, what a front has: side by side
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
def substitute_down(nodes: Nodes, entries: FloatArray, x: FloatArray) -> None:
    """X (n,) <- R^-1 x."""
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
    """Columns of the largest front."""
    largest = 0
    for i in range(len(nodes.parent)):
        largest = max(largest, nodes.start[i + 1] - nodes.start[i])
    return largest


@inner
def _product(a: FloatArray, b: FloatArray) -> float:
    """Sum of a times b, four at once: one sum alone waits for each addition."""
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
def whiten(nodes: Nodes, entries: FloatArray, path: IntArray, row: IntArray, Z: FloatArray) -> None:
    """Z (m, k) <- R^-T Z.

    Args:
        nodes: of R.
        entries: of R.
        path: the nodes on the way to the root from where anything begins, rising.
        row: (n,) of each of their columns in Z; others do not matter.
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
