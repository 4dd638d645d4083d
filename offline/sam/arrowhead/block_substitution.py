"""Compiled forward and backward substitution of many vectors at once.

The same as `arrowhead.substitution` for a matrix with one vector per column: each block of R is read once for all
vectors, and inner loops run along rows. Sixteen vectors take as long as two or three in `arrowhead.substitution`.
"""

from typing import NamedTuple

import numpy as np

from groundsbot.calib.foundation import FloatArray
from groundsbot.offline.foundation import FloatBlocks, FloatMatrix, FloatVector, IntVector, borrow, inner, njit
from groundsbot.offline.sam.arrowhead.tree import Tree
from groundsbot.offline.sam.linearisation.blocks import NormalEquations, SquareRootFactor


class SubstitutionArrays(NamedTuple):
    """Arrays of `Tree`, `NormalEquations` and `SquareRootFactor` that substitution uses.

    Kernels that take these few compile in a fraction of the time of ones that take all.
    """

    level: IntVector
    first: IntVector
    end: IntVector
    right: IntVector
    front_start: IntVector
    front: IntVector
    calibration_at: IntVector
    n_slots: IntVector  # (N,)
    n_eliminated: IntVector
    rows_start: IntVector
    observation_start: IntVector
    observation_at: IntVector
    next_blocks: FloatBlocks
    calibration_blocks: FloatBlocks
    tag_blocks: FloatBlocks
    pose_rows: FloatBlocks
    next_rows: FloatBlocks
    inner: FloatVector


def substitution_arrays(tree: Tree, system: NormalEquations, rows: SquareRootFactor) -> SubstitutionArrays:
    """Collect the arrays of a factorisation."""
    n_slots = np.diff(tree.slot_start)[tree.segment]
    return SubstitutionArrays(
        tree.level, tree.first, tree.end, tree.right, tree.front_start, tree.front, tree.calibration_at, n_slots,
        tree.n_eliminated, tree.rows_start, tree.observation_start, tree.observation_at,
        system.pose_next, system.pose_calibration, system.pose_tag, rows.pose, rows.pose_next, rows.inner,
    )  # fmt: skip


@njit
def substitute(
    arrays: SubstitutionArrays, vectors: FloatMatrix, is_forward: bool, inside: FloatMatrix, outside: FloatMatrix
) -> None:
    """Substitute forward or backward through all nodes but the top.

    Forward substitution replaces vectors by R^-T vectors, except in the top, where it subtracts the eliminated rows,
    and at poses in leaves, which it does not change. Backward substitution expects the solution in the top and the
    result of forward substitution elsewhere, and computes the solution.

    Args:
        arrays: arrays of the factorisation.
        vectors: (n, k) in the arrowhead's order; changed in place.
        is_forward: direction.
        inside: work array for the rows of a leaf's poses.
        outside: work array for the rows of a leaf's front.
    """
    arrays = borrow(arrays)
    n_nodes = len(arrays.level) - 1
    for each in range(n_nodes):
        node = each if is_forward else n_nodes - 1 - each
        if arrays.level[node] > 0:
            _substitute_front(arrays, node, vectors, is_forward)
        elif is_forward:
            _substitute_leaf_forward(arrays, node, vectors, inside, outside)
        else:
            _substitute_leaf_backward(arrays, node, vectors, inside, outside)


@inner
def _substitute_front(arrays: SubstitutionArrays, node: int, vectors: FloatArray, is_forward: bool) -> None:
    start, n = arrays.front_start[node], arrays.n_eliminated[node]
    size = arrays.front_start[node + 1] - start
    for own in range(n):
        i = own if is_forward else n - 1 - own
        at, R = arrays.front[start + i], arrays.rows_start[node] + i * size
        if is_forward:
            _scale(vectors, at, 1.0 / arrays.inner[R + i])
        for a in range(i + 1, size):
            other = arrays.front[start + a]
            if is_forward:
                _subtract(vectors, other, arrays.inner[R + a], vectors, at)
            else:
                _subtract(vectors, at, arrays.inner[R + a], vectors, other)
        if not is_forward:
            _scale(vectors, at, 1.0 / arrays.inner[R + i])


@inner
def _substitute_leaf_forward(
    arrays: SubstitutionArrays, leaf: int, vectors: FloatArray, inside: FloatArray, outside: FloatArray
) -> None:
    start, end = arrays.front_start[leaf], arrays.front_start[leaf + 1]
    first, last = arrays.first[leaf], arrays.end[leaf]
    _copy(vectors, 3 * first, inside, 0, 3 * (last - first))
    for a in range(end - start):
        for c in range(outside.shape[1]):
            outside[a, c] = 0.0
    leaf_forward(arrays.pose_rows, arrays.next_rows, first, last, inside)
    leaf_backward(arrays.pose_rows, arrays.next_rows, first, last, inside)
    add_coupling(arrays, leaf, inside, outside, True)
    for a in range(end - start):
        _subtract(vectors, arrays.front[start + a], 1.0, outside, a)


@inner
def _substitute_leaf_backward(
    arrays: SubstitutionArrays, leaf: int, vectors: FloatArray, inside: FloatArray, outside: FloatArray
) -> None:
    start, end = arrays.front_start[leaf], arrays.front_start[leaf + 1]
    first, last = arrays.first[leaf], arrays.end[leaf]
    _copy(vectors, 3 * first, inside, 0, 3 * (last - first))
    for a in range(end - start):
        _copy(vectors, arrays.front[start + a], outside, a, 1)
    add_coupling(arrays, leaf, inside, outside, False)
    leaf_forward(arrays.pose_rows, arrays.next_rows, first, last, inside)
    leaf_backward(arrays.pose_rows, arrays.next_rows, first, last, inside)
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
    """Subtract a multiple of a row, of another matrix or the same, from a row."""
    for c in range(matrix.shape[1]):
        matrix[row, c] -= factor * other[at, c]


@inner
def leaf_forward(pose_rows: FloatArray, next_rows: FloatArray, first: int, end: int, inside: FloatArray) -> None:
    """Replace inside (3 K, k) by U^-T inside, with U^T D U the block tridiagonal part of H of the leaf's poses."""
    for pose in range(first, end):
        U, at = pose_rows[pose], 3 * (pose - first)
        row_0, row_1, row_2 = inside[at], inside[at + 1], inside[at + 2]
        if pose > first:
            Z, D = next_rows[pose - 1], pose_rows[pose - 1]
            before_0, before_1, before_2 = inside[at - 3], inside[at - 2], inside[at - 1]
            for i in range(3):
                row = inside[at + i]
                f0, f1, f2 = D[0, 0] * Z[0, i], D[1, 1] * Z[1, i], D[2, 2] * Z[2, i]
                for c in range(len(row)):
                    row[c] = row[c] - f0 * before_0[c] - f1 * before_1[c] - f2 * before_2[c]
        u01, u02, u12 = U[0, 1], U[0, 2], U[1, 2]
        for c in range(len(row_0)):
            second = row_1[c] - u01 * row_0[c]
            row_1[c] = second
            row_2[c] = row_2[c] - u02 * row_0[c] - u12 * second


@inner
def leaf_backward(pose_rows: FloatArray, next_rows: FloatArray, first: int, end: int, inside: FloatArray) -> None:
    """Replace inside (3 K, k) by (D U)^-1 inside."""
    for pose in range(end - 1, first - 1, -1):
        U, at = pose_rows[pose], 3 * (pose - first)
        row_0, row_1, row_2 = inside[at], inside[at + 1], inside[at + 2]
        if pose + 1 < end:
            Z = next_rows[pose]
            after_0, after_1, after_2 = inside[at + 3], inside[at + 4], inside[at + 5]
            for i in range(3):
                row, z0, z1, z2 = inside[at + i], Z[i, 0], Z[i, 1], Z[i, 2]
                for c in range(len(row)):
                    row[c] = row[c] - z0 * after_0[c] - z1 * after_1[c] - z2 * after_2[c]
        u00, u01, u02, u11, u12, u22 = U[0, 0], U[0, 1], U[0, 2], U[1, 1], U[1, 2], U[2, 2]
        for c in range(len(row_0)):
            third = row_2[c] * u22
            second = row_1[c] * u11 - u12 * third
            row_2[c], row_1[c] = third, second
            row_0[c] = row_0[c] * u00 - u01 * second - u02 * third


@inner
def add_coupling(
    arrays: SubstitutionArrays, leaf: int, inside: FloatArray, outside: FloatArray, is_forward: bool
) -> None:
    """Add B^T inside to outside (w, k) if forward, else subtract B outside from inside (3 K, k).

    B contains the blocks of H between the leaf's poses and its front.
    """
    first, end, n_left = arrays.first[leaf], arrays.end[leaf], arrays.calibration_at[leaf]
    if first == end:
        return  # the single pose of the segment is eliminated in the top
    right = arrays.front_start[leaf + 1] - arrays.front_start[leaf] - 3
    for i in range(3):
        if n_left:
            N = arrays.next_blocks[first - 1]
            _couple(N[i, 0], N[i, 1], N[i, 2], inside, 0, outside, i, is_forward)
        if arrays.right[leaf] >= 0:
            N, last = arrays.next_blocks[end - 1], 3 * (end - 1 - first)
            _couple(N[0, i], N[1, i], N[2, i], inside, last, outside, right + i, is_forward)
    for pose in range(first, end):
        row = 3 * (pose - first)
        for a in range(arrays.n_slots[leaf]):
            N = arrays.calibration_blocks[pose]
            _couple(N[0, a], N[1, a], N[2, a], inside, row, outside, n_left + a, is_forward)
        for m in range(arrays.observation_start[pose], arrays.observation_start[pose + 1]):
            N, at = arrays.tag_blocks[m], arrays.observation_at[m]
            for j in range(2):
                _couple(N[0, j], N[1, j], N[2, j], inside, row, outside, at + j, is_forward)


@inner
def _couple(
    v0: float, v1: float, v2: float, inside: FloatArray, row: int, outside: FloatArray, at: int, is_forward: bool
) -> None:
    """Couple the three rows of a pose with one of the front."""
    row_0, row_1, row_2, other = inside[row], inside[row + 1], inside[row + 2], outside[at]
    if is_forward:
        for c in range(len(other)):
            other[c] = other[c] + v0 * row_0[c] + v1 * row_1[c] + v2 * row_2[c]
    else:
        for c in range(len(other)):
            row_0[c] -= v0 * other[c]
            row_1[c] -= v1 * other[c]
            row_2[c] -= v2 * other[c]
