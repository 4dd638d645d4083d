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
    whitening: FloatArray
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
def clear(system: System, free: Free) -> None:
    """All zero, ones on the diagonal where something is held."""
    for array in (system.pose, system.pose_next, system.pose_calibration, system.pose_tag):
        array[:] = 0.0
    for array in (system.tag, system.tag_calibration):
        array[:] = 0.0
    system.calibration[:] = 0.0
    system.gradient[:] = 0.0
    for pose in range(len(free.poses)):
        for i in range(3):
            system.pose[pose, i, i] = 1.0 - free.poses[pose, i]
    for tag in range(len(free.tags)):
        for i in range(2):
            system.tag[tag, i, i] = 1.0 - free.tags[tag, i]


@jitted
def add_odometry(odometry: Odometry, loss: Loss, values: Values, free: Free, system: System) -> float:
    """Adds all odometry factors to the blocks; returns the sum of their losses."""
    # Whitened residual, and derivatives by both poses and the wheel parameters, side by side.
    r, J = np.empty(3), np.empty((3, 9))
    scratch = np.empty((5, 3, 3))
    total = 0.0
    for m in range(len(odometry.first)):
        first = odometry.first[m]
        _odometry_factor(odometry, m, values, free, r, J, scratch)
        rho, weight = loss_and_weight(loss, r[0] * r[0] + r[1] * r[1] + r[2] * r[2])
        total += rho
        for i in range(3):
            for j in range(i, 3):
                h_first = weight * _dot3(J, i, J, j)
                h_second = weight * _dot3(J, 3 + i, J, 3 + j)
                system.pose[first, i, j] += h_first
                system.pose[first + 1, i, j] += h_second
                if i != j:
                    system.pose[first, j, i] += h_first
                    system.pose[first + 1, j, i] += h_second
            for j in range(3):
                system.pose_next[first, i, j] += weight * _dot3(J, i, J, 3 + j)
            system.gradient[3 * first + i] += weight * (J[0, i] * r[0] + J[1, i] * r[1] + J[2, i] * r[2])
            system.gradient[3 * first + 3 + i] += weight * (
                J[0, 3 + i] * r[0] + J[1, 3 + i] * r[1] + J[2, 3 + i] * r[2]
            )
        if system.pose_calibration.shape[2]:
            _add_wheels(odometry, m, weight, free, r, J, system)
    return total


@jitted
def _dot3(A: FloatArray, i: int, B: FloatArray, j: int) -> float:
    """Column i of A times column j of B."""
    return A[0, i] * B[0, j] + A[1, i] * B[1, j] + A[2, i] * B[2, j]


@jitted
def _add_wheels(
    odometry: Odometry, m: int, weight: float, free: Free, r: FloatArray, J: FloatArray, system: System
) -> None:
    first, base = odometry.first[m], len(system.gradient) - len(system.calibration)
    for a in range(3):
        slot, column = odometry.slots[m, a], free.calibration[odometry.parameters[m, a]]
        if slot < 0:
            continue
        for i in range(3):
            system.pose_calibration[first, i, slot] += weight * _dot3(J, i, J, 6 + a)
            system.pose_calibration[first + 1, i, slot] += weight * _dot3(J, 3 + i, J, 6 + a)
        for b in range(3):
            other = free.calibration[odometry.parameters[m, b]]
            if other >= 0:
                system.calibration[column, other] += weight * _dot3(J, 6 + a, J, 6 + b)
        system.gradient[base + column] += weight * (J[0, 6 + a] * r[0] + J[1, 6 + a] * r[1] + J[2, 6 + a] * r[2])


@jitted
def _odometry_factor(
    odometry: Odometry, m: int, values: Values, free: Free, r: FloatArray, J: FloatArray, scratch: FloatArray
) -> None:
    """r = W S(c) log(M(c)^-1 o T_i^-1 o T_j) and its derivatives; see `factors.OdometryFactors`."""
    first = odometry.first[m]
    outer, jr, by_second, adjoint, by_twist = scratch[0], scratch[1], scratch[2], scratch[3], scratch[4]
    c0, c1, c2 = (
        values.calibration[odometry.parameters[m, 0]],
        values.calibration[odometry.parameters[m, 1]],
        values.calibration[odometry.parameters[m, 2]],
    )
    K, W = odometry.jacobian[m], odometry.whitening[m]
    scale = 1.0 + c0
    for i in range(3):
        outer[i, 0], outer[i, 1], outer[i, 2] = W[i, 0] / scale, W[i, 1] / scale, W[i, 2]
    moved = _between(values.poses[first], values.poses[first + 1])
    t0 = K[0, 0] * c0 + K[0, 1] * c1 + K[0, 2] * c2
    t1 = K[1, 0] * c0 + K[1, 1] * c1 + K[1, 2] * c2
    t2 = K[2, 0] * c0 + K[2, 1] * c1 + K[2, 2] * c2
    error = _error(odometry.motion[m], t0, t1, t2, moved)
    for i in range(3):
        r[i] = outer[i, 0] * error[0] + outer[i, 1] * error[1] + outer[i, 2] * error[2]
    _right_jacobian_inverse(error[0], error[1], error[2], jr)
    _product(outer, jr, by_second, 1.0)
    # Adjoint of moved^-1.
    cos, sin = np.cos(moved[2]), np.sin(moved[2])
    x, y = -cos * moved[0] - sin * moved[1], sin * moved[0] - cos * moved[1]
    adjoint[0, 0], adjoint[0, 1], adjoint[0, 2] = cos, sin, y
    adjoint[1, 0], adjoint[1, 1], adjoint[1, 2] = -sin, cos, -x
    adjoint[2, 0], adjoint[2, 1], adjoint[2, 2] = 0.0, 0.0, 1.0
    _product(by_second, adjoint, J[:, 0:3], -1.0)
    J[:, 3:6] = by_second
    for i in range(3):
        for j in range(3):
            J[i, j] *= free.poses[first, j]
            J[i, 3 + j] *= free.poses[first + 1, j]
    if odometry.slots[m, 0] < 0 and odometry.slots[m, 1] < 0 and odometry.slots[m, 2] < 0:
        return
    # log(exp(-(t + dt)) o G) with t = K c: the change enters on the left.
    _right_jacobian_inverse(-error[0], -error[1], -error[2], jr)
    _product(outer, jr, by_twist, -1.0)
    _right_jacobian(t0, t1, t2, jr)
    _product(by_twist, jr, adjoint, 1.0)
    _product(adjoint, K, J[:, 6:9], 1.0)
    for i in range(3):
        J[i, 6] -= (outer[i, 0] * error[0] + outer[i, 1] * error[1]) / scale


@jitted
def _product(A: FloatArray, B: FloatArray, out: FloatArray, sign: float) -> None:
    for i in range(3):
        for j in range(3):
            out[i, j] = sign * (A[i, 0] * B[0, j] + A[i, 1] * B[1, j] + A[i, 2] * B[2, j])


@jitted
def _wrapped(angle: float) -> float:
    """In [-pi, pi]."""
    return angle - 2.0 * np.pi * np.rint(angle / (2.0 * np.pi))


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
    return 0.5 * omega * np.cos(0.5 * omega) / np.sin(0.5 * omega)


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
def _right_jacobian(x: float, y: float, omega: float, out: FloatArray) -> None:
    along, even, odd = _series(omega)
    across = omega * even
    out[0, 0], out[0, 1], out[0, 2] = along, across, odd * x - even * y
    out[1, 0], out[1, 1], out[1, 2] = -across, along, even * x + odd * y
    out[2, 0], out[2, 1], out[2, 2] = 0.0, 0.0, 1.0


@jitted
def _right_jacobian_inverse(x: float, y: float, omega: float, out: FloatArray) -> None:
    half, cotangent = 0.5 * omega, _half_angle_cotangent(omega)
    _, even, odd = _series(omega)
    moved_x, moved_y = odd * x - even * y, even * x + odd * y
    out[0, 0], out[0, 1], out[0, 2] = cotangent, -half, half * moved_y - cotangent * moved_x
    out[1, 0], out[1, 1], out[1, 2] = half, cotangent, -half * moved_x - cotangent * moved_y
    out[2, 0], out[2, 1], out[2, 2] = 0.0, 0.0, 1.0


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
