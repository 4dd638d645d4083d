"""Compiled linearisation of odometry; see `linearisation.kernels`.

With e = log(M(c)^-1 o T_i^-1 o T_j) and L its information: J_j = Jr^-1(e) and J_i = -J_j A with A the adjoint of
T_j^-1 o T_i, so that H_jj = J_j^T L J_j, H_ij = -A^T H_jj, H_ii = A^T H_jj A, g_j = J_j^T L e, g_i = -A^T g_j.
Small matrices are tuples in row order; symmetric ones contain the upper triangle only.
"""

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.foundation import FloatBlocks, borrow, inner, njit
from groundsbot.offline.sam.linearisation.blocks import NormalEquations
from groundsbot.offline.sam.linearisation.kernels import (
    Free,
    OdometryArrays,
    Values,
    half_angle_cotangent,
    series,
    wrap,
)
from groundsbot.offline.sam.linearisation.robust_losses import Loss, loss_and_weight

_Three = tuple[float, float, float]
_Four = tuple[float, float, float, float]
_Upper = tuple[float, float, float, float, float, float]
_Square = tuple[float, float, float, float, float, float, float, float, float]


@njit
def add_odometry(odometry: OdometryArrays, loss: Loss, values: Values, free: Free, system: NormalEquations) -> float:
    """Add all odometry factors to the blocks; return the sum of their losses."""
    odometry, values, free, system = borrow(odometry), borrow(values), borrow(free), borrow(system)
    C, columns = np.empty((3, odometry.jacobian.shape[2])), np.empty(odometry.jacobian.shape[2], np.int64)
    total, last, cos_j, sin_j = 0.0, -1, 1.0, 0.0
    for m in range(len(odometry.first)):
        i = odometry.first[m]
        cos_i, sin_i = cos_j, sin_j
        if i != last:
            cos_i, sin_i = np.cos(values.poses[i, 2]), np.sin(values.poses[i, 2])
        last = i + 1
        cos_j, sin_j = np.cos(values.poses[last, 2]), np.sin(values.poses[last, 2])
        cos, sin = cos_i * cos_j + sin_i * sin_j, cos_i * sin_j - sin_i * cos_j
        apart_x, apart_y = values.poses[last, 0] - values.poses[i, 0], values.poses[last, 1] - values.poses[i, 1]
        x, y = cos_i * apart_x + sin_i * apart_y, cos_i * apart_y - sin_i * apart_x
        t = wheel_correction(odometry, m, values.calibration)
        e, J = error_of(motion_at(odometry, m, t), x, y, values.poses[last, 2] - values.poses[i, 2])
        s = 1.0 / (1.0 + values.calibration[odometry.parameters[m, 0]])
        L = scaled_information(odometry.information[m], s)
        f = _times_vector(L, e)
        rho, w = loss_and_weight(loss, e[0] * f[0] + e[1] * f[1] + e[2] * f[2])
        total += rho
        L, f = (w * L[0], w * L[1], w * L[2], w * L[3], w * L[4], w * L[5]), (w * f[0], w * f[1], w * f[2])
        M = _transpose_times(J, L)
        H = _times_jacobian(M, J)
        A = (cos, sin, sin * x - cos * y, cos * x + sin * y)
        _add_blocks(system, i, H, A)
        _add_gradient(system.gradient, 3 * i, f, J, A)
        if _has_slots(odometry.slots[m]):
            error_by_wheels(odometry.jacobian[m], t, e, s, C)
            for k in range(len(columns)):
                columns[k] = free.calibration[odometry.parameters[m, k]]
            _add_wheels(i, odometry.slots[m], columns, C, M, L, A, f, system)
    return total


@njit
def information_of(whitening: FloatBlocks) -> FloatArray:
    """Return W^T W (M, 3, 3) of whitenings W (M, 3, 3)."""
    information = np.empty(whitening.shape)
    for m in range(len(whitening)):
        W, own = whitening[m], information[m]
        for i in range(3):
            for j in range(3):
                own[i, j] = W[0, i] * W[0, j] + W[1, i] * W[1, j] + W[2, i] * W[2, j]
    return information


@inner
def _has_slots(slots: IntArray) -> bool:
    found = False  # an array expression takes longer to compile
    for slot in slots:
        found = found or slot >= 0
    return found


@inner
def wheel_correction(odometry: OdometryArrays, m: int, calibration: FloatArray) -> _Three:
    """Return t = K c, the twist by which calibration c of wheels and gyro corrects a motion."""
    K, parameters = odometry.jacobian[m], odometry.parameters[m]
    x, y, theta = 0.0, 0.0, 0.0
    for k in range(len(parameters)):
        c = calibration[parameters[k]]
        if c != 0.0:
            x += K[0, k] * c
            y += K[1, k] * c
            theta += K[2, k] * c
    return x, y, theta


@inner
def motion_at(odometry: OdometryArrays, m: int, t: _Three) -> tuple[float, float, float, float, float]:
    """Return x, y and heading of motion o exp(t), and cosine and sine of the heading."""
    motion = odometry.motion[m]
    x, y, theta, cos, sin = motion[0], motion[1], motion[2], motion[3], motion[4]
    if t[0] == 0.0 and t[1] == 0.0 and t[2] == 0.0:
        return x, y, theta, cos, sin
    along, even, _ = series(t[2])
    across = t[2] * even
    step_x, step_y = along * t[0] - across * t[1], across * t[0] + along * t[1]
    x, y, theta = x + cos * step_x - sin * step_y, y + sin * step_x + cos * step_y, theta + t[2]
    return x, y, theta, np.cos(theta), np.sin(theta)


@inner
def error_of(motion: tuple[float, float, float, float, float], x: float, y: float, turn: float) -> tuple[_Three, _Four]:
    """Return e = log(motion^-1 o (x, y, turn)), and (a, b, p, q) of Jr^-1(e), rows (a, -b, p), (b, a, q), (0, 0, 1)."""
    dx, dy, omega = x - motion[0], y - motion[1], wrap(turn - motion[2])
    cos, sin = motion[3], motion[4]
    away_x, away_y = cos * dx + sin * dy, cos * dy - sin * dx
    half, cotangent = 0.5 * omega, half_angle_cotangent(omega)
    e = (cotangent * away_x + half * away_y, cotangent * away_y - half * away_x, omega)
    return e, _right_jacobian_inverse(e, cotangent)


@inner
def _right_jacobian_inverse(e: _Three, cotangent: float) -> _Four:
    half = 0.5 * e[2]
    _, even, odd = series(e[2])
    moved_x, moved_y = odd * e[0] - even * e[1], even * e[0] + odd * e[1]
    return cotangent, half, half * moved_y - cotangent * moved_x, -half * moved_x - cotangent * moved_y


@inner
def scaled_information(L: FloatArray, s: float) -> _Upper:
    """Return S L S with S = diag(s, s, 1) and s = 1 / (1 + wheel_scale)."""
    return s * s * L[0, 0], s * s * L[0, 1], s * L[0, 2], s * s * L[1, 1], s * L[1, 2], L[2, 2]


@inner
def _times_vector(L: _Upper, e: _Three) -> _Three:
    return (
        L[0] * e[0] + L[1] * e[1] + L[2] * e[2],
        L[1] * e[0] + L[3] * e[1] + L[4] * e[2],
        L[2] * e[0] + L[4] * e[1] + L[5] * e[2],
    )


@inner
def _transpose_times(J: _Four, L: _Upper) -> _Square:
    """Return J^T L."""
    a, b, p, q = J
    return (
        a * L[0] + b * L[1],
        a * L[1] + b * L[3],
        a * L[2] + b * L[4],
        a * L[1] - b * L[0],
        a * L[3] - b * L[1],
        a * L[4] - b * L[2],
        p * L[0] + q * L[1] + L[2],
        p * L[1] + q * L[3] + L[4],
        p * L[2] + q * L[4] + L[5],
    )


@inner
def _times_jacobian(M: _Square, J: _Four) -> _Upper:
    """Return M J, which is symmetric."""
    a, b, p, q = J
    return (
        M[0] * a + M[1] * b,
        M[1] * a - M[0] * b,
        M[0] * p + M[1] * q + M[2],
        M[4] * a - M[3] * b,
        M[3] * p + M[4] * q + M[5],
        M[6] * p + M[7] * q + M[8],
    )


@inner
def _add_blocks(system: NormalEquations, i: int, H: _Upper, A: _Four) -> None:
    """Add H to pose j = i + 1 and A^T H A to pose i, and set the block of both to -A^T H.

    A has the rows (cos, sin, u), (-sin, cos, v), (0, 0, 1).
    """
    cos, sin, u, v = A
    b00, b01, b02 = H[0] * cos - H[1] * sin, H[0] * sin + H[1] * cos, H[0] * u + H[1] * v + H[2]
    b10, b11, b12 = H[1] * cos - H[3] * sin, H[1] * sin + H[3] * cos, H[1] * u + H[3] * v + H[4]
    b20, b21, b22 = H[2] * cos - H[4] * sin, H[2] * sin + H[4] * cos, H[2] * u + H[4] * v + H[5]
    N = system.pose_next[i]
    N[0, 0], N[0, 1], N[0, 2] = -b00, -b10, -b20
    N[1, 0], N[1, 1], N[1, 2] = -b01, -b11, -b21
    N[2, 0], N[2, 1], N[2, 2] = -b02, -b12, -b22
    before = (
        cos * b00 - sin * b10,
        cos * b01 - sin * b11,
        cos * b02 - sin * b12,
        sin * b01 + cos * b11,
        sin * b02 + cos * b12,
        u * b02 + v * b12 + b22,
    )
    add_symmetric(system.pose[i], before)
    add_symmetric(system.pose[i + 1], H)


@inner
def add_symmetric(block: FloatArray, upper: _Upper) -> None:
    """Add the symmetric matrix with this upper triangle to a block (3, 3)."""
    block[0, 0] += upper[0]
    block[0, 1] += upper[1]
    block[0, 2] += upper[2]
    block[1, 0] += upper[1]
    block[1, 1] += upper[3]
    block[1, 2] += upper[4]
    block[2, 0] += upper[2]
    block[2, 1] += upper[4]
    block[2, 2] += upper[5]


@inner
def _add_gradient(gradient: FloatArray, at: int, f: _Three, J: _Four, A: _Four) -> None:
    """Add J^T f to pose j, and -A^T J^T f to pose i, whose three entries begin at `at`."""
    a, b, p, q = J
    cos, sin, u, v = A
    g0, g1, g2 = a * f[0] + b * f[1], a * f[1] - b * f[0], p * f[0] + q * f[1] + f[2]
    gradient[at] -= cos * g0 - sin * g1
    gradient[at + 1] -= sin * g0 + cos * g1
    gradient[at + 2] -= u * g0 + v * g1 + g2
    gradient[at + 3] += g0
    gradient[at + 4] += g1
    gradient[at + 5] += g2


@inner
def error_by_wheels(K: FloatArray, t: _Three, e: _Three, s: float, C: FloatArray) -> None:
    """Set C (3, P) to S^-1 d(S e)/dc; log(exp(-(t + dt)) o G) with t = K c is a left perturbation."""
    along, even, odd = series(t[2])
    across = t[2] * even
    p, q = odd * t[0] - even * t[1], even * t[0] + odd * t[1]
    a, b, g, h = _right_jacobian_inverse((-e[0], -e[1], -e[2]), half_angle_cotangent(e[2]))
    for j in range(K.shape[1]):
        k0, k1, k2 = K[0, j], K[1, j], K[2, j]
        x, y = along * k0 + across * k1 + p * k2, along * k1 - across * k0 + q * k2
        C[0, j], C[1, j], C[2, j] = -(a * x - b * y + g * k2), -(b * x + a * y + h * k2), -k2
    C[0, 0] -= e[0] * s
    C[1, 0] -= e[1] * s


@inner
def _add_wheels(
    first: int,
    slots: IntArray,
    columns: IntArray,
    C: FloatArray,
    M: _Square,
    L: _Upper,
    A: _Four,
    f: _Three,
    system: NormalEquations,
) -> None:
    """Add H_jc = M C, H_ic = -A^T M C, H_cc = C^T L C and g_c = C^T f for the free parameters of wheels and gyro."""
    cos, sin, u, v = A
    before, after = system.pose_calibration[first], system.pose_calibration[first + 1]
    own = system.gradient[len(system.gradient) - len(system.calibration) :]
    for k in range(len(slots)):
        slot = slots[k]
        if slot < 0:
            continue
        c0, c1, c2 = C[0, k], C[1, k], C[2, k]
        v0 = M[0] * c0 + M[1] * c1 + M[2] * c2
        v1 = M[3] * c0 + M[4] * c1 + M[5] * c2
        v2 = M[6] * c0 + M[7] * c1 + M[8] * c2
        after[0, slot] += v0
        after[1, slot] += v1
        after[2, slot] += v2
        before[0, slot] -= cos * v0 - sin * v1
        before[1, slot] -= sin * v0 + cos * v1
        before[2, slot] -= u * v0 + v * v1 + v2
        u0, u1, u2 = _times_vector(L, (c0, c1, c2))
        row = system.calibration[columns[k]]  # symmetric
        for other in range(len(columns)):
            if columns[other] >= 0:
                row[columns[other]] += C[0, other] * u0 + C[1, other] * u1 + C[2, other] * u2
        own[columns[k]] += c0 * f[0] + c1 * f[1] + c2 * f[2]
