"""Compiled inner loops of the arrowhead system: substitute for many vectors at once.

What `arrowhead.substitution` does for one vector, here over the rows of a matrix: a block of R is read once for all of
them, and inner loops run along rows. Sixteen vectors take as long as two or three one by one.
"""

from typing import NamedTuple

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.foundation import borrow, inner, njit
from groundsbot.offline.sam.arrowhead.tree import Tree
from groundsbot.offline.sam.linearisation.blocks import NormalEquations, SquareRootFactor


class SubstitutionArrays(NamedTuple):
    """What of tree, blocks and rows is needed here: tuples of few arrays compile in a fraction of the time."""

    level: IntArray
    first: IntArray
    end: IntArray
    right: IntArray
    front_start: IntArray
    front: IntArray
    calibration_at: IntArray
    n_slots: IntArray  # (N,)
    n_eliminated: IntArray
    rows_start: IntArray
    observation_start: IntArray
    observation_at: IntArray
    next_blocks: FloatArray
    calibration_blocks: FloatArray
    tag_blocks: FloatArray
    pose_rows: FloatArray
    next_rows: FloatArray
    inner: FloatArray


def pieces_of(tree: Tree, system: NormalEquations, rows: SquareRootFactor) -> SubstitutionArrays:
    """Of a factorisation."""
    n_slots = np.diff(tree.slot_start)[tree.segment]
    return SubstitutionArrays(
        tree.level, tree.first, tree.end, tree.right, tree.front_start, tree.front, tree.calibration_at, n_slots,
        tree.n_eliminated, tree.rows_start, tree.observation_start, tree.observation_at,
        system.pose_next, system.pose_calibration, system.pose_tag, rows.pose, rows.pose_next, rows.inner,
    )  # fmt: skip


@njit
def substitute(
    pieces: SubstitutionArrays, vectors: FloatArray, outwards: bool, inside: FloatArray, outside: FloatArray
) -> None:
    """Substitutes forward (outwards) or backward, all but the top.

    Forward vectors (n, k) become what is left of them for the top, and R^-T vectors elsewhere, but for poses in leaves,
    which stay. Backward vectors, solved for the top and from before elsewhere, become the solutions.

    Args:
        pieces: of the factorisation.
        vectors: (n, k)
        outwards: which way.
        inside: room for the rows of a leaf's poses.
        outside: room for the rows of a leaf's front.
    """
    pieces = borrow(pieces)
    n_nodes = len(pieces.level) - 1
    for each in range(n_nodes):
        node = each if outwards else n_nodes - 1 - each
        if pieces.level[node] > 0:
            _through_front(pieces, node, vectors, outwards)
        elif outwards:
            _out_of_leaf(pieces, node, vectors, inside, outside)
        else:
            _into_leaf(pieces, node, vectors, inside, outside)


@inner
def _through_front(pieces: SubstitutionArrays, node: int, vectors: FloatArray, outwards: bool) -> None:
    start, n = pieces.front_start[node], pieces.n_eliminated[node]
    size = pieces.front_start[node + 1] - start
    for own in range(n):
        i = own if outwards else n - 1 - own
        at, R = pieces.front[start + i], pieces.rows_start[node] + i * size
        if outwards:
            _scale(vectors, at, 1.0 / pieces.inner[R + i])
        for a in range(i + 1, size):
            other = pieces.front[start + a]
            if outwards:
                _subtract(vectors, other, pieces.inner[R + a], vectors, at)
            else:
                _subtract(vectors, at, pieces.inner[R + a], vectors, other)
        if not outwards:
            _scale(vectors, at, 1.0 / pieces.inner[R + i])


@inner
def _out_of_leaf(
    pieces: SubstitutionArrays, leaf: int, vectors: FloatArray, inside: FloatArray, outside: FloatArray
) -> None:
    start, end = pieces.front_start[leaf], pieces.front_start[leaf + 1]
    first, last = pieces.first[leaf], pieces.end[leaf]
    _copy(vectors, 3 * first, inside, 0, 3 * (last - first))
    for a in range(end - start):
        for c in range(outside.shape[1]):
            outside[a, c] = 0.0
    _leaf_forward(pieces.pose_rows, pieces.next_rows, first, last, inside)
    _leaf_backward(pieces.pose_rows, pieces.next_rows, first, last, inside)
    _add_coupling(pieces, leaf, inside, outside, True)
    for a in range(end - start):
        _subtract(vectors, pieces.front[start + a], 1.0, outside, a)


@inner
def _into_leaf(
    pieces: SubstitutionArrays, leaf: int, vectors: FloatArray, inside: FloatArray, outside: FloatArray
) -> None:
    start, end = pieces.front_start[leaf], pieces.front_start[leaf + 1]
    first, last = pieces.first[leaf], pieces.end[leaf]
    _copy(vectors, 3 * first, inside, 0, 3 * (last - first))
    for a in range(end - start):
        _copy(vectors, pieces.front[start + a], outside, a, 1)
    _add_coupling(pieces, leaf, inside, outside, False)
    _leaf_forward(pieces.pose_rows, pieces.next_rows, first, last, inside)
    _leaf_backward(pieces.pose_rows, pieces.next_rows, first, last, inside)
    _copy(inside, 0, vectors, 3 * first, 3 * (last - first))


@inner
def _copy(matrix: FloatArray, first: int, into: FloatArray, at: int, n_rows: int) -> None:
    for i in range(n_rows):
        for c in range(matrix.shape[1]):
            into[at + i, c] = matrix[first + i, c]


@inner
def _scale(matrix: FloatArray, row: int, factor: float) -> None:
    for c in range(matrix.shape[1]):
        matrix[row, c] *= factor


@inner
def _subtract(matrix: FloatArray, row: int, factor: float, other: FloatArray, at: int) -> None:
    """Takes a row of another, or of the same, from a row."""
    for c in range(matrix.shape[1]):
        matrix[row, c] -= factor * other[at, c]


@inner
def _leaf_forward(pose_rows: FloatArray, next_rows: FloatArray, first: int, end: int, inside: FloatArray) -> None:
    """Takes inside (3 K, k) to U^-T inside, with U^T D U the block tridiagonal part of H of the leaf's poses."""
    for pose in range(first, end):
        U, at = pose_rows[pose], 3 * (pose - first)
        if pose > first:
            # What the pose before it is to hold once it is divided by its pivots.
            Z, before = next_rows[pose - 1], pose_rows[pose - 1]
            for i in range(3):
                for j in range(3):
                    _subtract(inside, at + i, before[j, j] * Z[j, i], inside, at - 3 + j)
        for i in range(1, 3):
            for j in range(i):
                _subtract(inside, at + i, U[j, i], inside, at + j)


@inner
def _leaf_backward(pose_rows: FloatArray, next_rows: FloatArray, first: int, end: int, inside: FloatArray) -> None:
    """Takes inside (3 K, k) to (D U)^-1 inside."""
    for pose in range(end - 1, first - 1, -1):
        U, at = pose_rows[pose], 3 * (pose - first)
        if pose + 1 < end:
            Z = next_rows[pose]
            for i in range(3):
                for j in range(3):
                    _subtract(inside, at + i, Z[i, j], inside, at + 3 + j)
        for i in range(2, -1, -1):
            _scale(inside, at + i, U[i, i])
            for j in range(i + 1, 3):
                _subtract(inside, at + i, U[i, j], inside, at + j)


@inner
def _add_coupling(
    pieces: SubstitutionArrays, leaf: int, inside: FloatArray, outside: FloatArray, outwards: bool
) -> None:
    """Adds B^T inside to outside (w, k), or takes B outside from inside (3 K, k).

    B are the blocks of H between the leaf's poses and its front.
    """
    first, end, n_left = pieces.first[leaf], pieces.end[leaf], pieces.calibration_at[leaf]
    if first == end:
        return  # a segment of one pose, which the top eliminates
    right = pieces.front_start[leaf + 1] - pieces.front_start[leaf] - 3
    for i in range(3):
        for j in range(3):
            if n_left:
                _couple(pieces.next_blocks[first - 1, i, j], inside, j, outside, i, outwards)
            if pieces.right[leaf] >= 0:
                last = 3 * (end - 1 - first) + j
                _couple(pieces.next_blocks[end - 1, j, i], inside, last, outside, right + i, outwards)
    for row in range(3 * (end - first)):
        pose, i = first + row // 3, row % 3
        for a in range(pieces.n_slots[leaf]):
            _couple(pieces.calibration_blocks[pose, i, a], inside, row, outside, n_left + a, outwards)
        for m in range(pieces.observation_start[pose], pieces.observation_start[pose + 1]):
            for j in range(2):
                _couple(pieces.tag_blocks[m, i, j], inside, row, outside, pieces.observation_at[m] + j, outwards)


@inner
def _couple(value: float, inside: FloatArray, row: int, outside: FloatArray, at: int, outwards: bool) -> None:
    if outwards:
        _subtract(outside, at, -value, inside, row)
    else:
        _subtract(inside, row, value, outside, at)
