"""Compiled elimination of a leaf, the poses of a segment between two separators; see `arrowhead.elimination`."""

from groundsbot.calib.foundation import FloatArray
from groundsbot.offline.foundation import inner
from groundsbot.offline.sam.arrowhead.tree import Tree, n_slots_of
from groundsbot.offline.sam.linearisation.blocks import NormalEquations, SquareRootFactor


@inner
def eliminate_leaf(
    tree: Tree, system: NormalEquations, damping: float, leaf: int, rows: SquareRootFactor, front: FloatArray
) -> int:
    """Eliminate a leaf pose by pose; return -1, or the column without a positive pivot.

    `now` (3, w) couples the pose to the columns of the front reached so far, and `next` to the next pose. With
    U^T D U the block of H, Y = U^-T now and Z = U^-T next.
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
        width = _add_observations(tree, system, pose, now, width)
        U, Z = rows.pose[pose], rows.pose_next[pose]
        failed = block_square_root(block, U)
        if failed >= 0:
            return int(3 * pose + failed)
        _solve_transpose(U, now, width)
        if pose + 1 < end or tree.right[leaf] >= 0:
            solve_next(U, system.pose_next[pose], Z)
            propagate_to_next(U, Z, now, width, carried, following)
        _subtract_square(front, U, now, width)
        now, following = following, now
    if tree.right[leaf] >= 0:
        _add_to_right_separator(front, carried, now, width)
    return -1


@inner
def _begin_leaf(
    system: NormalEquations, first: int, n_left: int, width: int, now: FloatArray, carried: FloatArray
) -> None:
    """Initialise the coupling of a leaf's first pose: the left separator only."""
    for i in range(3):
        for j in range(3):
            carried[i, j] = 0.0
        for a in range(width):
            now[i, a] = system.pose_next[first - 1, a, i] if a < n_left else 0.0


@inner
def _add_to_right_separator(front: FloatArray, carried: FloatArray, now: FloatArray, width: int) -> None:
    """Add the Schur complement of a leaf's last pose to the right separator."""
    at = front.shape[0] - 3
    for i in range(3):
        for j in range(3):
            front[at + i, at + j] += carried[i, j]
        for a in range(width):
            front[a, at + i] += now[i, a]


@inner
def solve_next(U: FloatArray, N: FloatArray, Z: FloatArray) -> None:
    """Set Z to U^-T N."""
    for j in range(3):
        z0 = N[0, j]
        z1 = N[1, j] - U[0, 1] * z0
        Z[0, j], Z[1, j], Z[2, j] = z0, z1, N[2, j] - U[0, 2] * z0 - U[1, 2] * z1


@inner
def propagate_to_next(
    U: FloatArray, Z: FloatArray, Y: FloatArray, width: int, carried: FloatArray, following: FloatArray
) -> None:
    """Set the Schur complement of a pose on the next one: carried = -Z^T D^-1 Z, following = -Z^T D^-1 Y."""
    for i in range(3):
        z0, z1, z2 = U[0, 0] * Z[0, i], U[1, 1] * Z[1, i], U[2, 2] * Z[2, i]
        for j in range(3):
            carried[i, j] = -(z0 * Z[0, j] + z1 * Z[1, j] + z2 * Z[2, j])
        for a in range(width):
            following[i, a] = -(z0 * Y[0, a] + z1 * Y[1, a] + z2 * Y[2, a])


@inner
def _add_observations(tree: Tree, system: NormalEquations, pose: int, coupled: FloatArray, width: int) -> int:
    """Add a pose's coupling to tags; return the width. Tags are in order of first observation: a new one comes last."""
    for m in range(tree.observation_start[pose], tree.observation_start[pose + 1]):
        at = tree.observation_at[m]
        if at == width:
            for i in range(3):
                coupled[i, at], coupled[i, at + 1] = 0.0, 0.0
            width += 2
        for i in range(3):
            coupled[i, at] += system.pose_tag[m, i, 0]
            coupled[i, at + 1] += system.pose_tag[m, i, 1]
    return width


@inner
def block_square_root(block: FloatArray, U: FloatArray) -> int:
    """Set U with U^T D U = block and 1 / D on its diagonal; return -1, or the column without a positive pivot."""
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
def _solve_transpose(U: FloatArray, B: FloatArray, width: int) -> None:
    """Replace the first `width` columns of B (3, w) by U^-T B."""
    u01, u02, u12 = U[0, 1], U[0, 2], U[1, 2]
    for a in range(width):
        y0 = B[0, a]
        y1 = B[1, a] - u01 * y0
        B[1, a], B[2, a] = y1, B[2, a] - u02 * y0 - u12 * y1


@inner
def _subtract_square(front: FloatArray, U: FloatArray, Y: FloatArray, width: int) -> None:
    """Subtract Y^T D^-1 Y from the front, in both triangles, since loops of constant length are faster."""
    for a in range(width):
        y0, y1, y2 = U[0, 0] * Y[0, a], U[1, 1] * Y[1, a], U[2, 2] * Y[2, a]
        for b in range(width):
            front[a, b] -= y0 * Y[0, b] + y1 * Y[1, b] + y2 * Y[2, b]
