"""Compiled inner loops of the arrowhead system: eliminate, substitute. See `arrowhead_tree` for the order.

Fronts are square, their upper triangles used. What is eliminated leaves rows of R, with R^T R = H: the square root
information matrix. The poses of a leaf leave only their own 3 x 3 blocks; their coupling to the border is taken from
the blocks of H again when needed, so that fill is never stored.
"""

from typing import NamedTuple

import numpy as np

from calib.arrays import FloatArray
from offline.arrowhead_tree import LEVELS, Tree
from offline.jit import jitted


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
        pose: (P, 3, 3) upper triangular R of the poses in leaves, with 1 / R on the diagonal.
        pose_next: (P, 3, 3) R by the next pose of the leaf or the separator after it.
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
    now, following = np.zeros((3, widest)), np.zeros((3, widest))
    for node in range(len(tree.level)):
        front = _front_of(tree, node, rows.workspace)
        if tree.level[node] == 0:
            failed = _eliminate_leaf(tree, system, damping, node, rows, front, now, following)
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
    now: FloatArray,
    following: FloatArray,
) -> int:
    """Pose by pose; `now` (3, w) couples the pose to the border seen so far: R^T R = D, Y = R^-T now, Z = R^-T next."""
    first, end = tree.first[leaf], tree.end[leaf]
    size = front.shape[0]
    n_left = tree.calibration_at[leaf]
    width = n_left + _n_slots(tree, leaf)
    now[:, :width] = 0.0
    if n_left:
        for i in range(3):
            for j in range(3):
                now[i, j] = system.pose_next[first - 1, j, i]
    block = np.empty((3, 3))
    carried = np.zeros((3, 3))
    for pose in range(first, end):
        for i in range(3):
            for j in range(3):
                block[i, j] = system.pose[pose, i, j] + carried[i, j]
            block[i, i] += damping * system.pose[pose, i, i]
        for a in range(n_left, n_left + _n_slots(tree, leaf)):
            for i in range(3):
                now[i, a] += system.pose_calibration[pose, i, a - n_left]
        width = _add_readings(tree, system, pose, now, width)
        R, Z = rows.pose[pose], rows.pose_next[pose]
        failed = _square_root(block, R)
        if failed >= 0:
            return 3 * pose + failed
        _solve_transposed(R, now, width)
        has_next = pose + 1 < end or tree.right[leaf] >= 0
        if has_next:
            Z[:] = system.pose_next[pose]
            _solve_transposed(R, Z, 3)
            for i in range(3):
                for j in range(3):
                    carried[i, j] = -(Z[0, i] * Z[0, j] + Z[1, i] * Z[1, j] + Z[2, i] * Z[2, j])
            for i in range(3):
                for a in range(width):
                    following[i, a] = -(Z[0, i] * now[0, a] + Z[1, i] * now[1, a] + Z[2, i] * now[2, a])
        _subtract_square(front, now, width)
        now, following = following, now
    if tree.right[leaf] >= 0:
        for i in range(3):
            for j in range(3):
                front[size - 3 + i, size - 3 + j] += carried[i, j]
            for a in range(width):
                front[a, size - 3 + i] += now[i, a]
    return -1


@jitted
def _n_slots(tree: Tree, node: int) -> int:
    chain = tree.chain[node]
    return tree.slot_start[chain + 1] - tree.slot_start[chain]


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
def _square_root(block: FloatArray, R: FloatArray) -> int:
    """Upper triangular R with R^T R = block, 1 / R on the diagonal; -1, or the column without a positive pivot."""
    for i in range(3):
        for j in range(i, 3):
            rest = block[i, j]
            for k in range(i):
                rest -= R[k, i] * R[k, j]
            if i == j:
                if not rest > 0.0:
                    return i
                R[i, i] = 1.0 / np.sqrt(rest)
            else:
                R[i, j] = rest * R[i, i]
    return -1


@jitted
def _solve_transposed(R: FloatArray, B: FloatArray, width: int) -> None:
    """B <- R^-T B for the first columns of B (3, w)."""
    r01, r02, r12 = R[0, 1], R[0, 2], R[1, 2]
    i0, i1, i2 = R[0, 0], R[1, 1], R[2, 2]
    for a in range(width):
        y0 = B[0, a] * i0
        y1 = (B[1, a] - r01 * y0) * i1
        B[0, a], B[1, a], B[2, a] = y0, y1, (B[2, a] - r02 * y0 - r12 * y1) * i2


@jitted
def _subtract_square(front: FloatArray, Y: FloatArray, width: int) -> None:
    """Upper triangle of front -= Y^T Y."""
    for a in range(width):
        y0, y1, y2 = Y[0, a], Y[1, a], Y[2, a]
        for b in range(a, width):
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
    n_calibration = tree.n_calibration if is_top else _n_slots(tree, node)
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
            _subtract_rows(front, first, end)
    start = tree.rows_start[node]
    rows.inner[start : start + n * size] = front[:n].reshape(n * size)
    return -1


@jitted
def _eliminate_panel(front: FloatArray, first: int, end: int) -> int:
    """Rows first to end - 1 of R; -1, or the row without a positive pivot."""
    size = front.shape[0]
    for k in range(first, end):
        if not front[k, k] > 0.0:
            return k
        root = np.sqrt(front[k, k])
        inverse = 1.0 / root
        front[k, k] = root
        for j in range(k + 1, size):
            front[k, j] *= inverse
        for r in range(k + 1, end):
            factor = front[k, r]
            for j in range(r, size):
                front[r, j] -= factor * front[k, j]
    return -1


@jitted
def _subtract_four(front: FloatArray, first: int) -> None:
    """The rows below four rows of R lose their products."""
    size = front.shape[0]
    for r in range(first + 4, size):
        f0, f1, f2, f3 = front[first, r], front[first + 1, r], front[first + 2, r], front[first + 3, r]
        if f0 == 0.0 and f1 == 0.0 and f2 == 0.0 and f3 == 0.0:
            continue  # separators do not reach all tags
        for j in range(r, size):
            front[r, j] -= (
                f0 * front[first, j] + f1 * front[first + 1, j] + f2 * front[first + 2, j] + f3 * front[first + 3, j]
            )


@jitted
def _subtract_rows(front: FloatArray, first: int, end: int) -> None:
    """The same for fewer rows."""
    size = front.shape[0]
    for k in range(first, end):
        for r in range(end, size):
            factor = front[k, r]
            for j in range(r, size):
                front[r, j] -= factor * front[k, j]


@jitted
def _add_to_parent(tree: Tree, node: int, front: FloatArray, workspace: FloatArray) -> None:
    """What is left of a front is added to the parent's."""
    above = _front_of(tree, tree.parent[node], workspace)
    start, size = tree.front_start[node], front.shape[0]
    for a in range(tree.n_eliminated[node], size):
        row = tree.up[start + a]
        for b in range(a, size):
            column = tree.up[start + b]
            if row <= column:
                above[row, column] += front[a, b]
            else:
                above[column, row] += front[a, b]


@jitted
def forward(tree: Tree, system: System, rows: Rows, vector: FloatArray) -> None:
    """vector (n,) <- what is left of it for the top, R^-T vector elsewhere; a leaf's own poses stay as they are."""
    inside, outside = _scratch(tree)
    for node in range(len(tree.level) - 1):
        start, end = tree.front_start[node], tree.front_start[node + 1]
        if tree.level[node] == 0:
            first, last = tree.first[node], tree.end[node]
            inside[: last - first] = vector[3 * first : 3 * last].reshape((last - first, 3))
            solve_leaf(tree, rows, node, inside)
            outside[: end - start] = 0.0
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


@jitted
def backward(tree: Tree, system: System, rows: Rows, vector: FloatArray) -> None:
    """vector (n,), solved for the top and from `forward` elsewhere <- the solution."""
    inside, outside = _scratch(tree)
    for node in range(len(tree.level) - 2, -1, -1):
        start, end = tree.front_start[node], tree.front_start[node + 1]
        columns = tree.front[start:end]
        if tree.level[node] == 0:
            first, last = tree.first[node], tree.end[node]
            for a in range(end - start):
                outside[a] = vector[columns[a]]
            inside[: last - first] = vector[3 * first : 3 * last].reshape((last - first, 3))
            _front_to_leaf(tree, system, node, outside, inside)
            solve_leaf(tree, rows, node, inside)
            vector[3 * first : 3 * last] = inside[: last - first].reshape(3 * (last - first))
            continue
        R = _rows_of(tree, node, rows)
        for k in range(len(R) - 1, -1, -1):
            rest = vector[columns[k]]
            for a in range(k + 1, len(columns)):
                rest -= R[k, a] * vector[columns[a]]
            vector[columns[k]] = rest / R[k, k]


@jitted
def _scratch(tree: Tree) -> tuple[FloatArray, FloatArray]:
    longest, widest = 0, 0
    for node in range(len(tree.level) - 1):
        if tree.level[node] == 0:
            longest = max(longest, tree.end[node] - tree.first[node])
            widest = max(widest, tree.front_start[node + 1] - tree.front_start[node])
    return np.empty((longest, 3)), np.empty(widest)


@jitted
def _rows_of(tree: Tree, node: int, rows: Rows) -> FloatArray:
    n, size = tree.n_eliminated[node], tree.front_start[node + 1] - tree.front_start[node]
    return rows.inner[tree.rows_start[node] : tree.rows_start[node] + n * size].reshape((n, size))


@jitted
def solve_leaf(tree: Tree, rows: Rows, leaf: int, inside: FloatArray) -> None:
    """inside (K, 3) <- A^-1 inside, with A the block tridiagonal part of H of the leaf's poses."""
    first, n = tree.first[leaf], tree.end[leaf] - tree.first[leaf]
    x0, x1, x2 = 0.0, 0.0, 0.0
    for k in range(n):
        R = rows.pose[first + k]
        b0, b1, b2 = inside[k, 0], inside[k, 1], inside[k, 2]
        if k:
            Z = rows.pose_next[first + k - 1]
            b0 -= Z[0, 0] * x0 + Z[1, 0] * x1 + Z[2, 0] * x2
            b1 -= Z[0, 1] * x0 + Z[1, 1] * x1 + Z[2, 1] * x2
            b2 -= Z[0, 2] * x0 + Z[1, 2] * x1 + Z[2, 2] * x2
        x0 = b0 * R[0, 0]
        x1 = (b1 - R[0, 1] * x0) * R[1, 1]
        x2 = (b2 - R[0, 2] * x0 - R[1, 2] * x1) * R[2, 2]
        inside[k, 0], inside[k, 1], inside[k, 2] = x0, x1, x2
    for k in range(n - 1, -1, -1):
        R = rows.pose[first + k]
        b0, b1, b2 = inside[k, 0], inside[k, 1], inside[k, 2]
        if k + 1 < n:
            Z = rows.pose_next[first + k]
            b0 -= Z[0, 0] * x0 + Z[0, 1] * x1 + Z[0, 2] * x2
            b1 -= Z[1, 0] * x0 + Z[1, 1] * x1 + Z[1, 2] * x2
            b2 -= Z[2, 0] * x0 + Z[2, 1] * x1 + Z[2, 2] * x2
        x2 = b2 * R[2, 2]
        x1 = (b1 - R[1, 2] * x2) * R[1, 1]
        x0 = (b0 - R[0, 1] * x1 - R[0, 2] * x2) * R[0, 0]
        inside[k, 0], inside[k, 1], inside[k, 2] = x0, x1, x2


@jitted
def leaf_to_front(tree: Tree, system: System, leaf: int, inside: FloatArray, outside: FloatArray) -> None:
    """outside (w,) += B^T inside, with B the blocks of H between the leaf's poses and its front."""
    first, end = tree.first[leaf], tree.end[leaf]
    n_left = tree.calibration_at[leaf]
    size = tree.front_start[leaf + 1] - tree.front_start[leaf]
    for i in range(3):
        for j in range(3):
            if n_left:
                outside[i] += system.pose_next[first - 1, i, j] * inside[0, j]
            if tree.right[leaf] >= 0:
                outside[size - 3 + i] += system.pose_next[end - 1, j, i] * inside[end - 1 - first, j]
    for pose in range(first, end):
        x0, x1, x2 = inside[pose - first, 0], inside[pose - first, 1], inside[pose - first, 2]
        for a in range(_n_slots(tree, leaf)):
            C = system.pose_calibration[pose]
            outside[n_left + a] += C[0, a] * x0 + C[1, a] * x1 + C[2, a] * x2
        for m in range(tree.reading_start[pose], tree.reading_start[pose + 1]):
            L, at = system.pose_tag[m], tree.reading_at[m]
            outside[at] += L[0, 0] * x0 + L[1, 0] * x1 + L[2, 0] * x2
            outside[at + 1] += L[0, 1] * x0 + L[1, 1] * x1 + L[2, 1] * x2


@jitted
def _front_to_leaf(tree: Tree, system: System, leaf: int, outside: FloatArray, inside: FloatArray) -> None:
    """inside (K, 3) -= B outside."""
    first, end = tree.first[leaf], tree.end[leaf]
    n_left = tree.calibration_at[leaf]
    size = tree.front_start[leaf + 1] - tree.front_start[leaf]
    for i in range(3):
        for j in range(3):
            if n_left:
                inside[0, j] -= system.pose_next[first - 1, i, j] * outside[i]
            if tree.right[leaf] >= 0:
                inside[end - 1 - first, j] -= system.pose_next[end - 1, j, i] * outside[size - 3 + i]
    for pose in range(first, end):
        for i in range(3):
            rest = inside[pose - first, i]
            for a in range(_n_slots(tree, leaf)):
                rest -= system.pose_calibration[pose, i, a] * outside[n_left + a]
            for m in range(tree.reading_start[pose], tree.reading_start[pose + 1]):
                at = tree.reading_at[m]
                rest -= system.pose_tag[m, i, 0] * outside[at] + system.pose_tag[m, i, 1] * outside[at + 1]
            inside[pose - first, i] = rest


@jitted
def product(tree: Tree, system: System, x: FloatArray) -> FloatArray:
    """H x, in the arrowhead's order."""
    y = np.zeros(len(x))
    n_poses, n_tags = tree.n_poses, tree.n_tags
    chain = -1
    for pose in range(n_poses):
        if chain + 1 < len(tree.chain_start) and pose == tree.chain_start[chain + 1]:
            chain += 1
        p = 3 * pose
        for i in range(3):
            for j in range(3):
                y[p + i] += system.pose[pose, i, j] * x[p + j]
                if pose + 1 < n_poses:
                    y[p + i] += system.pose_next[pose, i, j] * x[p + 3 + j]
                    y[p + 3 + j] += system.pose_next[pose, i, j] * x[p + i]
            for a in range(tree.slot_start[chain], tree.slot_start[chain + 1]):
                c, value = (
                    3 * n_poses + 2 * n_tags + tree.slots[a],
                    system.pose_calibration[pose, i, a - tree.slot_start[chain]],
                )
                y[p + i] += value * x[c]
                y[c] += value * x[p + i]
            for m in range(tree.reading_start[pose], tree.reading_start[pose + 1]):
                t = 3 * n_poses + 2 * tree.reading_tag[m]
                for j in range(2):
                    y[p + i] += system.pose_tag[m, i, j] * x[t + j]
                    y[t + j] += system.pose_tag[m, i, j] * x[p + i]
    for tag in range(n_tags):
        t = 3 * n_poses + 2 * tag
        for i in range(2):
            for j in range(2):
                y[t + i] += system.tag[tag, i, j] * x[t + j]
            for c in range(tree.n_calibration):
                value = system.tag_calibration[tag, i, c]
                y[t + i] += value * x[3 * n_poses + 2 * n_tags + c]
                y[3 * n_poses + 2 * n_tags + c] += value * x[t + i]
    base = 3 * n_poses + 2 * n_tags
    for a in range(tree.n_calibration):
        for b in range(tree.n_calibration):
            y[base + a] += system.calibration[a, b] * x[base + b]
    return y
