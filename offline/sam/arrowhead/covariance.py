"""Joint covariances of any columns from the square-root factor R.

With E the requested columns of the identity, E^T H^-1 E = Z^T Z where R^T Z = E. A column of Z is nonzero only on the
path from its node to the top. A tag in the top therefore needs one triangular solve there, and a pose a few small ones
more.
"""

import heapq
from collections.abc import Iterator
from typing import Any, Final, NamedTuple

import numpy as np
from scipy import linalg, sparse

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.sam.arrowhead import substitution
from groundsbot.offline.sam.arrowhead.tree import Tree
from groundsbot.offline.sam.linearisation.blocks import NormalEquations, SquareRootFactor

_AT_ONCE: Final = 1024
_COLUMNS: Final = 256  # of the top at once
# Z is dense, with products ten times as fast, if it is small or if a sparse Z would take more than half the memory.
_FEW: Final = 2**22
_SPARSE: Final = 3


class SquareRoot(NamedTuple):
    """A matrix Z such that Z^T Z is a block (k, k) of H^-1.

    Attributes:
        top: (t, k) rows of the top, or all rows if Z is dense.
        below: (m, k) rows of the other nodes.
    """

    top: FloatArray
    below: sparse.csc_array

    def times(self, vectors: FloatArray) -> FloatArray:
        """Return the block of H^-1 times vectors (k, n)."""
        product: FloatArray = self.top.T @ (self.top @ vectors)
        return product + self.below.T @ (self.below @ vectors) if self.below.shape[0] else product

    def of(self, columns: IntArray) -> "SquareRoot":
        """Return the square root of the block of some columns."""
        return SquareRoot(self.top[:, columns], self.below[:, columns] if self.below.shape[0] else self.below)

    def sum_columns(self, columns: sparse.csc_array) -> "SquareRoot":
        """Return Z times a sparse matrix (k, n)."""
        below = sparse.csc_array(self.below @ columns) if self.below.shape[0] else self.below
        top = np.empty((len(self.top), columns.shape[1]))
        for begin in range(0, len(top), _AT_ONCE):  # bounds the copy of rows
            some = slice(begin, begin + _AT_ONCE)
            top[some] = (columns.T @ self.top[some].T).T
        return SquareRoot(top, below)

    def against(self, other: "SquareRoot") -> FloatArray:
        """Return Z^T Z', the block of H^-1 between these columns and those of another square root."""
        product: FloatArray = self.top.T @ other.top
        for begin in range(0, len(product) if self.below.shape[0] else 0, _AT_ONCE):  # bounds the sparse products
            some = slice(begin, begin + _AT_ONCE)
            product[some] += (self.below[:, some].T @ other.below).toarray()
        return product


def joint_covariance(
    tree: Tree, system: NormalEquations, rows: SquareRootFactor, top: FloatArray, wanted: IntArray, first: int = 0
) -> FloatArray:
    """Return the last columns (k, k - first) of the block (k, k) of H^-1; 0 where a column is -1.

    The part of the top's columns in Z, as large as the block, is never held: with V the right-hand sides in the top,
    some columns of V^T (R^T R)^-1 V are computed at a time.

    Args:
        tree: order of elimination.
        system: normal equations.
        rows: rows of R.
        top: lower triangular R^T of the top.
        wanted: (k,) columns in the arrowhead's order.
        first: column of the block from which on it is wanted.
    """
    block, free = np.zeros((len(wanted), len(wanted) - first)), np.flatnonzero(wanted >= 0)
    pending: list[_RightHandSides] = []
    for node, which in ((node, free[own]) for node, own in _by_node(tree, wanted[free])):
        if tree.level[node] == 0:
            inner, right = _through_leaf(tree, system, rows, node, which, wanted)
            last = which >= first
            block[np.ix_(which, which[last] - first)] += inner[:, last]
            pending.append(right)
        else:
            pending.append(_identity(tree, node, which, wanted))
    in_top: list[_RightHandSides] = []
    for _, which, Z in _propagate(tree, rows, pending, in_top):
        last = which >= first
        block[np.ix_(which, which[last] - first)] += Z.T @ Z[:, last]
    for which, values in _columns_in_top(len(top), in_top, first) if len(top) else ():
        solved, _ = linalg.lapack.dpotrs(top, values, lower=1, overwrite_b=1)
        for each in in_top:
            own = each.values.T @ solved[each.rows] if each.ones is None else solved[each.ones]
            block[np.ix_(each.which, which - first)] += own
    if not first:
        _make_symmetric(block)
    return block


def pair_covariances(tree: Tree, rows: SquareRootFactor, top: FloatArray, wanted: IntArray) -> FloatArray:
    """Return the blocks (k, 2, 2) of H^-1 of pairs of columns, which must be of tags.

    Args:
        tree: order of elimination.
        rows: rows of R.
        top: lower triangular R^T of the top.
        wanted: (k, 2) columns in the arrowhead's order.
    """
    pairs = np.zeros((len(wanted), 2, 2))
    columns = wanted.reshape(-1)
    pending = [_identity(tree, node, which, columns) for node, which in _by_node(tree, columns)]
    for _, which, Z in _propagate_to_top(tree, rows, top, pending):
        own = Z.reshape(len(Z), len(which) // 2, 2)  # both columns of a tag are next to each other
        pairs[which[::2] // 2] += np.einsum("nki,nkj->kij", own, own)
    return pairs


def _make_symmetric(square: FloatArray) -> None:
    """Replace a matrix by the mean of it and its transpose, without a copy."""
    for begin in range(0, len(square), _AT_ONCE):
        some = slice(begin, begin + _AT_ONCE)
        mean = square[some, begin:] + square[begin:, some].T
        mean *= 0.5
        square[some, begin:] = mean
        square[begin:, some] = mean.T


def square_root(tree: Tree, rows: SquareRootFactor, top: FloatArray, wanted: IntArray) -> SquareRoot:
    """Return the square root of the block of H^-1 of tags and calibration; smaller than the block if k is large.

    Args:
        tree: order of elimination.
        rows: rows of R.
        top: lower triangular R^T of the top.
        wanted: (k,) columns of tags or calibration in the arrowhead's order.
    """
    pending = [_identity(tree, node, which, wanted) for node, which in _by_node(tree, wanted)]
    last = len(tree.level) - 1
    n_columns = _columns_by_node(tree, pending)
    n_rows = {node: len(top) if node == last else int(tree.n_eliminated[node]) for node in n_columns}
    n_values = sum(n_rows[node] * n for node, n in n_columns.items())
    is_dense = sum(n_rows.values()) * len(wanted) < max(_FEW, _SPARSE * n_values)
    in_top = np.zeros((sum(n_rows.values()) if is_dense else len(top), len(wanted)))
    below: list[tuple[IntArray, FloatArray]] = []
    n = 0
    for node, which, Z in _propagate_to_top(tree, rows, top, pending):
        if node == last:
            in_top[len(in_top) - len(top) :, which] = Z
        elif is_dense:
            in_top[n : n + len(Z), which] = Z
            n += len(Z)
        else:
            below.append((which, Z))
    return SquareRoot(in_top, _sparse(below, len(wanted)))


def _columns_by_node(tree: Tree, pending: list["_RightHandSides"]) -> dict[int, int]:
    """Return the number of nonzero columns of Z in each node, the top included."""
    found: dict[int, int] = {}
    for each in pending:
        node = each.node
        found[node] = found.get(node, 0) + len(each.which)
        while node != len(tree.level) - 1:
            node = int(tree.parent[node])
            found[node] = found.get(node, 0) + len(each.which)
    return found


def _sparse(parts: list[tuple[IntArray, FloatArray]], n_columns: int) -> sparse.csc_array:
    """Stack parts of rows (n, q) of some columns (q,); written in place, without a copy of the many values."""
    n_in_column = np.zeros(n_columns + 1, dtype=np.int64)
    for which, Z in parts:
        n_in_column[which + 1] += len(Z)
    start: IntArray = np.cumsum(n_in_column)
    n_rows = sum(len(Z) for _, Z in parts)
    n_values = int(start[-1])
    index: type[Any] = np.int32 if max(n_rows, n_values) <= np.iinfo(np.int32).max else np.int64
    values, rows = np.empty(n_values), np.empty(n_values, dtype=index)
    n, at = 0, start[:-1].copy()
    for which, Z in parts:
        own = at[which][:, None] + np.arange(len(Z))
        values[own], rows[own] = Z.T, np.arange(n, n + len(Z))
        at[which] += len(Z)
        n += len(Z)
    return sparse.csc_array((values, rows, start.astype(index)), shape=(n_rows, n_columns))


class _RightHandSides(NamedTuple):
    """Right-hand sides (front, q) of columns (q,) at a node, which are zero but for some rows.

    Attributes:
        rows: (n,) rows of `values` (n, q) in the front.
        ones: (q,) row in which each column is 1; None where `values` are given instead.
    """

    node: int
    which: IntArray
    rows: IntArray
    values: FloatArray
    ones: IntArray | None = None


def _propagate_to_top(
    tree: Tree, rows: SquareRootFactor, top: FloatArray, pending: list[_RightHandSides]
) -> Iterator[tuple[int, IntArray, FloatArray]]:
    """Yield each node, children first, with the columns (q,) that are nonzero in it and its rows (n, q) of Z.

    The top, which is last, comes some columns at a time.
    """
    in_top: list[_RightHandSides] = []
    yield from _propagate(tree, rows, pending, in_top)
    for which, values in _columns_in_top(len(top), in_top) if len(top) else ():
        Z = linalg.solve_triangular(top, values, lower=True, overwrite_b=True, check_finite=False)
        yield len(tree.level) - 1, which, Z


def _columns_in_top(n_rows: int, parts: list[_RightHandSides], first: int = 0) -> Iterator[tuple[IntArray, FloatArray]]:
    """Yield some columns (q,) from `first` on at a time, with their right-hand sides (n_rows, q) in the top."""
    for each in parts:
        wanted = np.flatnonzero(each.which >= first)
        for begin in range(0, len(wanted), _COLUMNS):
            some = wanted[begin : begin + _COLUMNS]
            values = np.zeros((n_rows, len(some)), order="F")
            if each.ones is None:
                values[each.rows] = each.values[:, some]
            else:
                values[each.ones[some], np.arange(len(some))] = 1.0
            yield each.which[some], values


def _propagate(
    tree: Tree, rows: SquareRootFactor, pending: list[_RightHandSides], in_top: list[_RightHandSides]
) -> Iterator[tuple[int, IntArray, FloatArray]]:
    """Yield each node below the top as `_propagate_to_top`, and add the right-hand sides in the top to a list."""
    waiting: dict[int, list[_RightHandSides]] = {}
    for each in pending:
        waiting.setdefault(each.node, []).append(each)
    pending.clear()
    queue = list(waiting)
    heapq.heapify(queue)
    while queue:
        node = heapq.heappop(queue)
        if node == len(tree.level) - 1:
            in_top += waiting.pop(node)
            return
        which, values = _gather(tree, node, waiting.pop(node))
        Z, right = _through_front(tree, rows, node, which, values)
        if right.node not in waiting:
            heapq.heappush(queue, right.node)
        waiting.setdefault(right.node, []).append(right)
        yield node, which, Z


def _identity(tree: Tree, node: int, which: IntArray, wanted: IntArray) -> _RightHandSides:
    """Return columns of the identity, for some of the wanted columns that the node eliminates."""
    front = tree.front[tree.front_start[node] : tree.front_start[node + 1]]
    sorter = np.argsort(front)
    ones = sorter[np.searchsorted(front, wanted[which], sorter=sorter)]
    return _RightHandSides(node, which, ones[:0], np.zeros((0, len(which))), ones)


def _gather(tree: Tree, node: int, parts: list[_RightHandSides]) -> tuple[IntArray, FloatArray]:
    """Return all columns (q,) at a node, and their right-hand sides (front, q); each column is in one part."""
    which = np.concatenate([each.which for each in parts])
    values = np.zeros((int(tree.front_start[node + 1] - tree.front_start[node]), len(which)), order="F")
    begin = 0
    for each in parts:
        end = begin + len(each.which)
        if each.ones is None:
            values[each.rows, begin:end] = each.values
        else:
            values[each.ones, np.arange(begin, end)] = 1.0
        begin = end
    return which, values


def _by_node(tree: Tree, wanted: IntArray) -> list[tuple[int, IntArray]]:
    """Return the nodes that eliminate the wanted columns, and the indices of these among the wanted."""
    if not len(wanted):
        return []
    home = np.full(3 * tree.n_poses + 2 * tree.n_tags + tree.n_calibration, -1)
    for node in np.flatnonzero(tree.n_eliminated):
        start = tree.front_start[node]
        home[tree.front[start : start + tree.n_eliminated[node]]] = node
    leaves = np.flatnonzero(tree.level == 0)
    in_leaf = np.flatnonzero(home[wanted] < 0)
    home_of = home[wanted]
    home_of[in_leaf] = leaves[np.searchsorted(tree.first[leaves], wanted[in_leaf] // 3, side="right") - 1]
    order = np.argsort(home_of, kind="stable")
    nodes, first = np.unique(home_of[order], return_index=True)
    return list(zip(nodes.tolist(), np.split(order, first[1:]), strict=True))


def _through_leaf(
    tree: Tree, system: NormalEquations, rows: SquareRootFactor, leaf: int, which: IntArray, wanted: IntArray
) -> tuple[FloatArray, _RightHandSides]:
    """Return the block of A^-1 of columns of a leaf's poses, and their right-hand sides in the parent's front."""
    first, n = int(tree.first[leaf]), int(tree.end[leaf] - tree.first[leaf])
    start, end = int(tree.front_start[leaf]), int(tree.front_start[leaf + 1])
    k = len(which)
    own = wanted[which] - 3 * first
    solved = np.zeros((k, n, 3))
    solved[np.arange(k), own // 3, own % 3] = 1.0
    outside = np.zeros((k, end - start))
    substitution.solve_leaf_to_front(tree, system, rows, leaf, solved, outside)
    right = _RightHandSides(int(tree.parent[leaf]), which, tree.up[start:end], -outside.T)
    return solved.reshape(k, 3 * n)[:, own].T, right


def _through_front(
    tree: Tree, rows: SquareRootFactor, node: int, which: IntArray, values: FloatArray
) -> tuple[FloatArray, _RightHandSides]:
    """Return Z (n_eliminated, q) and the right-hand sides in the parent's front, from those (front, q) of a node."""
    start, end, n = int(tree.front_start[node]), int(tree.front_start[node + 1]), int(tree.n_eliminated[node])
    R = rows.inner[tree.rows_start[node] : tree.rows_start[node] + n * (end - start)].reshape(n, end - start)
    Z = values[:0]
    if n:
        Z = linalg.solve_triangular(R[:, :n], values[:n], trans="T", check_finite=False)
    remaining = values[n:] - R[:, n:].T @ Z
    return Z, _RightHandSides(int(tree.parent[node]), which, tree.up[start + n : end], remaining)
