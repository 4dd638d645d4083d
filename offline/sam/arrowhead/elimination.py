"""Compiled elimination of the arrowhead system, in the order of `arrowhead.tree`.

Fronts are square; only their upper triangles are used. Eliminated columns become rows of the square-root information
matrix R, with R^T R = H. For poses of a leaf only the 3 x 3 blocks are stored. Their coupling to the leaf's front is
computed again from the blocks of H when needed, which avoids storing fill-in.
"""

import numpy as np

from groundsbot.calib.foundation import FloatArray
from groundsbot.offline.foundation import borrow, inner, njit
from groundsbot.offline.sam.arrowhead.dissection import LEVELS
from groundsbot.offline.sam.arrowhead.leaf_elimination import eliminate_leaf
from groundsbot.offline.sam.arrowhead.tree import Tree
from groundsbot.offline.sam.linearisation.blocks import NormalEquations, SquareRootFactor


@njit
def eliminate(tree: Tree, system: NormalEquations, damping: float, rows: SquareRootFactor) -> int:
    """Eliminate all nodes but the top, whose front remains in the workspace.

    Args:
        tree: order of elimination.
        system: normal equations.
        damping: share of the diagonal that is added to it.
        rows: result; its workspace must be zero on entry.

    Returns:
        -1, or the first column without a positive pivot.
    """
    tree, system, rows = borrow(tree), borrow(system), borrow(rows)
    for node in range(len(tree.level)):
        front = _front_of(tree, node, rows.workspace)
        if tree.level[node] == 0:
            failed = eliminate_leaf(tree, system, damping, node, rows, front)
        else:
            _add_separators(tree, system, damping, node, front)
            _add_tags(tree, system, damping, node, front)
            if tree.level[node] == LEVELS - 1:
                _add_calibration(tree, system, damping, front)
                return -1
            if tree.level[node] == LEVELS - 2:
                _add_own_calibration(tree, system, damping, node, front)
            failed = _eliminate_front(tree, node, rows, front)
        if failed >= 0:
            return int(failed)
        _add_to_parent(tree, node, front, rows.workspace)
        for i in range(len(front)):
            for j in range(len(front)):
                front[i, j] = 0.0
    return -1


@inner
def _front_of(tree: Tree, node: int, workspace: FloatArray) -> FloatArray:
    size = tree.front_start[node + 1] - tree.front_start[node]
    start = tree.workspace_start[tree.level[node]]
    return workspace[start : start + size * size].reshape((size, size))


@inner
def _add_separators(tree: Tree, system: NormalEquations, damping: float, node: int, front: FloatArray) -> None:
    """Add the entries of H in the rows of a node's separators."""
    for k in range(tree.separator_start[node], tree.separator_start[node + 1]):
        pose, row = tree.separators[k], 3 * (k - tree.separator_start[node])
        for i in range(3):
            for j in range(i, 3):
                front[row + i, row + j] += system.pose[pose, i, j]
            front[row + i, row + i] += damping * system.pose[pose, i, i]
        for m in range(tree.observation_start[pose], tree.observation_start[pose + 1]):
            for i in range(3):
                for j in range(2):
                    front[row + i, tree.observation_at[m] + j] += system.pose_tag[m, i, j]
        _add_slots(tree, node, tree.separator_segment[k], system.pose_calibration[pose], row, front)


@inner
def _add_tags(tree: Tree, system: NormalEquations, damping: float, node: int, front: FloatArray) -> None:
    """Add the entries of H in the rows of the tags that a node eliminates."""
    row = 3 * (tree.separator_start[node + 1] - tree.separator_start[node])
    for k in range(tree.tag_start[node], tree.tag_start[node + 1]):
        tag = tree.tags[k]
        front[row, row] += (1.0 + damping) * system.tag[tag, 0, 0]
        front[row, row + 1] += system.tag[tag, 0, 1]
        front[row + 1, row + 1] += (1.0 + damping) * system.tag[tag, 1, 1]
        for q in range(tree.tag_segment_start[tag], tree.tag_segment_start[tag + 1]):
            _add_slots(tree, node, tree.tag_segments[q], system.tag_calibration[q], row, front)
        row += 2


@inner
def _add_slots(tree: Tree, node: int, segment: int, block: FloatArray, row: int, front: FloatArray) -> None:
    """Add a block (n, n_slots) of n rows and a segment's calibration, but for what is eliminated before the node."""
    is_top = tree.level[node] == LEVELS - 1
    for a in range(tree.slot_start[segment], tree.slot_start[segment + 1]):
        slot = a - tree.slot_start[segment]
        place = tree.calibration_in_top[tree.slots[a]] if is_top else slot
        if place < 0:
            continue
        for i in range(len(block)):
            front[row + i, tree.calibration_at[node] + place] += block[i, slot]


@inner
def _add_calibration(tree: Tree, system: NormalEquations, damping: float, front: FloatArray) -> None:
    """Add the entries of H in the rows of the calibration in the top."""
    first = tree.calibration_at[-1]
    for a in range(tree.n_calibration):
        row = first + tree.calibration_in_top[a]
        if row < first:
            continue
        for b in range(a, tree.n_calibration):
            if tree.calibration_in_top[b] >= 0:
                front[row, first + tree.calibration_in_top[b]] += system.calibration[a, b]
        front[row, row] += damping * system.calibration[a, a]


@inner
def _add_own_calibration(tree: Tree, system: NormalEquations, damping: float, node: int, front: FloatArray) -> None:
    """Add the entries of H in the rows of the calibration that the node of a segment eliminates.

    Its columns are those of the segment's calibration, then those of tags in the top.
    """
    segment, first = tree.segment[node], tree.calibration_at[node]
    start = tree.slot_start[segment]
    n_slots, n_own = tree.slot_start[segment + 1] - start, tree.n_own_slots[segment]
    if n_own == 0:
        return
    for a in range(n_own):
        for b in range(a, n_slots):
            front[first + a, first + b] += system.calibration[tree.slots[start + a], tree.slots[start + b]]
        front[first + a, first + a] += damping * system.calibration[tree.slots[start + a], tree.slots[start + a]]
    for column in range(first + n_slots, len(front), 2):
        tag = (tree.front[tree.front_start[node] + column] - 3 * tree.n_poses) // 2
        tag_segment = tree.tag_segment_start[tag]
        while tree.tag_segments[tag_segment] != segment:
            tag_segment += 1
        for a in range(n_own):
            for i in range(2):
                front[first + a, column + i] += system.tag_calibration[tag_segment, i, a]


@inner
def _eliminate_front(tree: Tree, node: int, rows: SquareRootFactor, front: FloatArray) -> int:
    """Eliminate a front's own columns by partial Cholesky, and store their rows of R."""
    n, size = tree.n_eliminated[node], front.shape[0]
    failed = eliminate_columns(front, n)
    if failed >= 0:
        return int(tree.front[tree.front_start[node] + failed])
    start = tree.rows_start[node]
    for i in range(n):
        for j in range(size):
            rows.inner[start + i * size + j] = front[i, j]
    return -1


@inner
def eliminate_columns(front: FloatArray, n: int) -> int:
    """Eliminate the first n columns of an upper triangle by partial Cholesky.

    Returns:
        -1, or the column without a positive pivot.
    """
    for first in range(0, n, 4):
        end = min(first + 4, n)
        failed = _eliminate_panel(front, first, end)
        if failed >= 0:
            return failed
        if end - first == 4:
            _subtract_four(front, first)
        else:
            for k in range(first, end):
                for r in range(end, len(front)):
                    _subtract_one(front, k, r)
    return -1


@inner
def _eliminate_panel(front: FloatArray, first: int, end: int) -> int:
    """Compute rows first to end - 1 of R; return -1, or the row without a positive pivot."""
    for k in range(first, end):
        if not front[k, k] > 0.0:
            return k
        root = np.sqrt(front[k, k])
        inverse = 1.0 / root
        front[k, k] = root
        row = front[k, k + 1 :]
        for j in range(len(row)):
            row[j] *= inverse
        for r in range(k + 1, end):
            _subtract_one(front, k, r)
    return -1


@inner
def _subtract_one(front: FloatArray, k: int, r: int) -> None:
    """Subtract from row r its product with row k of R; loops over slices avoid checks for negative indices."""
    factor, row, rest = front[k, r], front[k, r:], front[r, r:]
    for j in range(len(rest)):
        rest[j] -= factor * row[j]


@inner
def _subtract_four(front: FloatArray, k: int) -> None:
    """Subtract the products of four rows of R, from k on, from the rows below."""
    for r in range(k + 4, len(front)):
        f0, f1, f2, f3 = front[k, r], front[k + 1, r], front[k + 2, r], front[k + 3, r]
        if f0 == 0.0 and f1 == 0.0 and f2 == 0.0 and f3 == 0.0:
            continue  # separators are not coupled with all tags
        rest, r0, r1, r2, r3 = front[r, r:], front[k, r:], front[k + 1, r:], front[k + 2, r:], front[k + 3, r:]
        for j in range(len(rest)):
            rest[j] -= f0 * r0[j] + f1 * r1[j] + f2 * r2[j] + f3 * r3[j]


@inner
def _add_to_parent(tree: Tree, node: int, front: FloatArray, workspace: FloatArray) -> None:
    """Add the Schur complement of a front to the parent's front."""
    above = _front_of(tree, tree.parent[node], workspace)
    start, size = tree.front_start[node], front.shape[0]
    up = tree.up[start : start + size]
    for a in range(tree.n_eliminated[node], size):
        row = up[a]
        for b in range(a, size):
            above[min(row, up[b]), max(row, up[b])] += front[a, b]
