"""Compiled linearisation: the residuals and Jacobians of `factors`, straight into the blocks of the arrowhead system.

What `factors` writes as arrays over all factors is here a loop with the same names; the tests hold both to each other.
"""

from typing import NamedTuple

import numpy as np

from calib.arrays import BoolArray, FloatArray, IntArray
from offline.arrowhead_kernels import System
from offline.jit import jitted
from offline.robust import Loss, loss_and_weight


class Values(NamedTuple):
    """Of all variables, as in `factors.State`, and what is free of them (1.0, or 0.0 where held)."""

    poses: FloatArray
    tags: FloatArray
    calibration: FloatArray


class Free(NamedTuple):
    """1.0 where a tangent direction is free, 0.0 where it is held.

    Attributes:
        poses: (P, 3); tags: (T, 2).
        calibration: (C,) index among what is free, -1 where held.
    """

    poses: FloatArray
    tags: FloatArray
    calibration: IntArray


class Odometry(NamedTuple):
    """`factors.OdometryFactors`, and the slot (M, 3) of each parameter in its chain's calibration, -1 where held."""

    first: IntArray
    motion: FloatArray
    information: FloatArray
    jacobian: FloatArray
    parameters: IntArray
    slots: IntArray


class Readings(NamedTuple):
    """`factors.ReadingFactors` by rising pose; parameters (M, 4) are those of the mount and the tag scale."""

    pose: IntArray
    tag: IntArray
    value: FloatArray
    polar: BoolArray
    whitening: FloatArray
    mount: FloatArray
    parameters: IntArray
    slots: IntArray


@jitted
def clear(system: System) -> None:
    """All zero, but for what is overwritten anyway."""
    for blocks in (system.pose, system.pose_next, system.pose_calibration, system.tag, system.tag_calibration):
        blocks[:] = 0.0
    system.calibration[:] = 0.0
    system.gradient[:] = 0.0


@jitted
def hold(reading_pose: IntArray, reading_tag: IntArray, free: Free, system: System) -> None:
    """What is held gets a one on the diagonal and nothing else: its step is zero."""
    n_poses = len(free.poses)
    for pose in range(n_poses):
        for i in range(3):
            if free.poses[pose, i] == 0.0:
                _hold_one(system.pose[pose], i)
                system.pose_next[pose, i, :] = 0.0
                system.pose_next[max(pose - 1, 0), :, i] *= 1.0 if pose == 0 else 0.0
                system.pose_calibration[pose, i, :] = 0.0
                system.gradient[3 * pose + i] = 0.0
    for tag in range(len(free.tags)):
        for i in range(2):
            if free.tags[tag, i] == 0.0:
                _hold_one(system.tag[tag], i)
                system.tag_calibration[tag, i, :] = 0.0
                system.gradient[3 * n_poses + 2 * tag + i] = 0.0
    for m in range(len(reading_pose)):
        pose, tag = free.poses[reading_pose[m]], free.tags[reading_tag[m]]
        for i in range(3):
            system.pose_tag[m, i, 0] *= pose[i] * tag[0]
            system.pose_tag[m, i, 1] *= pose[i] * tag[1]


@jitted
def _hold_one(block: FloatArray, i: int) -> None:
    block[i, :] = 0.0
    block[:, i] = 0.0
    block[i, i] = 1.0


@jitted
def add_odometry(odometry: Odometry, loss: Loss, values: Values, free: Free, system: System) -> float:
    """Adds all odometry factors to the blocks; returns the sum of their losses.

    With e = log(M(c)^-1 o T_i^-1 o T_j) and L its information: J_j = Jr^-1(e) and J_i = -J_j A with A the adjoint of
    T_j^-1 o T_i, so that H_jj = J_j^T L J_j, H_ij = -A^T H_jj, H_ii = A^T H_jj A, g_j = J_j^T L e, g_i = -A^T g_j.
    """
    scratch = np.empty((6, 3, 3))
    total = 0.0
    for m in range(len(odometry.first)):
        first = odometry.first[m]
        K = odometry.jacobian[m]
        c0, c1, c2 = (
            values.calibration[odometry.parameters[m, 0]],
            values.calibration[odometry.parameters[m, 1]],
            values.calibration[odometry.parameters[m, 2]],
        )
        t0, t1, t2 = 0.0, 0.0, 0.0
        if c0 != 0.0 or c1 != 0.0 or c2 != 0.0:
            t0 = K[0, 0] * c0 + K[0, 1] * c1 + K[0, 2] * c2
            t1 = K[1, 0] * c0 + K[1, 1] * c1 + K[1, 2] * c2
            t2 = K[2, 0] * c0 + K[2, 1] * c1 + K[2, 2] * c2
        moved = _between(values.poses[first], values.poses[first + 1])
        e0, e1, e2 = _error(odometry.motion[m], t0, t1, t2, moved)
        # S L S: lengths are divided by 1 + wheel_scale.
        s, L = 1.0 / (1.0 + c0), odometry.information[m]
        l00, l01, l11 = s * s * L[0, 0], s * s * L[0, 1], s * s * L[1, 1]
        l02, l12, l22 = s * L[0, 2], s * L[1, 2], L[2, 2]
        f0, f1, f2 = l00 * e0 + l01 * e1 + l02 * e2, l01 * e0 + l11 * e1 + l12 * e2, l02 * e0 + l12 * e1 + l22 * e2
        rho, w = loss_and_weight(loss, e0 * f0 + e1 * f1 + e2 * f2)
        total += rho
        a, b, p, q = _right_jacobian_inverse(e0, e1, e2)  # rows (a, -b, p), (b, a, q), (0, 0, 1)
        m00, m01, m02 = w * (a * l00 + b * l01), w * (a * l01 + b * l11), w * (a * l02 + b * l12)
        m10, m11, m12 = w * (a * l01 - b * l00), w * (a * l11 - b * l01), w * (a * l12 - b * l02)
        m20 = w * (p * l00 + q * l01 + l02)
        m21 = w * (p * l01 + q * l11 + l12)
        m22 = w * (p * l02 + q * l12 + l22)
        h00, h01, h02 = m00 * a + m01 * b, m01 * a - m00 * b, m00 * p + m01 * q + m02
        h11, h12, h22 = m11 * a - m10 * b, m10 * p + m11 * q + m12, m20 * p + m21 * q + m22
        cos, sin = np.cos(moved[2]), np.sin(moved[2])
        x, y = -cos * moved[0] - sin * moved[1], sin * moved[0] - cos * moved[1]
        # B = H_jj A, rows of A (cos, sin, y), (-sin, cos, -x), (0, 0, 1)
        b00, b01, b02 = h00 * cos - h01 * sin, h00 * sin + h01 * cos, h00 * y - h01 * x + h02
        b10, b11, b12 = h01 * cos - h11 * sin, h01 * sin + h11 * cos, h01 * y - h11 * x + h12
        b20, b21, b22 = h02 * cos - h12 * sin, h02 * sin + h12 * cos, h02 * y - h12 * x + h22
        H, N = system.pose[first], system.pose_next[first]
        a01, a02, a12 = cos * b01 - sin * b11, cos * b02 - sin * b12, sin * b02 + cos * b12
        H[0, 0] += cos * b00 - sin * b10
        H[0, 1] += a01
        H[0, 2] += a02
        H[1, 0] += a01
        H[1, 1] += sin * b01 + cos * b11
        H[1, 2] += a12
        H[2, 0] += a02
        H[2, 1] += a12
        H[2, 2] += y * b02 - x * b12 + b22
        N[0, 0], N[0, 1], N[0, 2] = -b00, -b10, -b20
        N[1, 0], N[1, 1], N[1, 2] = -b01, -b11, -b21
        N[2, 0], N[2, 1], N[2, 2] = -b02, -b12, -b22
        H = system.pose[first + 1]
        H[0, 0] += h00
        H[0, 1] += h01
        H[0, 2] += h02
        H[1, 0] += h01
        H[1, 1] += h11
        H[1, 2] += h12
        H[2, 0] += h02
        H[2, 1] += h12
        H[2, 2] += h22
        g0, g1, g2 = w * (a * f0 + b * f1), w * (a * f1 - b * f0), w * (p * f0 + q * f1 + f2)
        g = system.gradient
        g[3 * first + 3] += g0
        g[3 * first + 4] += g1
        g[3 * first + 5] += g2
        g[3 * first] -= cos * g0 - sin * g1
        g[3 * first + 1] -= sin * g0 + cos * g1
        g[3 * first + 2] -= y * g0 - x * g1 + g2
        if odometry.slots[m, 0] >= 0 or odometry.slots[m, 1] >= 0 or odometry.slots[m, 2] >= 0:
            M, L, A, f = scratch[0], scratch[1], scratch[2], scratch[3, 0]
            M[0, 0], M[0, 1], M[0, 2] = m00, m01, m02
            M[1, 0], M[1, 1], M[1, 2] = m10, m11, m12
            M[2, 0], M[2, 1], M[2, 2] = m20, m21, m22
            L[0, 0], L[0, 1], L[0, 2], L[1, 1], L[1, 2], L[2, 2] = w * l00, w * l01, w * l02, w * l11, w * l12, w * l22
            L[1, 0], L[2, 0], L[2, 1] = L[0, 1], L[0, 2], L[1, 2]
            A[0, 0], A[0, 1], A[0, 2] = cos, sin, y
            A[1, 0], A[1, 1], A[1, 2] = -sin, cos, -x
            A[2, 0], A[2, 1], A[2, 2] = 0.0, 0.0, 1.0
            f[0], f[1], f[2] = w * f0, w * f1, w * f2
            _by_wheels(K, t0, t1, t2, e0, e1, e2, s, scratch[4], scratch[5])
            _add_wheels(odometry, m, free, scratch, system)
    return total


@jitted
def _by_wheels(
    K: FloatArray,
    t0: float,
    t1: float,
    t2: float,
    e0: float,
    e1: float,
    e2: float,
    s: float,
    C: FloatArray,
    product: FloatArray,
) -> None:
    """C <- S^-1 d(S e)/dc: log(exp(-(t + dt)) o G) with t = K c, the change enters on the left."""
    along, even, odd = _series(t2)
    across = t2 * even
    p, q = odd * t0 - even * t1, even * t0 + odd * t1
    for j in range(3):
        product[0, j] = along * K[0, j] + across * K[1, j] + p * K[2, j]
        product[1, j] = along * K[1, j] - across * K[0, j] + q * K[2, j]
        product[2, j] = K[2, j]
    a, b, p, q = _right_jacobian_inverse(-e0, -e1, -e2)
    for j in range(3):
        C[0, j] = -(a * product[0, j] - b * product[1, j] + p * product[2, j])
        C[1, j] = -(b * product[0, j] + a * product[1, j] + q * product[2, j])
        C[2, j] = -product[2, j]
    C[0, 0] -= e0 * s
    C[1, 0] -= e1 * s


@jitted
def _add_wheels(odometry: Odometry, m: int, free: Free, scratch: FloatArray, system: System) -> None:
    """H_jc = M C, H_ic = -A^T M C, H_cc = C^T L C, g_c = C^T f, for what is free of the wheel parameters."""
    M, L, A, f, C = scratch[0], scratch[1], scratch[2], scratch[3, 0], scratch[4]
    first, base = odometry.first[m], len(system.gradient) - len(system.calibration)
    for k in range(3):
        slot, column = odometry.slots[m, k], free.calibration[odometry.parameters[m, k]]
        if slot < 0:
            continue
        v0 = M[0, 0] * C[0, k] + M[0, 1] * C[1, k] + M[0, 2] * C[2, k]
        v1 = M[1, 0] * C[0, k] + M[1, 1] * C[1, k] + M[1, 2] * C[2, k]
        v2 = M[2, 0] * C[0, k] + M[2, 1] * C[1, k] + M[2, 2] * C[2, k]
        system.pose_calibration[first + 1, 0, slot] += v0
        system.pose_calibration[first + 1, 1, slot] += v1
        system.pose_calibration[first + 1, 2, slot] += v2
        for i in range(3):
            system.pose_calibration[first, i, slot] -= A[0, i] * v0 + A[1, i] * v1 + A[2, i] * v2
        u0 = L[0, 0] * C[0, k] + L[0, 1] * C[1, k] + L[0, 2] * C[2, k]
        u1 = L[1, 0] * C[0, k] + L[1, 1] * C[1, k] + L[1, 2] * C[2, k]
        u2 = L[2, 0] * C[0, k] + L[2, 1] * C[1, k] + L[2, 2] * C[2, k]
        for other in range(3):
            row = free.calibration[odometry.parameters[m, other]]
            if row >= 0:
                system.calibration[row, column] += C[0, other] * u0 + C[1, other] * u1 + C[2, other] * u2
        system.gradient[base + column] += C[0, k] * f[0] + C[1, k] * f[1] + C[2, k] * f[2]


@jitted
def _wrapped(angle: float) -> float:
    """In [-pi, pi]."""
    return float(angle - 2.0 * np.pi * np.rint(angle / (2.0 * np.pi)))


@jitted
def _between(first: FloatArray, second: FloatArray) -> tuple[float, float, float]:
    cos, sin = np.cos(first[2]), np.sin(first[2])
    x, y = second[0] - first[0], second[1] - first[1]
    return cos * x + sin * y, cos * y - sin * x, _wrapped(second[2] - first[2])


@jitted
def _error(
    motion: FloatArray, t0: float, t1: float, t2: float, moved: tuple[float, float, float]
) -> tuple[float, float, float]:
    """log((motion o exp(t))^-1 o moved)."""
    x, y, theta = motion[0], motion[1], motion[2]
    if t0 != 0.0 or t1 != 0.0 or t2 != 0.0:
        along, even, _ = _series(t2)
        across = t2 * even
        step_x, step_y = along * t0 - across * t1, across * t0 + along * t1
        cos, sin = np.cos(theta), np.sin(theta)
        x, y, theta = x + cos * step_x - sin * step_y, y + sin * step_x + cos * step_y, theta + t2
    cos, sin = np.cos(theta), np.sin(theta)
    dx, dy, omega = moved[0] - x, moved[1] - y, _wrapped(moved[2] - theta)
    ex, ey = cos * dx + sin * dy, cos * dy - sin * dx
    half, cotangent = 0.5 * omega, _half_angle_cotangent(omega)
    return cotangent * ex + half * ey, cotangent * ey - half * ex, omega


@jitted
def _half_angle_cotangent(omega: float) -> float:
    """(w/2) cot(w/2)."""
    if abs(omega) < 0.2:
        s = omega * omega
        return 1.0 - s / 12.0 * (1.0 + s / 60.0 * (1.0 + s / 42.0 * (1.0 + s / 40.0 * (1.0 + s * 5.0 / 198.0))))
    return float(0.5 * omega * np.cos(0.5 * omega) / np.sin(0.5 * omega))


@jitted
def _series(omega: float) -> tuple[float, float, float]:
    """sin(w)/w, (1 - cos w)/w^2, (w - sin w)/w^2."""
    s = omega * omega
    if abs(omega) < 0.5:
        sine = 1.0 - s / 6 * (1.0 - s / 20 * (1.0 - s / 42 * (1.0 - s / 72 * (1.0 - s / 110 * (1.0 - s / 156)))))
        even = 0.5 - s / 24 * (1.0 - s / 30 * (1.0 - s / 56 * (1.0 - s / 90 * (1.0 - s / 132 * (1.0 - s / 182)))))
        odd = omega / 6 * (1.0 - s / 20 * (1.0 - s / 42 * (1.0 - s / 72 * (1.0 - s / 110 * (1.0 - s / 156)))))
        return sine, even, odd
    return np.sin(omega) / omega, (1.0 - np.cos(omega)) / s, (omega - np.sin(omega)) / s


@jitted
def _right_jacobian_inverse(x: float, y: float, omega: float) -> tuple[float, float, float, float]:
    """(a, b, p, q) of the matrix with rows (a, -b, p), (b, a, q), (0, 0, 1)."""
    half, cotangent = 0.5 * omega, _half_angle_cotangent(omega)
    _, even, odd = _series(omega)
    moved_x, moved_y = odd * x - even * y, even * x + odd * y
    return cotangent, half, half * moved_y - cotangent * moved_x, -half * moved_x - cotangent * moved_y


@jitted
def moved(values: Values, step: FloatArray, anchor: IntArray, out: Values) -> None:
    """`solver.Problem.moved` with a step in the arrowhead's order; calibration apart."""
    n_poses = len(values.poses)
    for pose in range(n_poses):
        d0, d1, omega = step[3 * pose], step[3 * pose + 1], step[3 * pose + 2]
        along, even, _ = _series(omega)
        across = omega * even
        x, y = along * d0 - across * d1, across * d0 + along * d1
        cos, sin = np.cos(values.poses[pose, 2]), np.sin(values.poses[pose, 2])
        out.poses[pose, 0] = values.poses[pose, 0] + cos * x - sin * y
        out.poses[pose, 1] = values.poses[pose, 1] + sin * x + cos * y
        out.poses[pose, 2] = _wrapped(values.poses[pose, 2] + omega)
    for tag in range(len(values.tags)):
        pose, column = anchor[tag], 3 * n_poses + 2 * tag
        before, after = values.poses[pose], out.poses[pose]
        cos, sin = np.cos(before[2]), np.sin(before[2])
        dx, dy = values.tags[tag, 0] - before[0], values.tags[tag, 1] - before[1]
        x, y = cos * dx + sin * dy, cos * dy - sin * dx
        own_x = cos * step[column] + sin * step[column + 1] - (step[3 * pose] - step[3 * pose + 2] * y)
        own_y = cos * step[column + 1] - sin * step[column] - (step[3 * pose + 1] + step[3 * pose + 2] * x)
        x, y = x + own_x, y + own_y
        cos, sin = np.cos(after[2]), np.sin(after[2])
        out.tags[tag, 0] = after[0] + cos * x - sin * y
        out.tags[tag, 1] = after[1] + sin * x + cos * y


@jitted
def diagonal_square(system: System, step: FloatArray) -> float:
    """step^T diag(H) step."""
    total = 0.0
    n_poses, n_tags = len(system.pose), len(system.tag)
    for pose in range(n_poses):
        for i in range(3):
            total += system.pose[pose, i, i] * step[3 * pose + i] ** 2
    for tag in range(n_tags):
        for i in range(2):
            total += system.tag[tag, i, i] * step[3 * n_poses + 2 * tag + i] ** 2
    for a in range(len(system.calibration)):
        total += system.calibration[a, a] * step[3 * n_poses + 2 * n_tags + a] ** 2
    return total
