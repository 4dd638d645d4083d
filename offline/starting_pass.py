"""Starting values from one pass in order of time over all chains, like a filter that keeps no cross terms.

Each chain carries its newest pose with a 3 x 3 covariance, each tag a place with a 2 x 2 one, both of all that drifted
since the frame. Errors of pose and tag are correlated in ways that nobody books. So whichever is known clearly better
teaches the other, and near equals teach each other nothing: a tag that the pose itself has just placed leaves its
covariance honest, an older one pulls the pose back. What comes out is not the optimum, but a long drive comes out
unbent.
"""

from typing import Final

import numpy as np

from calib.arrays import FloatArray
from offline.arrowhead_tree import Tree
from offline.jit import jitted
from offline.linearise_kernels import Odometry, Readings, Values

# A reading farther off than this many sigmas is passed over.
_GATE: Final = 6.0
# How many times the other's variance is clearly worse.
_CLEARLY: Final = 2.0


@jitted
def starting_pass(
    tree: Tree, odometry: Odometry, readings: Readings, start: Values, start_variance: FloatArray, out: Values
) -> None:
    """Runs all chains side by side, pose number by pose number.

    Args:
        tree: the chains and who reads what.
        odometry: the motions; calibration is taken from `start`.
        readings: of tags.
        start: its poses count at the start of each chain only.
        start_variance: (number of chains, 3) of each start's right tangent.
        out: takes the result.
    """
    n_chains = len(tree.chain_start) - 1
    covariance = np.zeros((n_chains, 3, 3))
    tag_covariance, known = np.zeros((tree.n_tags, 2, 2)), np.zeros(tree.n_tags, dtype=np.bool_)
    motion_at = np.full(tree.n_poses, -1)
    for m in range(len(odometry.first)):
        motion_at[odometry.first[m]] = m
    longest = np.max(np.diff(tree.chain_start))
    scratch = np.zeros((6, 3, 3))
    out.calibration[:] = start.calibration
    out.tags[:] = start.tags
    for k in range(longest):
        for chain in range(n_chains):
            pose = tree.chain_start[chain] + k
            if pose >= tree.chain_start[chain + 1]:
                continue
            P = covariance[chain]
            if k == 0:
                out.poses[pose] = start.poses[pose]
                for i in range(3):
                    P[i, i] = start_variance[chain, i]
            else:
                _predict(odometry, motion_at[pose - 1], start, out.poses[pose - 1], out.poses[pose], P, scratch)
            for m in range(tree.reading_start[pose], tree.reading_start[pose + 1]):
                tag = readings.tag[m]
                _read(readings, m, start, out.poses[pose], P, out.tags[tag], tag_covariance[tag], known[tag], scratch)
                known[tag] = True


@jitted
def _predict(
    odometry: Odometry,
    m: int,
    values: Values,
    before: FloatArray,
    after: FloatArray,
    P: FloatArray,
    scratch: FloatArray,
) -> None:
    """T <- T o M(c); P <- Ad P Ad^T + L^-1, Ad that of M^-1, L its information."""
    motion = scratch[3, 0]
    for i in range(3):
        motion[i] = odometry.motion[m, i]
        for a in range(3):
            motion[i] += odometry.jacobian[m, i, a] * values.calibration[odometry.parameters[m, a]]
    cos, sin = np.cos(before[2]), np.sin(before[2])
    after[0] = before[0] + cos * motion[0] - sin * motion[1]
    after[1] = before[1] + sin * motion[0] + cos * motion[1]
    after[2] = before[2] + motion[2]
    after[2] -= 2.0 * np.pi * np.rint(after[2] / (2.0 * np.pi))
    adjoint, product, noise = scratch[0], scratch[1], scratch[2]
    cos, sin = np.cos(motion[2]), np.sin(motion[2])
    adjoint[0, 0], adjoint[0, 1], adjoint[0, 2] = cos, sin, sin * motion[0] - cos * motion[1]
    adjoint[1, 0], adjoint[1, 1], adjoint[1, 2] = -sin, cos, cos * motion[0] + sin * motion[1]
    adjoint[2, 0], adjoint[2, 1], adjoint[2, 2] = 0.0, 0.0, 1.0
    _times(adjoint, P, product)
    _inverse(odometry.information[m], noise)
    for i in range(3):
        for j in range(3):
            P[i, j] = noise[i, j]
            for k in range(3):
                P[i, j] += product[i, k] * adjoint[j, k]


@jitted
def _times(A: FloatArray, B: FloatArray, out: FloatArray) -> None:
    for i in range(3):
        for j in range(3):
            out[i, j] = A[i, 0] * B[0, j] + A[i, 1] * B[1, j] + A[i, 2] * B[2, j]


@jitted
def _inverse(A: FloatArray, out: FloatArray) -> None:
    for i in range(3):
        for j in range(3):
            a, b, c, d = (i + 1) % 3, (i + 2) % 3, (j + 1) % 3, (j + 2) % 3
            out[j, i] = A[a, c] * A[b, d] - A[a, d] * A[b, c]
    determinant = A[0, 0] * out[0, 0] + A[0, 1] * out[1, 0] + A[0, 2] * out[2, 0]
    for i in range(3):
        for j in range(3):
            out[i, j] /= determinant


@jitted
def _place_in_base(readings: Readings, m: int, values: Values, noise: FloatArray) -> tuple[float, float]:
    """Where a reading puts its tag in base, and its covariance there."""
    a, b = readings.value[m, 0], readings.value[m, 1]
    scale = 1.0 + values.calibration[readings.parameters[m, 3]]
    W = readings.whitening[m]
    determinant = W[0, 0] * W[1, 1] - W[0, 1] * W[1, 0]
    i00, i01, i10, i11 = W[1, 1] / determinant, -W[0, 1] / determinant, -W[1, 0] / determinant, W[0, 0] / determinant
    x, y = a, b
    if readings.polar[m]:
        c, s = np.cos(b), np.sin(b)
        x, y = a * c, a * s
        i00, i01, i10, i11 = c * i00 - y * i10, c * i01 - y * i11, s * i00 + x * i10, s * i01 + x * i11
    yaw = readings.mount[m, 2] + values.calibration[readings.parameters[m, 2]]
    c, s = scale * np.cos(yaw), scale * np.sin(yaw)
    i00, i01, i10, i11 = c * i00 - s * i10, c * i01 - s * i11, s * i00 + c * i10, s * i01 + c * i11
    noise[0, 0], noise[1, 1] = i00 * i00 + i01 * i01, i10 * i10 + i11 * i11
    noise[0, 1] = i00 * i10 + i01 * i11
    noise[1, 0] = noise[0, 1]
    mount_x = readings.mount[m, 0] + values.calibration[readings.parameters[m, 0]]
    mount_y = readings.mount[m, 1] + values.calibration[readings.parameters[m, 1]]
    return mount_x + c * x - s * y, mount_y + s * x + c * y


@jitted
def _read(
    readings: Readings,
    m: int,
    values: Values,
    pose: FloatArray,
    P: FloatArray,
    tag: FloatArray,
    V: FloatArray,
    is_known: bool,
    scratch: FloatArray,
) -> None:
    """Fuses one reading into pose and tag, or places the tag."""
    R, A, B, H = scratch[0], scratch[1], scratch[2], scratch[3]
    read_x, read_y = _place_in_base(readings, m, values, R)
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    x, y = read_x, read_y
    if is_known:
        dx, dy = tag[0] - pose[0], tag[1] - pose[1]
        x, y = cos * dx + sin * dy, cos * dy - sin * dx
    H[0, 0], H[0, 1], H[0, 2] = -1.0, 0.0, y
    H[1, 0], H[1, 1], H[1, 2] = 0.0, -1.0, -x
    _seen_from(H, P, A)
    if not is_known:
        tag[0], tag[1] = pose[0] + cos * x - sin * y, pose[1] + sin * x + cos * y
        _placed(A, R, cos, sin, V)
        return
    _turned(cos, -sin, V, B)
    own, others = A[0, 0] + A[1, 1], B[0, 0] + B[1, 1]
    if others > _CLEARLY * (own + R[0, 0] + R[1, 1]):
        tag[0], tag[1] = pose[0] + cos * read_x - sin * read_y, pose[1] + sin * read_x + cos * read_y
        _placed(A, R, cos, sin, V)
    elif own > _CLEARLY * others:
        off_x, off_y = read_x - x, read_y - y
        a, b, d = A[0, 0] + B[0, 0] + R[0, 0], A[0, 1] + B[0, 1] + R[0, 1], A[1, 1] + B[1, 1] + R[1, 1]
        if d * off_x * off_x - 2.0 * b * off_x * off_y + a * off_y * off_y > _GATE**2 * (a * d - b * b):
            return
        # The tag lies there, in the pose's own terms: H maps the step to the change of what is read.
        step = _corrected(H, P, a, b, d, off_x, off_y, scratch)
        pose[0] += cos * step[0] - sin * step[1]
        pose[1] += sin * step[0] + cos * step[1]
        pose[2] += step[2]


@jitted
def _seen_from(H: FloatArray, P: FloatArray, out: FloatArray) -> None:
    """(2, 2) H P H^T with H (2, 3), P symmetric."""
    for i in range(2):
        h0 = H[i, 0] * P[0, 0] + H[i, 1] * P[1, 0] + H[i, 2] * P[2, 0]
        h1 = H[i, 0] * P[0, 1] + H[i, 1] * P[1, 1] + H[i, 2] * P[2, 1]
        h2 = H[i, 0] * P[0, 2] + H[i, 1] * P[1, 2] + H[i, 2] * P[2, 2]
        out[i, 0] = h0 * H[0, 0] + h1 * H[0, 1] + h2 * H[0, 2]
        out[i, 1] = h0 * H[1, 0] + h1 * H[1, 1] + h2 * H[1, 2]


@jitted
def _turned(cos: float, sin: float, V: FloatArray, out: FloatArray) -> None:
    """(2, 2) R V R^T with R the turn, V symmetric."""
    a, b, d = V[0, 0], V[0, 1], V[1, 1]
    out[0, 0] = cos * cos * a - 2.0 * cos * sin * b + sin * sin * d
    out[0, 1] = cos * sin * (a - d) + (cos * cos - sin * sin) * b
    out[1, 0] = out[0, 1]
    out[1, 1] = sin * sin * a + 2.0 * cos * sin * b + cos * cos * d


@jitted
def _placed(A: FloatArray, R: FloatArray, cos: float, sin: float, V: FloatArray) -> None:
    """The covariance in map of a tag that a pose has placed."""
    for i in range(2):
        for j in range(2):
            A[i, j] += R[i, j]
    _turned(cos, sin, A, V)


@jitted
def _corrected(
    H: FloatArray, P: FloatArray, a: float, b: float, d: float, off_x: float, off_y: float, scratch: FloatArray
) -> tuple[float, float, float]:
    """Kalman's update of P (3, 3) with the innovation covariance [[a, b], [b, d]]; returns the step."""
    determinant = a * d - b * b
    coupled, gain = scratch[4], scratch[5]
    for i in range(3):
        for j in range(2):
            coupled[i, j] = P[i, 0] * H[j, 0] + P[i, 1] * H[j, 1] + P[i, 2] * H[j, 2]
        gain[i, 0] = (coupled[i, 0] * d - coupled[i, 1] * b) / determinant
        gain[i, 1] = (coupled[i, 1] * a - coupled[i, 0] * b) / determinant
    for i in range(3):
        for j in range(i, 3):
            P[i, j] -= gain[i, 0] * coupled[j, 0] + gain[i, 1] * coupled[j, 1]
            P[j, i] = P[i, j]
    return (
        gain[0, 0] * off_x + gain[0, 1] * off_y,
        gain[1, 0] * off_x + gain[1, 1] * off_y,
        gain[2, 0] * off_x + gain[2, 1] * off_y,
    )
