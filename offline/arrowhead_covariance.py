"""Exact joint covariances of any columns, from the square root that elimination left.

With E the wanted columns of the identity, E^T H^-1 E = Z^T Z where R^T Z = E. A column of Z is zero but along the path
from its node to the top: so a tag in the border costs one triangular solve there, and a pose a few small ones more.
"""

import heapq
from typing import Final, NamedTuple

import numpy as np
from scipy import linalg

from calib.arrays import FloatArray, IntArray
from offline import arrowhead_substitution
from offline.arrowhead_blocks import Rows, System
from offline.arrowhead_tree import Tree

_AT_ONCE: Final = 1024


def joint_covariance(tree: Tree, system: System, rows: Rows, top: FloatArray, wanted: IntArray) -> FloatArray:
    """(k, k) block of H^-1.

    Args:
        tree: the order.
        system: the blocks.
        rows: what elimination left of them.
        top: lower triangular R^T of the top.
        wanted: (k,) columns in the arrowhead's order.
    """
    return quadratic_form(tree, system, rows, top, Entries(wanted, np.arange(len(wanted)), np.ones(len(wanted))))


class Entries(NamedTuple):
    """A sparse matrix E (n, k): entry `value` in each `row`, in the arrowhead's order, and `column`."""

    row: IntArray
    column: IntArray
    value: FloatArray

    def where(self, which: IntArray) -> "Entries":
        """Some of them."""
        return Entries(self.row[which], self.column[which], self.value[which])


def quadratic_form(
    tree: Tree, system: System, rows: Rows, top: FloatArray, entries: Entries, n_columns: int | None = None
) -> FloatArray:
    """E^T H^-1 E (k, k): cheap where a column of E has entries in few leaves.

    Args:
        tree: the order.
        system: the blocks.
        rows: what elimination left of them.
        top: lower triangular R^T of the top.
        entries: of E.
        n_columns: k, where the last columns may be empty.
    """
    k = int(entries.column.max(initial=-1)) + 1 if n_columns is None else n_columns
    square = np.zeros((k, k))
    # What is on its way at each node: which of the columns, and the right-hand sides (front, q) for them.
    waiting: dict[int, list[tuple[IntArray, FloatArray]]] = {}
    queue: list[int] = []

    def send(node: int, who: IntArray, values: FloatArray) -> None:
        if node not in waiting:
            heapq.heappush(queue, node)
        waiting.setdefault(node, []).append((who, values))

    for node, which in _by_node(tree, entries.row):
        own = entries.where(which)
        who, column = np.unique(own.column, return_inverse=True)
        own = own._replace(column=column)
        if tree.level[node] == 0:
            inner, values = _through_leaf(tree, system, rows, node, own)
            square[np.ix_(who, who)] += inner
            send(int(tree.parent[node]), who, values)
        else:
            front = tree.front[tree.front_start[node] : tree.front_start[node + 1]]
            sorter = np.argsort(front)
            values = np.zeros((len(front), len(who)))
            np.add.at(values, (sorter[np.searchsorted(front, own.row, sorter=sorter)], own.column), own.value)
            send(node, who, values)
    while queue:
        node = heapq.heappop(queue)
        who, values = _together(waiting.pop(node))
        if node == len(tree.level) - 1:
            Z = linalg.solve_triangular(top, values, lower=True, check_finite=False) if len(top) else values
        else:
            Z, left = _through_front(tree, rows, node, values)
            send(int(tree.parent[node]), who, left)
        for begin in range(0, len(who), _AT_ONCE):  # of thousands of columns k by k is large, and a product another
            some = slice(begin, begin + _AT_ONCE)
            square[np.ix_(who[some], who)] += Z[:, some].T @ Z
    square += square.T
    square *= 0.5
    return square


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


def _through_leaf(tree: Tree, system: System, rows: Rows, leaf: int, entries: Entries) -> tuple[FloatArray, FloatArray]:
    """E^T A^-1 E of entries in a leaf's poses, and what they leave in the parent's front."""
    first, n = int(tree.first[leaf]), int(tree.end[leaf] - tree.first[leaf])
    start, end = int(tree.front_start[leaf]), int(tree.front_start[leaf + 1])
    parent = int(tree.parent[leaf])
    k = int(entries.column.max()) + 1
    right = np.zeros((k, 3 * n))
    np.add.at(right, (entries.column, entries.row - 3 * first), entries.value)
    solved = right.reshape(k, n, 3).copy()
    values = np.zeros((int(tree.front_start[parent + 1] - tree.front_start[parent]), k))
    for i in range(k):
        arrowhead_substitution.solve_leaf(tree, rows, leaf, solved[i])
        outside = np.zeros(end - start)
        arrowhead_substitution.leaf_to_front(tree, system, leaf, solved[i], outside)
        values[tree.up[start:end], i] = -outside
    return right @ solved.reshape(k, 3 * n).T, values


def _through_front(tree: Tree, rows: Rows, node: int, values: FloatArray) -> tuple[FloatArray, FloatArray]:
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
