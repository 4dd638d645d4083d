"""Compiled inner loops of the arrowhead system: eliminate. See `arrowhead_tree` for the order.

Fronts are square, their upper triangles used. What is eliminated leaves rows of R, with R^T R = H: the square root
information matrix. The poses of a leaf leave only their own 3 x 3 blocks; their coupling to the border is taken from
the blocks of H again when needed, so that fill is never stored.
"""

from typing import NamedTuple

import numpy as np

from calib.arrays import FloatArray
from offline.arrowhead_cut import LEVELS
from offline.arrowhead_tree import Tree
from offline.jit import borrowed, inner, jitted


class System(NamedTuple):
    """H = J^T J and g = J^T r in blocks. Columns that are held have a one on the diagonal and nothing else.

    Attributes:
        pose: (P, 3, 3) diagonal blocks; pose_next: (P, 3, 3) rows of a pose, columns of the next one.
        pose_calibration: (P, 3, n_slots) by the calibration of the pose's chain.
        pose_tag: (M, 3, 2) by the tag of each reading.
        tag: (T, 2, 2) diagonal blocks; tag_calibration: (T, 2, C).
        calibration: (C, C).
        gradient: (3P + 2T + C,).
    """

    pose: FloatArray
    pose_next: FloatArray
    pose_calibration: FloatArray
    pose_tag: FloatArray
    tag: FloatArray
    tag_calibration: FloatArray
    calibration: FloatArray
    gradient: FloatArray


class Rows(NamedTuple):
    """What elimination leaves.

    Attributes:
        pose: (P, 3, 3) of the poses in leaves U with ones on the diagonal, and 1 / D in their place: R = sqrt(D) U.
        pose_next: (P, 3, 3) U by the next pose of the leaf or the separator after it.
        inner: rows (n_eliminated, front) of the nodes between leaves and top.
        workspace: fronts being built up, one a level; the last one is the top's.
        border, blocks, inside: room for what couples two poses to a leaf's front (2, 3, w), for two blocks (2, 3, 3),
            and for a vector in a leaf (K, 3).
    """

    pose: FloatArray
    pose_next: FloatArray
    inner: FloatArray
    workspace: FloatArray
    border: FloatArray
    blocks: FloatArray
    inside: FloatArray


@jitted
def eliminate(tree: Tree, system: System, damping: float, rows: Rows, begin: int, end: int) -> int:
    """Eliminates some nodes, but for the top, whose front is left in the workspace.

    Args:
        tree: the order.
        system: the blocks.
        damping: share of the diagonal that is added to it.
        rows: takes the result; its workspace must be zero but for what earlier nodes have left for the top.
        begin: the first node.
        end: one beyond the last; they are whole chains, or the top, or both.

    Returns:
        -1, or the first column whose pivot is not positive.
    """
    tree, system, rows = borrowed(tree), borrowed(system), borrowed(rows)
    for node in range(begin, end):
        front = _front_of(tree, node, rows.workspace)
        if tree.level[node] == 0:
            failed = _eliminate_leaf(tree, system, damping, node, rows, front)
        else:
            _add_separators(tree, system, damping, node, front)
            _add_tags(tree, system, damping, node, front)
            if tree.level[node] == LEVELS - 1:
                _add_calibration(tree, system, damping, front)
                return -1
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
def _eliminate_leaf(tree: Tree, system: System, damping: float, leaf: int, rows: Rows, front: FloatArray) -> int:
    """Pose by pose; `now` (3, w) couples the pose to the border seen so far.

    U^T D U = H, Y = U^-T now, Z = U^-T next.
    """
    first, end, n_left = tree.first[leaf], tree.end[leaf], tree.calibration_at[leaf]
    n_slots = n_slots_of(tree, leaf)
    width = n_left + n_slots
    now, following, block, carried = rows.border[0], rows.border[1], rows.blocks[0], rows.blocks[1]
    _begin_leaf(system, first, n_left, width, now, carried)
    for pose in range(first, end):
        for i in range(3):
            for j in range(3):
                block[i, j] = system.pose[pose, i, j] + carried[i, j]
            block[i, i] += damping * system.pose[pose, i, i]
            for a in range(n_slots):
                now[i, n_left + a] += system.pose_calibration[pose, i, a]
        width = _add_readings(tree, system, pose, now, width)
        U, Z = rows.pose[pose], rows.pose_next[pose]
        failed = _square_root(block, U)
        if failed >= 0:
            return int(3 * pose + failed)
        _solve_transposed(U, now, width)
        if pose + 1 < end or tree.right[leaf] >= 0:
            _solve_next(U, system.pose_next[pose], Z)
            _carry_on(U, Z, now, width, carried, following)
        _subtract_square(front, U, now, width)
        now, following = following, now
    if tree.right[leaf] >= 0:
        _add_rest(front, carried, now, width)
    return -1


@inner
def _begin_leaf(system: System, first: int, n_left: int, width: int, now: FloatArray, carried: FloatArray) -> None:
    """Before a leaf's first pose: nothing is carried, and only the separator on the left is coupled."""
    for i in range(3):
        for j in range(3):
            carried[i, j] = 0.0
        for a in range(width):
            now[i, a] = system.pose_next[first - 1, a, i] if a < n_left else 0.0


@inner
def _add_rest(front: FloatArray, carried: FloatArray, now: FloatArray, width: int) -> None:
    """What is left of a leaf's last pose for the separator on the right."""
    at = front.shape[0] - 3
    for i in range(3):
        for j in range(3):
            front[at + i, at + j] += carried[i, j]
        for a in range(width):
            front[a, at + i] += now[i, a]


@inner
def _solve_next(U: FloatArray, N: FloatArray, Z: FloatArray) -> None:
    """Z = U^-T N."""
    for j in range(3):
        z0 = N[0, j]
        z1 = N[1, j] - U[0, 1] * z0
        Z[0, j], Z[1, j], Z[2, j] = z0, z1, N[2, j] - U[0, 2] * z0 - U[1, 2] * z1


@inner
def _carry_on(
    U: FloatArray, Z: FloatArray, Y: FloatArray, width: int, carried: FloatArray, following: FloatArray
) -> None:
    """What is left of a pose for the next one: carried = -Z^T D^-1 Z, following = -Z^T D^-1 Y."""
    for i in range(3):
        z0, z1, z2 = U[0, 0] * Z[0, i], U[1, 1] * Z[1, i], U[2, 2] * Z[2, i]
        for j in range(3):
            carried[i, j] = -(z0 * Z[0, j] + z1 * Z[1, j] + z2 * Z[2, j])
        for a in range(width):
            following[i, a] = -(z0 * Y[0, a] + z1 * Y[1, a] + z2 * Y[2, a])


@inner
def n_slots_of(tree: Tree, node: int) -> int:
    """How much calibration the chain of a node is coupled to."""
    chain = tree.chain[node]
    return int(tree.slot_start[chain + 1] - tree.slot_start[chain])


@inner
def _add_readings(tree: Tree, system: System, pose: int, coupled: FloatArray, width: int) -> int:
    """Adds a pose's coupling to tags; tags come in the order of first reading, so a new one is always the next."""
    for m in range(tree.reading_start[pose], tree.reading_start[pose + 1]):
        at = tree.reading_at[m]
        if at == width:
            for i in range(3):
                coupled[i, at], coupled[i, at + 1] = 0.0, 0.0
            width += 2
        for i in range(3):
            coupled[i, at] += system.pose_tag[m, i, 0]
            coupled[i, at + 1] += system.pose_tag[m, i, 1]
    return width


@inner
def _square_root(block: FloatArray, U: FloatArray) -> int:
    """U^T D U = block, 1 / D on the diagonal; -1, or the column without a positive pivot. Roots would take longer."""
    if not block[0, 0] > 0.0:
        return 0
    i0 = 1.0 / block[0, 0]
    u01, u02 = block[0, 1] * i0, block[0, 2] * i0
    d1, rest = block[1, 1] - u01 * block[0, 1], block[1, 2] - u01 * block[0, 2]
    if not d1 > 0.0:
        return 1
    i1 = 1.0 / d1
    u12 = rest * i1
    d2 = block[2, 2] - u02 * block[0, 2] - u12 * rest
    if not d2 > 0.0:
        return 2
    U[0, 0], U[0, 1], U[0, 2], U[1, 1], U[1, 2], U[2, 2] = i0, u01, u02, i1, u12, 1.0 / d2
    return -1


@inner
def _solve_transposed(U: FloatArray, B: FloatArray, width: int) -> None:
    """B <- U^-T B for the first columns of B (3, w)."""
    u01, u02, u12 = U[0, 1], U[0, 2], U[1, 2]
    for a in range(width):
        y0 = B[0, a]
        y1 = B[1, a] - u01 * y0
        B[1, a], B[2, a] = y1, B[2, a] - u02 * y0 - u12 * y1


@inner
def _subtract_square(front: FloatArray, U: FloatArray, Y: FloatArray, width: int) -> None:
    """Front -= Y^T D^-1 Y: both triangles, since loops of full length are the faster ones."""
    for a in range(width):
        y0, y1, y2 = U[0, 0] * Y[0, a], U[1, 1] * Y[1, a], U[2, 2] * Y[2, a]
        for b in range(width):
            front[a, b] -= y0 * Y[0, b] + y1 * Y[1, b] + y2 * Y[2, b]


@inner
def _add_separators(tree: Tree, system: System, damping: float, node: int, front: FloatArray) -> None:
    """The separators' own entries of H."""
    is_top = tree.level[node] == LEVELS - 1
    for k in range(tree.separator_start[node], tree.separator_start[node + 1]):
        pose, row = tree.separators[k], 3 * (k - tree.separator_start[node])
        for i in range(3):
            for j in range(i, 3):
                front[row + i, row + j] += system.pose[pose, i, j]
            front[row + i, row + i] += damping * system.pose[pose, i, i]
        for m in range(tree.reading_start[pose], tree.reading_start[pose + 1]):
            for i in range(3):
                for j in range(2):
                    front[row + i, tree.reading_at[m] + j] += system.pose_tag[m, i, j]
        chain = tree.separator_chain[k]
        for a in range(tree.slot_start[chain], tree.slot_start[chain + 1]):
            slot = a - tree.slot_start[chain]
            at = tree.calibration_at[node] + (tree.slots[a] if is_top else slot)
            for i in range(3):
                front[row + i, at] += system.pose_calibration[pose, i, slot]


@inner
def _add_tags(tree: Tree, system: System, damping: float, node: int, front: FloatArray) -> None:
    """The own entries of H of the tags that a node eliminates."""
    is_top = tree.level[node] == LEVELS - 1
    row = 3 * (tree.separator_start[node + 1] - tree.separator_start[node])
    n_calibration = tree.n_calibration if is_top else n_slots_of(tree, node)
    for k in range(tree.tag_start[node], tree.tag_start[node + 1]):
        tag = tree.tags[k]
        front[row, row] += (1.0 + damping) * system.tag[tag, 0, 0]
        front[row, row + 1] += system.tag[tag, 0, 1]
        front[row + 1, row + 1] += (1.0 + damping) * system.tag[tag, 1, 1]
        for a in range(n_calibration):
            column = a if is_top else tree.slots[tree.slot_start[tree.chain[node]] + a]
            for i in range(2):
                front[row + i, tree.calibration_at[node] + a] += system.tag_calibration[tag, i, column]
        row += 2


@inner
def _add_calibration(tree: Tree, system: System, damping: float, front: FloatArray) -> None:
    first = tree.calibration_at[-1]
    for a in range(tree.n_calibration):
        for b in range(a, tree.n_calibration):
            front[first + a, first + b] += system.calibration[a, b]
        front[first + a, first + a] += damping * system.calibration[a, a]


@inner
def _eliminate_front(tree: Tree, node: int, rows: Rows, front: FloatArray) -> int:
    """Partial Cholesky: the first columns become rows of R, the rest loses what they explain."""
    n, size = tree.n_eliminated[node], front.shape[0]
    for first in range(0, n, 4):
        end = min(first + 4, n)
        failed = _eliminate_panel(front, first, end)
        if failed >= 0:
            return int(tree.front[tree.front_start[node] + failed])
        if end - first == 4:
            _subtract_four(front, first)
        else:
            for k in range(first, end):
                for r in range(end, size):
                    _subtract_one(front, k, r)
    start = tree.rows_start[node]
    for i in range(n):
        for j in range(size):
            rows.inner[start + i * size + j] = front[i, j]
    return -1


@inner
def _eliminate_panel(front: FloatArray, first: int, end: int) -> int:
    """Rows first to end - 1 of R; -1, or the row without a positive pivot."""
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
    """Row r loses its product with row k of R. Loops over slices need no look at the sign of an index."""
    factor, row, rest = front[k, r], front[k, r:], front[r, r:]
    for j in range(len(rest)):
        rest[j] -= factor * row[j]


@inner
def _subtract_four(front: FloatArray, k: int) -> None:
    """The rows below four rows of R, from k on, lose their products."""
    for r in range(k + 4, len(front)):
        f0, f1, f2, f3 = front[k, r], front[k + 1, r], front[k + 2, r], front[k + 3, r]
        if f0 == 0.0 and f1 == 0.0 and f2 == 0.0 and f3 == 0.0:
            continue  # separators do not reach all tags
        rest, r0, r1, r2, r3 = front[r, r:], front[k, r:], front[k + 1, r:], front[k + 2, r:], front[k + 3, r:]
        for j in range(len(rest)):
            rest[j] -= f0 * r0[j] + f1 * r1[j] + f2 * r2[j] + f3 * r3[j]


@inner
def _add_to_parent(tree: Tree, node: int, front: FloatArray, workspace: FloatArray) -> None:
    """What is left of a front is added to the parent's."""
    above = _front_of(tree, tree.parent[node], workspace)
    start, size = tree.front_start[node], front.shape[0]
    up = tree.up[start : start + size]
    for a in range(tree.n_eliminated[node], size):
        row = up[a]
        for b in range(a, size):
            above[min(row, up[b]), max(row, up[b])] += front[a, b]
