"""Compiled forward and backward substitution with the rows of `arrowhead.elimination`; products with H, in numpy."""

from itertools import pairwise

import numpy as np

from groundsbot.calib.foundation import FloatArray
from groundsbot.offline.foundation import FloatBlocks, FloatMatrix, FloatVector, borrow, inner, njit
from groundsbot.offline.sam.arrowhead.tree import Tree, n_slots_of
from groundsbot.offline.sam.linearisation.blocks import NormalEquations, SquareRootFactor


@njit
def forward(tree: Tree, system: NormalEquations, rows: SquareRootFactor, vector: FloatVector) -> None:
    """Replace vector (n,) by R^-T vector.

    In the top the eliminated rows are subtracted only, and entries of poses in leaves do not change.
    """
    tree, system, rows, vector = borrow(tree), borrow(system), borrow(rows), borrow(vector)
    inside, outside = rows.inside, rows.border[0, 0]
    for node in range(len(tree.level) - 1):
        start, end = tree.front_start[node], tree.front_start[node + 1]
        if tree.level[node] == 0:
            _copy_leaf(tree, node, vector, inside)
            solve_leaf(tree, rows, node, inside)
            for a in range(end - start):
                outside[a] = 0.0
            leaf_to_front(tree, system, node, inside, outside)
            for a in range(start, end):
                vector[tree.front[a]] -= outside[a - start]
            continue
        columns, R = tree.front[start:end], _rows_of(tree, node, rows)
        for k in range(len(R)):
            value = vector[columns[k]] / R[k, k]
            vector[columns[k]] = value
            for a in range(k + 1, len(columns)):
                vector[columns[a]] -= R[k, a] * value


@njit
def backward(tree: Tree, system: NormalEquations, rows: SquareRootFactor, vector: FloatVector) -> None:
    """Replace vector (n,), the solution in the top and the result of `forward` elsewhere, by the solution."""
    tree, system, rows, vector = borrow(tree), borrow(system), borrow(rows), borrow(vector)
    inside, outside = rows.inside, rows.border[0, 0]
    for node in range(len(tree.level) - 2, -1, -1):
        start, end = tree.front_start[node], tree.front_start[node + 1]
        columns = tree.front[start:end]
        if tree.level[node] == 0:
            for a in range(end - start):
                outside[a] = vector[columns[a]]
            _copy_leaf(tree, node, vector, inside)
            _front_to_leaf(tree, system, node, outside, inside)
            solve_leaf(tree, rows, node, inside)
            for pose in range(tree.first[node], tree.end[node]):
                for i in range(3):
                    vector[3 * pose + i] = inside[pose - tree.first[node], i]
            continue
        R = _rows_of(tree, node, rows)
        for k in range(len(R) - 1, -1, -1):
            rest = vector[columns[k]]
            for a in range(k + 1, len(columns)):
                rest -= R[k, a] * vector[columns[a]]
            vector[columns[k]] = rest / R[k, k]


@inner
def _copy_leaf(tree: Tree, leaf: int, vector: FloatArray, inside: FloatArray) -> None:
    """Copy a leaf's part of a vector."""
    first = tree.first[leaf]
    for pose in range(first, tree.end[leaf]):
        for i in range(3):
            inside[pose - first, i] = vector[3 * pose + i]


@inner
def _rows_of(tree: Tree, node: int, rows: SquareRootFactor) -> FloatArray:
    n, size = tree.n_eliminated[node], tree.front_start[node + 1] - tree.front_start[node]
    return rows.inner[tree.rows_start[node] : tree.rows_start[node] + n * size].reshape((n, size))


@inner
def solve_leaf(tree: Tree, rows: SquareRootFactor, leaf: int, inside: FloatArray) -> None:
    """Replace inside (K, 3) by A^-1 inside, with A the block tridiagonal part of H of the leaf's poses."""
    first, n = tree.first[leaf], tree.end[leaf] - tree.first[leaf]
    x0, x1, x2 = 0.0, 0.0, 0.0
    for k in range(n):
        U = rows.pose[first + k]
        b0, b1, b2 = inside[k, 0], inside[k, 1], inside[k, 2]
        if k:
            Z = rows.pose_next[first + k - 1]
            b0 -= Z[0, 0] * x0 + Z[1, 0] * x1 + Z[2, 0] * x2
            b1 -= Z[0, 1] * x0 + Z[1, 1] * x1 + Z[2, 1] * x2
            b2 -= Z[0, 2] * x0 + Z[1, 2] * x1 + Z[2, 2] * x2
        b1 -= U[0, 1] * b0
        b2 -= U[0, 2] * b0 + U[1, 2] * b1
        x0, x1, x2 = b0 * U[0, 0], b1 * U[1, 1], b2 * U[2, 2]
        inside[k, 0], inside[k, 1], inside[k, 2] = b0, b1, b2
    for k in range(n - 1, -1, -1):
        U = rows.pose[first + k]
        b0, b1, b2 = inside[k, 0], inside[k, 1], inside[k, 2]
        if k + 1 < n:
            Z = rows.pose_next[first + k]
            b0 -= Z[0, 0] * x0 + Z[0, 1] * x1 + Z[0, 2] * x2
            b1 -= Z[1, 0] * x0 + Z[1, 1] * x1 + Z[1, 2] * x2
            b2 -= Z[2, 0] * x0 + Z[2, 1] * x1 + Z[2, 2] * x2
        x2 = b2 * U[2, 2]
        x1 = b1 * U[1, 1] - U[1, 2] * x2
        x0 = b0 * U[0, 0] - U[0, 1] * x1 - U[0, 2] * x2
        inside[k, 0], inside[k, 1], inside[k, 2] = x0, x1, x2


@inner
def leaf_to_front(tree: Tree, system: NormalEquations, leaf: int, inside: FloatArray, outside: FloatArray) -> None:
    """Add B^T inside to outside (w,), with B the blocks of H between the leaf's poses and its front."""
    first, end = tree.first[leaf], tree.end[leaf]
    n_left = tree.calibration_at[leaf]
    size = tree.front_start[leaf + 1] - tree.front_start[leaf]
    if first == end:
        return  # the single pose of the segment is eliminated in the top
    for i in range(3):
        for j in range(3):
            if n_left:
                outside[i] += system.pose_next[first - 1, i, j] * inside[0, j]
            if tree.right[leaf] >= 0:
                outside[size - 3 + i] += system.pose_next[end - 1, j, i] * inside[end - 1 - first, j]
    for pose in range(first, end):
        x0, x1, x2 = inside[pose - first, 0], inside[pose - first, 1], inside[pose - first, 2]
        for a in range(n_slots_of(tree, leaf)):
            C = system.pose_calibration[pose]
            outside[n_left + a] += C[0, a] * x0 + C[1, a] * x1 + C[2, a] * x2
        for m in range(tree.observation_start[pose], tree.observation_start[pose + 1]):
            L, at = system.pose_tag[m], tree.observation_at[m]
            outside[at] += L[0, 0] * x0 + L[1, 0] * x1 + L[2, 0] * x2
            outside[at + 1] += L[0, 1] * x0 + L[1, 1] * x1 + L[2, 1] * x2


@njit
def solve_leaf_to_front(
    tree: Tree, system: NormalEquations, rows: SquareRootFactor, leaf: int, inside: FloatBlocks, outside: FloatMatrix
) -> None:
    """Apply `solve_leaf` to each of inside (k, K, 3), and add B^T of the results to outside (k, w)."""
    tree, system, rows = borrow(tree), borrow(system), borrow(rows)
    for i in range(len(inside)):
        solve_leaf(tree, rows, leaf, inside[i])
        leaf_to_front(tree, system, leaf, inside[i], outside[i])


@inner
def _front_to_leaf(tree: Tree, system: NormalEquations, leaf: int, outside: FloatArray, inside: FloatArray) -> None:
    """Subtract B outside from inside (K, 3)."""
    first, end = tree.first[leaf], tree.end[leaf]
    n_left = tree.calibration_at[leaf]
    size = tree.front_start[leaf + 1] - tree.front_start[leaf]
    if first == end:
        return
    for i in range(3):
        for j in range(3):
            if n_left:
                inside[0, j] -= system.pose_next[first - 1, i, j] * outside[i]
            if tree.right[leaf] >= 0:
                inside[end - 1 - first, j] -= system.pose_next[end - 1, j, i] * outside[size - 3 + i]
    for pose in range(first, end):
        for i in range(3):
            rest = inside[pose - first, i]
            for a in range(n_slots_of(tree, leaf)):
                rest -= system.pose_calibration[pose, i, a] * outside[n_left + a]
            for m in range(tree.observation_start[pose], tree.observation_start[pose + 1]):
                at = tree.observation_at[m]
                rest -= system.pose_tag[m, i, 0] * outside[at] + system.pose_tag[m, i, 1] * outside[at + 1]
            inside[pose - first, i] = rest


def product(tree: Tree, system: NormalEquations, x: FloatArray) -> FloatArray:
    """Return H x, in the arrowhead's order."""
    y = np.zeros(len(x))
    poses, tags, calibration = _split(tree, x)
    of_poses, of_tags, of_calibration = _split(tree, y)
    of_poses += np.einsum("pij,pj->pi", system.pose, poses)
    of_poses[:-1] += np.einsum("pij,pj->pi", system.pose_next[:-1], poses[1:])  # zero from one segment to the next
    of_poses[1:] += np.einsum("pij,pi->pj", system.pose_next[:-1], poses[:-1])
    columns = np.zeros((len(tree.slot_start) - 1, tree.n_slots), dtype=np.int64)  # any where blocks are zero
    for segment, (first, end) in enumerate(pairwise(tree.segment_start.tolist())):
        slots = tree.slots[tree.slot_start[segment] : tree.slot_start[segment + 1]]
        columns[segment, : len(slots)] = slots
        blocks = system.pose_calibration[first:end, :, : len(slots)]
        of_poses[first:end] += blocks @ calibration[slots]
        of_calibration[slots] += np.einsum("pia,pi->a", blocks, poses[first:end])
    pose = np.repeat(np.arange(tree.n_poses), np.diff(tree.observation_start))
    np.add.at(of_poses, pose, np.einsum("mij,mj->mi", system.pose_tag, tags[tree.observation_tag]))
    np.add.at(of_tags, tree.observation_tag, np.einsum("mij,mi->mj", system.pose_tag, poses[pose]))
    of_tags += np.einsum("tij,tj->ti", system.tag, tags)
    of_calibration += system.calibration @ calibration
    tag, columns = np.repeat(np.arange(tree.n_tags), np.diff(tree.tag_segment_start)), columns[tree.tag_segments]
    np.add.at(of_tags, tag, np.einsum("qia,qa->qi", system.tag_calibration, calibration[columns]))
    np.add.at(of_calibration, columns, np.einsum("qia,qi->qa", system.tag_calibration, tags[tag]))
    return y


def _split(tree: Tree, vector: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return views of the entries of poses (P, 3), tags (T, 2) and calibration (C,)."""
    first_tag, first_calibration = 3 * tree.n_poses, 3 * tree.n_poses + 2 * tree.n_tags
    return (
        vector[:first_tag].reshape(-1, 3),
        vector[first_tag:first_calibration].reshape(-1, 2),
        vector[first_calibration:],
    )
