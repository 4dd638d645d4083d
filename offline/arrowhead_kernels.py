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
from offline.jit import borrowed, jitted


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
    """

    pose: FloatArray
    pose_next: FloatArray
    inner: FloatArray
    workspace: FloatArray


@jitted
def eliminate(tree: Tree, system: System, damping: float, rows: Rows) -> int:
    """Eliminates all but the top, whose front is left in the workspace.

    Args:
        tree: the order.
        system: the blocks.
        damping: share of the diagonal that is added to it.
        rows: takes the result.

    Returns:
        -1, or the first column whose pivot is not positive.
    """
    rows.workspace[:] = 0.0
    widest = 0
    for node in range(len(tree.level) - 1):
        if tree.level[node] == 0:
            widest = max(widest, tree.front_start[node + 1] - tree.front_start[node])
    return _eliminate_nodes(tree, system, damping, rows, np.zeros((2, 3, widest)), np.zeros((2, 3, 3)))


@jitted
def _eliminate_nodes(
    tree: Tree, system: System, damping: float, rows: Rows, border: FloatArray, blocks: FloatArray
) -> int:
    """Children first, with room for what couples two poses to a leaf's border, and for two blocks."""
    tree, system, rows = borrowed(tree), borrowed(system), borrowed(rows)
    border, blocks = borrowed(border), borrowed(blocks)
    for node in range(len(tree.level)):
        front = _front_of(tree, node, rows.workspace)
        if tree.level[node] == 0:
            failed = _eliminate_leaf(tree, system, damping, node, rows, front, border, blocks)
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
        front[:] = 0.0
    return -1


@jitted
def _front_of(tree: Tree, node: int, workspace: FloatArray) -> FloatArray:
    size = tree.front_start[node + 1] - tree.front_start[node]
    start = tree.workspace_start[tree.level[node]]
    return workspace[start : start + size * size].reshape((size, size))


@jitted
def _eliminate_leaf(
    tree: Tree,
    system: System,
    damping: float,
    leaf: int,
    rows: Rows,
    front: FloatArray,
    border: FloatArray,
    blocks: FloatArray,
) -> int:
    """Pose by pose; `now` (3, w) couples the pose to the border seen so far.

    U^T D U = H, Y = U^-T now, Z = U^-T next.
    """
    first, end, n_left = tree.first[leaf], tree.end[leaf], tree.calibration_at[leaf]
    n_slots = n_slots_of(tree, leaf)
    width = n_left + n_slots
    now, following, block, carried = border[0], border[1], blocks[0], blocks[1]
    carried[:] = 0.0
    now[:, :width] = 0.0
    if n_left:
        now[:, :3] = system.pose_next[first - 1].T
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
        at = front.shape[0] - 3
        front[at:, at:] += carried
        front[:width, at:] += now[:, :width].T
    return -1


@jitted
def _solve_next(U: FloatArray, N: FloatArray, Z: FloatArray) -> None:
    """Z = U^-T N."""
    for j in range(3):
        z0 = N[0, j]
        z1 = N[1, j] - U[0, 1] * z0
        Z[0, j], Z[1, j], Z[2, j] = z0, z1, N[2, j] - U[0, 2] * z0 - U[1, 2] * z1


@jitted
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


@jitted
def n_slots_of(tree: Tree, node: int) -> int:
    """How much calibration the chain of a node is coupled to."""
    chain = tree.chain[node]
    return int(tree.slot_start[chain + 1] - tree.slot_start[chain])


@jitted
def _add_readings(tree: Tree, system: System, pose: int, coupled: FloatArray, width: int) -> int:
    """Adds a pose's coupling to tags; tags come in the order of first reading, so a new one is always the next."""
    for m in range(tree.reading_start[pose], tree.reading_start[pose + 1]):
        at = tree.reading_at[m]
        if at == width:
            coupled[:, at : at + 2] = 0.0
            width += 2
        for i in range(3):
            coupled[i, at] += system.pose_tag[m, i, 0]
            coupled[i, at + 1] += system.pose_tag[m, i, 1]
    return width


@jitted
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


@jitted
def _solve_transposed(U: FloatArray, B: FloatArray, width: int) -> None:
    """B <- U^-T B for the first columns of B (3, w)."""
    u01, u02, u12 = U[0, 1], U[0, 2], U[1, 2]
    for a in range(width):
        y0 = B[0, a]
        y1 = B[1, a] - u01 * y0
        B[1, a], B[2, a] = y1, B[2, a] - u02 * y0 - u12 * y1


@jitted
def _subtract_square(front: FloatArray, U: FloatArray, Y: FloatArray, width: int) -> None:
    """Front -= Y^T D^-1 Y: both triangles, since loops of full length are the faster ones."""
    for a in range(width):
        y0, y1, y2 = U[0, 0] * Y[0, a], U[1, 1] * Y[1, a], U[2, 2] * Y[2, a]
        for b in range(width):
            front[a, b] -= y0 * Y[0, b] + y1 * Y[1, b] + y2 * Y[2, b]


@jitted
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


@jitted
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


@jitted
def _add_calibration(tree: Tree, system: System, damping: float, front: FloatArray) -> None:
    first = tree.calibration_at[-1]
    for a in range(tree.n_calibration):
        for b in range(a, tree.n_calibration):
            front[first + a, first + b] += system.calibration[a, b]
        front[first + a, first + a] += damping * system.calibration[a, a]


@jitted
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
    rows.inner[start : start + n * size] = front[:n].reshape(n * size)
    return -1


@jitted
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


@jitted
def _subtract_one(front: FloatArray, k: int, r: int) -> None:
    """Row r loses its product with row k of R. Loops over slices need no look at the sign of an index."""
    factor, row, rest = front[k, r], front[k, r:], front[r, r:]
    for j in range(len(rest)):
        rest[j] -= factor * row[j]


@jitted
def _subtract_four(front: FloatArray, k: int) -> None:
    """The rows below four rows of R, from k on, lose their products."""
    for r in range(k + 4, len(front)):
        f0, f1, f2, f3 = front[k, r], front[k + 1, r], front[k + 2, r], front[k + 3, r]
        if f0 == 0.0 and f1 == 0.0 and f2 == 0.0 and f3 == 0.0:
            continue  # separators do not reach all tags
        rest, r0, r1, r2, r3 = front[r, r:], front[k, r:], front[k + 1, r:], front[k + 2, r:], front[k + 3, r:]
        for j in range(len(rest)):
            rest[j] -= f0 * r0[j] + f1 * r1[j] + f2 * r2[j] + f3 * r3[j]


@jitted
def _add_to_parent(tree: Tree, node: int, front: FloatArray, workspace: FloatArray) -> None:
    """What is left of a front is added to the parent's."""
    above = _front_of(tree, tree.parent[node], workspace)
    start, size = tree.front_start[node], front.shape[0]
    up = tree.up[start : start + size]
    for a in range(tree.n_eliminated[node], size):
        row = up[a]
        for b in range(a, size):
            above[min(row, up[b]), max(row, up[b])] += front[a, b]
