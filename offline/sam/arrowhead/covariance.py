"""Exact joint covariances of any columns, from the square root that elimination left.

With E the wanted columns of the identity, E^T H^-1 E = Z^T Z where R^T Z = E. A column of Z is zero but along the path
from its node to the top: so a tag in the border costs one triangular solve there, and a pose a few small ones more.
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
# Numbers are kept with their zeros, which makes products ten times quicker, where there are few, and where what is
# not zero would take half as much memory.
_FEW: Final = 2**22
_SPARSE: Final = 3


class SquareRoot(NamedTuple):
    """Z with Z^T Z a block (k, k) of H^-1.

    Attributes:
        top: (t, k) rows of the columns that meet in the top, or all where there are few.
        below: (m, k) rows of those that are eliminated before, most of them zero.
    """

    top: FloatArray
    below: sparse.csc_array

    def times(self, vectors: FloatArray) -> FloatArray:
        """The block of H^-1 times vectors (k, n)."""
        product: FloatArray = self.top.T @ (self.top @ vectors)
        return product + self.below.T @ (self.below @ vectors) if self.below.shape[0] else product

    def of(self, columns: IntArray) -> "SquareRoot":
        """Of some of the columns."""
        return SquareRoot(self.top[:, columns], self.below[:, columns] if self.below.shape[0] else self.below)

    def sum_columns(self, columns: sparse.csc_array) -> "SquareRoot":
        """Of sums of the columns, as a sparse matrix (k, n) has them."""
        below = sparse.csc_array(self.below @ columns) if self.below.shape[0] else self.below
        top = np.empty((len(self.top), columns.shape[1]))
        for begin in range(0, len(top), _AT_ONCE):  # each time the rows are copied
            some = slice(begin, begin + _AT_ONCE)
            top[some] = (columns.T @ self.top[some].T).T
        return SquareRoot(top, below)

    def against(self, other: "SquareRoot") -> FloatArray:
        """Z^T Z' between these columns and another's."""
        product: FloatArray = self.top.T @ other.top
        return product + (self.below.T @ other.below).toarray() if self.below.shape[0] else product


def joint_covariance(
    tree: Tree, system: NormalEquations, rows: SquareRootFactor, top: FloatArray, wanted: IntArray
) -> FloatArray:
    """(k, k) block of H^-1.

    Args:
        tree: the order.
        system: the blocks.
        rows: what elimination left of them.
        top: lower triangular R^T of the top.
        wanted: (k,) columns in the arrowhead's order.
    """
    square = np.zeros((len(wanted), len(wanted)))
    sent: list[_Sent] = []
    for node, who in _by_node(tree, wanted):
        if tree.level[node] == 0:
            inner, values = _through_leaf(tree, system, rows, node, wanted[who])
            square[np.ix_(who, who)] += inner
            sent.append(_Sent(int(tree.parent[node]), who, values))
        else:
            sent.append(_Sent(node, who, _on_front(tree, node, wanted[who])))
    for _, who, Z in _to_the_top(tree, rows, top, sent):
        for begin in range(0, len(who), _AT_ONCE):  # of thousands of columns k by k is large, and a product another
            some = slice(begin, begin + _AT_ONCE)
            square[np.ix_(who[some], who)] += Z[:, some].T @ Z
    square += square.T
    square *= 0.5
    return square


def square_root(tree: Tree, rows: SquareRootFactor, top: FloatArray, wanted: IntArray) -> SquareRoot:
    """Of the block of H^-1 of columns that are no pose's; for very many of them smaller than the block.

    Args:
        tree: the order.
        rows: what elimination left of the blocks.
        top: lower triangular R^T of the top.
        wanted: (k,) columns in the arrowhead's order, of tags or calibration.
    """
    sent = [_Sent(node, who, _on_front(tree, node, wanted[who])) for node, who in _by_node(tree, wanted)]
    last = len(tree.level) - 1
    passing = _passing(tree, sent)
    n_rows = {node: len(top) if node == last else int(tree.n_eliminated[node]) for node in passing}
    n_values = sum(n_rows[node] * n for node, n in passing.items())
    is_dense = sum(n_rows.values()) * len(wanted) < max(_FEW, _SPARSE * n_values)
    in_top = np.zeros((sum(n_rows.values()) if is_dense else len(top), len(wanted)))
    below: list[tuple[IntArray, FloatArray]] = []
    n = 0
    for node, who, Z in _to_the_top(tree, rows, top, sent):
        if is_dense or node == last:
            in_top[n : n + len(Z), who] = Z
            n += len(Z)
        else:
            below.append((who, Z))
    return SquareRoot(in_top, _sparse(below, len(wanted)))


def _passing(tree: Tree, sent: list["_Sent"]) -> dict[int, int]:
    """How many columns come through each node on their way to the top, that included."""
    found: dict[int, int] = {}
    for each in sent:
        node = each.node
        found[node] = found.get(node, 0) + len(each.who)
        while node != len(tree.level) - 1:
            node = int(tree.parent[node])
            found[node] = found.get(node, 0) + len(each.who)
    return found


def _sparse(parts: list[tuple[IntArray, FloatArray]], n_columns: int) -> sparse.csc_array:
    """Rows (n, q) of some of the columns (q,), one part below the other; written where they stay, for they are many."""
    n_in_column = np.zeros(n_columns + 1, dtype=np.int64)
    for who, Z in parts:
        n_in_column[who + 1] += len(Z)
    start: IntArray = np.cumsum(n_in_column)
    n_rows = sum(len(Z) for _, Z in parts)
    n_values = int(start[-1])
    index: type[Any] = np.int32 if max(n_rows, n_values) <= np.iinfo(np.int32).max else np.int64
    values, rows = np.empty(n_values), np.empty(n_values, dtype=index)
    n, at = 0, start[:-1].copy()
    for who, Z in parts:
        own = at[who][:, None] + np.arange(len(Z))
        values[own], rows[own] = Z.T, np.arange(n, n + len(Z))
        at[who] += len(Z)
        n += len(Z)
    return sparse.csc_array((values, rows, start.astype(index)), shape=(n_rows, n_columns))


class _Sent(NamedTuple):
    """Right-hand sides (front, q) that have come to a node, and the columns (q,) that they are of."""

    node: int
    who: IntArray
    values: FloatArray


def _to_the_top(tree: Tree, rows: SquareRootFactor, top: FloatArray, sent: list[_Sent]) -> Iterator[_Sent]:
    """Each node's rows (n_eliminated, q) of Z, children first."""
    waiting: dict[int, list[tuple[IntArray, FloatArray]]] = {}
    for each in sent:
        waiting.setdefault(each.node, []).append((each.who, each.values))
    queue = list(waiting)
    heapq.heapify(queue)
    while queue:
        node = heapq.heappop(queue)
        who, values = _together(waiting.pop(node))
        if node == len(tree.level) - 1:
            Z = linalg.solve_triangular(top, values, lower=True, check_finite=False) if len(top) else values
        else:
            Z, left = _through_front(tree, rows, node, values)
            parent = int(tree.parent[node])
            if parent not in waiting:
                heapq.heappush(queue, parent)
            waiting.setdefault(parent, []).append((who, left))
        yield _Sent(node, who, Z)


def _on_front(tree: Tree, node: int, wanted: IntArray) -> FloatArray:
    """(front, q) a one for each column (q,) that the node eliminates."""
    front = tree.front[tree.front_start[node] : tree.front_start[node + 1]]
    sorter = np.argsort(front)
    values = np.zeros((len(front), len(wanted)))
    values[sorter[np.searchsorted(front, wanted, sorter=sorter)], np.arange(len(wanted))] = 1.0
    return values


def _together(arrived: list[tuple[IntArray, FloatArray]]) -> tuple[IntArray, FloatArray]:
    """Columns of one number added up."""
    members = np.concatenate([who for who, _ in arrived])
    values = np.concatenate([sent for _, sent in arrived], axis=1)
    who, index = np.unique(members, return_inverse=True)
    if len(who) == len(members):
        return members, values
    total = np.zeros((len(who), len(values)))
    np.add.at(total, index, values.T)
    return who, total.T


def _by_node(tree: Tree, wanted: IntArray) -> list[tuple[int, IntArray]]:
    """Nodes that eliminate what is wanted, and the indices of what they do."""
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
    tree: Tree, system: NormalEquations, rows: SquareRootFactor, leaf: int, wanted: IntArray
) -> tuple[FloatArray, FloatArray]:
    """The block of A^-1 of columns in a leaf's poses, and what they leave in the parent's front."""
    first, n = int(tree.first[leaf]), int(tree.end[leaf] - tree.first[leaf])
    start, end = int(tree.front_start[leaf]), int(tree.front_start[leaf + 1])
    parent = int(tree.parent[leaf])
    k = len(wanted)
    own = wanted - 3 * first
    solved = np.zeros((k, n, 3))
    solved[np.arange(k), own // 3, own % 3] = 1.0
    values = np.zeros((int(tree.front_start[parent + 1] - tree.front_start[parent]), k))
    for i in range(k):
        substitution.solve_leaf(tree, rows, leaf, solved[i])
        outside = np.zeros(end - start)
        substitution.leaf_to_front(tree, system, leaf, solved[i], outside)
        values[tree.up[start:end], i] = -outside
    return solved.reshape(k, 3 * n)[:, own].T, values


def _through_front(tree: Tree, rows: SquareRootFactor, node: int, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Z (n_eliminated, q), and what it leaves in the parent's front, of right-hand sides (front, q)."""
    start, end, n = int(tree.front_start[node]), int(tree.front_start[node + 1]), int(tree.n_eliminated[node])
    R = rows.inner[tree.rows_start[node] : tree.rows_start[node] + n * (end - start)].reshape(n, end - start)
    Z = values[:0]
    if n:
        Z = linalg.solve_triangular(R[:, :n], values[:n], trans="T", check_finite=False)
    left = values[n:] - R[:, n:].T @ Z
    parent = int(tree.parent[node])
    above = np.zeros((int(tree.front_start[parent + 1] - tree.front_start[parent]), values.shape[1]))
    above[tree.up[start + n : end]] = left
    return Z, above
