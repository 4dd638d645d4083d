"""Compiled residuals, Jacobians and normal equations of motions, readings and ties of the model (`factors`).

Variables change as in wheel units: a change of a drive's ln distance also stretches its poses and own places about the
origin of the map, x <- exp(change of ln distance) (x + change of x). That of the first drive, the stretch, does so to
the whole map and all drives. Motions do not depend on either, and the scale of the map is one variable instead of a
direction in all of them.

A residual is whitened: its scale is one. Each kind of factor has a Student-t distribution with `nu` degrees of freedom,
whose weight (nu + d) / (nu + Q) multiplies its normal equations, where Q is the sum of the squares of its d whitened
components (Lange, Little and Taylor 1989, "Robust statistical modeling using the t distribution").
"""

from typing import Final, NamedTuple

import numpy as np

from groundsbot.calib.foundation import FloatArray
from groundsbot.offline.foundation import (
    FloatBlocks,
    FloatMatrix,
    FloatVector,
    IntMatrix,
    IntVector,
    borrow,
    inner,
    njit,
)
from groundsbot.offline.sam import FrontalSystem, Kind, Nodes, Unsigned, add_matrix, add_vector

LEAST_RANGE_M: Final = 0.05  # the bearing of a place is undefined at the sensor itself
LEAST_COSINE: Final = 0.2  # of the bearing, in the depth exponent: no camera looks wider
# The parameters of a reading, in the order of `ReadingArrays.parameters`.
READING_PARAMETERS: Final = (
    "mount_x_m", "mount_y_m", "mount_yaw_rad", "time_offset_s", "range_offset_m", "range_scale", "depth_exponent",
    "tag_scale", "mount_roll_rad", "mount_pitch_rad", "edge_shift_px", "distance", "stretch",
)  # fmt: skip
N_READING: Final = 3 + 2 + 13
_DISTANCE: Final = N_READING - 2
N_LINEAR: Final = 3
_LINEAR_FROM: Final = 8
_STEP: Final = 1e-5  # of finite differences of the information, in m, rad or units of a parameter


class Variables(NamedTuple):
    """The values of all variables: poses (P, 3) in map, points (Q, 2) in map, and calibration (C,)."""

    poses: FloatMatrix
    points: FloatMatrix
    calibration: FloatVector


class MotionArrays(NamedTuple):
    """M motions by the wheels from a pose to the next one.

    In axes halfway through the turn, in units of the wheels: (q + dq c', phi + dphi c'), where c' are the parameters
    from the second one on. The first parameter is ln(true distance / wheel distance).

    Attributes:
        first: (M,) pose; the other is the next one.
        along: (M, 2) q in m.
        turn: (M,) phi in rad.
        by_along: (M, 2, W - 1) dq.
        by_turn: (M, W - 1) dphi.
        parameters: (M, W) calibration.
        sigma: (M, 3) scale of distance, lateral motion (m of the wheels) and turn (rad).
    """

    first: IntVector
    along: FloatMatrix
    turn: FloatVector
    by_along: FloatBlocks
    by_turn: FloatMatrix
    parameters: IntMatrix
    sigma: FloatMatrix


class ReadingArrays(NamedTuple):
    """M readings of a point from a pose, as (range, bearing) or (x, y) in the axes of a sensor.

    Attributes:
        pose, point: (M,) variables.
        value: (M, 2) in m and rad, or in m.
        polar: (M,) whether value is (range, bearing).
        whitening: (M, 2, 2) lower triangular W with W^T W the inverse of the scale matrix.
        mount: (M, 3) nominal pose of the sensor in base.
        velocity: (M, 3) of base: m/s forward and to the left, rad/s.
        applied_s: (M,) delay by which the pose is earlier than the stamp.
        linear: (M, 2, 3) derivative of the value by roll, pitch and edge shift.
        parameters: (M, 13) calibration, in the order of READING_PARAMETERS.
    """

    pose: IntVector
    point: IntVector
    value: FloatMatrix
    polar: FloatVector
    whitening: FloatBlocks
    mount: FloatMatrix
    velocity: FloatMatrix
    applied_s: FloatVector
    linear: FloatBlocks
    parameters: IntMatrix


class Ties(NamedTuple):
    """M ties of a place to the one that it is a case of: (case - general) / sigma.

    The place of a pass is a case of its drive's own place, with sigma in metres of the wheels, and that of the joint
    place.

    Attributes:
        case, general: (M,) points.
        parameter: (M,) ln distance of the drive.
        unit: (M,) ln distance in whose metres sigma is: that of the drive, or the stretch.
        inside: (M,) 1 where both are of the drive, so that both are stretched.
        sigma: (M,) in m of the wheels.
    """

    case: IntVector
    general: IntVector
    parameter: IntVector
    unit: IntVector
    inside: FloatVector
    sigma: FloatVector


@inner
def _wrap(angle: float) -> float:
    return (angle + np.pi) % (2.0 * np.pi) - np.pi


@inner
def motion_error(m: int, motions: MotionArrays, values: Variables, e: FloatArray, J: FloatArray) -> None:
    """Set the whitened residual e (3,) of a motion and its Jacobian J (3, 6 + W) by both poses and its parameters."""
    i, n = motions.first[m], motions.parameters.shape[1]
    poses, calibration = values.poses, values.calibration
    q0, q1, phi = motions.along[m, 0], motions.along[m, 1], motions.turn[m]
    for k in range(1, n):
        c = calibration[motions.parameters[m, k]]
        q0 += motions.by_along[m, 0, k - 1] * c
        q1 += motions.by_along[m, 1, k - 1] * c
        phi += motions.by_turn[m, k - 1] * c
    shrink = np.exp(-calibration[motions.parameters[m, 0]])  # from metres to metres of the wheels
    half = poses[i, 2] + 0.5 * phi
    cos, sin = np.cos(half), np.sin(half)
    x, y = poses[i + 1, 0] - poses[i, 0], poses[i + 1, 1] - poses[i, 1]
    a0, a1 = shrink * (cos * x + sin * y), shrink * (-sin * x + cos * y)
    s0, s1, s2 = 1.0 / motions.sigma[m, 0], 1.0 / motions.sigma[m, 1], 1.0 / motions.sigma[m, 2]
    e[0], e[1], e[2] = s0 * (a0 - q0), s1 * (a1 - q1), s2 * _wrap(poses[i + 1, 2] - poses[i, 2] - phi)
    J[:] = 0.0
    cos, sin = shrink * cos, shrink * sin
    J[0, 0], J[0, 1], J[0, 2], J[0, 3], J[0, 4] = -s0 * cos, -s0 * sin, s0 * a1, s0 * cos, s0 * sin
    J[1, 0], J[1, 1], J[1, 2], J[1, 3], J[1, 4] = s1 * sin, -s1 * cos, -s1 * a0, -s1 * sin, s1 * cos
    J[2, 2], J[2, 5] = -s2, s2
    for k in range(1, n):
        by_turn = motions.by_turn[m, k - 1]
        J[0, 6 + k] = s0 * (0.5 * by_turn * a1 - motions.by_along[m, 0, k - 1])
        J[1, 6 + k] = s1 * (-0.5 * by_turn * a0 - motions.by_along[m, 1, k - 1])
        J[2, 6 + k] = -s2 * by_turn


@inner
def reading_error(
    m: int, readings: ReadingArrays, values: Variables, e: FloatArray, J: FloatArray, H: FloatArray
) -> None:
    """Set the whitened residual e (2,) of a reading and its Jacobian J (2, N_READING), by pose, point and parameters.

    A range is predicted as exp(range_scale - tag_scale) rho cos(beta)^a + offset, where (rho, beta) is the point in the
    sensor's axes: a is 0 for a range and 1 for a depth. H is scratch (2, N_READING).
    """
    i, j = readings.pose[m], readings.point[m]
    c = values.calibration
    own = readings.parameters[m]
    late = c[own[3]] - readings.applied_s[m]
    forward, left, turning = readings.velocity[m, 0], readings.velocity[m, 1], readings.velocity[m, 2]
    theta = values.poses[i, 2] - late * turning
    cos, sin = np.cos(theta), np.sin(theta)
    vx, vy = cos * forward - sin * left, sin * forward + cos * left
    x = values.points[j, 0] - values.poses[i, 0] + late * vx
    y = values.points[j, 1] - values.poses[i, 1] + late * vy
    mx, my, yaw = readings.mount[m, 0] + c[own[0]], readings.mount[m, 1] + c[own[1]], readings.mount[m, 2] + c[own[2]]
    bx, by = cos * x + sin * y - mx, -sin * x + cos * y - my  # from the sensor, in axes of base
    cy, sy = np.cos(yaw), np.sin(yaw)
    q0, q1 = cy * bx + sy * by, -sy * bx + cy * by
    # The derivative of (q0, q1) by pose (3), point (2) and parameters.
    H[:] = 0.0
    cp, sp = np.cos(theta + yaw), np.sin(theta + yaw)
    tx, ty = by + my, -(bx + mx)  # derivative of the place in base by theta
    H[0, 0], H[0, 1], H[0, 2] = -cp, -sp, cy * tx + sy * ty
    H[1, 0], H[1, 1], H[1, 2] = sp, -cp, -sy * tx + cy * ty
    H[0, 3], H[0, 4], H[1, 3], H[1, 4] = cp, sp, -sp, cp
    H[0, 5], H[0, 6], H[1, 5], H[1, 6] = -cy, -sy, sy, -cy
    H[0, 7], H[1, 7] = q1, -q0
    # A later stamp means an earlier pose; the velocity's own turn with theta is of second order in the delay.
    H[0, 8] = cp * vx + sp * vy - turning * H[0, 2]
    H[1, 8] = -sp * vx + cp * vy - turning * H[1, 2]
    rho = max(np.sqrt(q0 * q0 + q1 * q1), LEAST_RANGE_M)
    beta = np.arctan2(q1, q0)
    scale = np.exp(c[own[5]] - c[own[7]])
    exponent = c[own[6]]
    cosine = max(np.cos(beta), LEAST_COSINE)
    factor = scale * cosine**exponent  # from rho to the range
    by_beta = -exponent * np.sin(beta) / cosine if np.cos(beta) > LEAST_COSINE else 0.0  # of ln factor
    d0, d1 = -q1 / (rho * rho), q0 / (rho * rho)  # of beta by q
    r, offset = rho * factor, c[own[4]]
    W = readings.whitening[m]
    if readings.polar[m] > 0.5:
        for k in range(9):
            along = (q0 * H[0, k] + q1 * H[1, k]) / rho
            turned = d0 * H[0, k] + d1 * H[1, k]
            H[0, k], H[1, k] = factor * along + r * by_beta * turned, turned
        H[0, 9], H[0, 10], H[0, 11], H[0, 12] = 1.0, r, r * np.log(cosine), -r
        r0, r1 = r + offset - readings.value[m, 0], _wrap(beta - readings.value[m, 1])
    else:
        grown = factor + offset / rho
        for k in range(9):
            along = (q0 * H[0, k] + q1 * H[1, k]) / rho
            turned = d0 * H[0, k] + d1 * H[1, k]
            change = factor * by_beta * turned - offset / (rho * rho) * along
            H[0, k], H[1, k] = grown * H[0, k] + q0 * change, grown * H[1, k] + q1 * change
        for k, change in ((9, 1.0 / rho), (10, factor), (11, factor * np.log(cosine)), (12, -factor)):
            H[0, k], H[1, k] = q0 * change, q1 * change
        r0, r1 = grown * q0 - readings.value[m, 0], grown * q1 - readings.value[m, 1]
    for k in range(N_LINEAR):
        H[0, 5 + _LINEAR_FROM + k], H[1, 5 + _LINEAR_FROM + k] = -readings.linear[m, 0, k], -readings.linear[m, 1, k]
        value = c[own[_LINEAR_FROM + k]]
        r0 -= readings.linear[m, 0, k] * value
        r1 -= readings.linear[m, 1, k] * value
    px, py, lx, ly = values.poses[i, 0], values.poses[i, 1], values.points[j, 0], values.points[j, 1]
    for k in range(2):
        H[k, _DISTANCE] = H[k, 0] * px + H[k, 1] * py + H[k, 3] * lx + H[k, 4] * ly
        H[k, _DISTANCE + 1] = H[k, _DISTANCE]
    e[0], e[1] = W[0, 0] * r0, W[1, 0] * r0 + W[1, 1] * r1
    for k in range(N_READING):
        J[0, k], J[1, k] = W[0, 0] * H[0, k], W[1, 0] * H[0, k] + W[1, 1] * H[1, k]


@inner
def tie_error(m: int, ties: Ties, values: Variables, stretch: float, e: FloatArray, J: FloatArray) -> None:
    """Set the whitened residual e (2,) of a tie and its Jacobian J (2, 5) by both points and ln distance.

    The case is as given times `stretch`; the Jacobian is by the case before it.
    """
    inverse = np.exp(-values.calibration[ties.unit[m]]) / ties.sigma[m]
    by_distance = 0.0 if ties.inside[m] > 0.5 else inverse
    for k in range(2):
        case = stretch * values.points[ties.case[m], k]
        e[k] = inverse * (case - values.points[ties.general[m], k])
        J[k, k], J[k, 2 + k], J[k, 4] = stretch * inverse, -inverse, by_distance * case


@inner
def _add(
    kind: Kind, m: int, e: FloatArray, w: FloatArray, J: FloatArray, system: FrontalSystem,
    normal: FloatArray, vector: FloatArray, free: Unsigned, place: Unsigned,
) -> None:  # fmt: skip
    """Add J^T diag(w) J and J^T diag(w) e of one factor to the system."""
    n = J.shape[1]
    for a in range(n):
        total = 0.0
        for r in range(len(e)):
            total += J[r, a] * w[r] * e[r]
        vector[a] = total
    add_vector(kind, m, vector, system.gradient)
    if len(system.entries) == 0:
        return
    for a in range(n):
        for b in range(a, n):
            total = 0.0
            for r in range(len(e)):
                total += J[r, a] * w[r] * J[r, b]
            normal[a, b] = total
            normal[b, a] = total
    add_matrix(kind, m, normal, 0, n, system, free, place)


@njit
def add_motions(
    motions: MotionArrays, kind: Kind, values: Variables, nu: float, system: FrontalSystem, share: float
) -> float:
    """Add the motions to a system, each component with a tail of its own, weights times a share; return their cost."""
    motions, kind, values, system = borrow(motions), borrow(kind), borrow(values), borrow(system)
    n = 6 + motions.parameters.shape[1]
    e, w, J, normal, vector = np.empty(3), np.empty(3), np.empty((3, n)), np.empty((n, n)), np.empty(n)
    free, place = np.empty(n, dtype=np.uint64), np.empty(n, dtype=np.uint64)
    cost = 0.0
    for m in range(len(motions.first)):
        motion_error(m, motions, values, e, J)
        for k in range(3):
            cost += 0.5 * (nu + 1.0) * np.log1p(e[k] * e[k] / nu)
            w[k] = share * (nu + 1.0) / (nu + e[k] * e[k])
        _add(kind, m, e, w, J, system, normal, vector, free, place)
    return cost


@njit
def add_readings(
    readings: ReadingArrays, kind: Kind, values: Variables, nu: float, system: FrontalSystem, share: float
) -> float:
    """Add the readings to a system, weights times a share; return their cost."""
    readings, kind, values, system = borrow(readings), borrow(kind), borrow(values), borrow(system)
    n = N_READING
    e, w, J, H = np.empty(2), np.empty(2), np.empty((2, n)), np.empty((2, n))
    normal, vector = np.empty((n, n)), np.empty(n)
    free, place = np.empty(n, dtype=np.uint64), np.empty(n, dtype=np.uint64)
    cost = 0.0
    for m in range(len(readings.pose)):
        reading_error(m, readings, values, e, J, H)
        Q = e[0] * e[0] + e[1] * e[1]
        cost += 0.5 * (nu + 2.0) * np.log1p(Q / nu)
        w[:] = share * (nu + 2.0) / (nu + Q)
        _add(kind, m, e, w, J, system, normal, vector, free, place)
    return cost


@njit
def add_ties(ties: Ties, kind: Kind, values: Variables, nu: float, system: FrontalSystem, share: float) -> float:
    """Add the ties to a system, weights times a share; return their cost."""
    ties, kind, values, system = borrow(ties), borrow(kind), borrow(values), borrow(system)
    e, w, J, normal, vector = np.empty(2), np.empty(2), np.zeros((2, 5)), np.empty((5, 5)), np.empty(5)
    free, place = np.empty(5, dtype=np.uint64), np.empty(5, dtype=np.uint64)
    cost = 0.0
    for m in range(len(ties.case)):
        tie_error(m, ties, values, 1.0, e, J)
        Q = e[0] * e[0] + e[1] * e[1]
        cost += 0.5 * (nu + 2.0) * np.log1p(Q / nu)
        w[:] = share * (nu + 2.0) / (nu + Q)
        _add(kind, m, e, w, J, system, normal, vector, free, place)
    return cost


@njit
def errors_of_motions(motions: MotionArrays, values: Variables, nu: float) -> tuple[FloatArray, FloatArray]:
    """Return whitened residuals and weights (M, 3) of motions."""
    motions, values = borrow(motions), borrow(values)
    e, w = np.empty((len(motions.first), 3)), np.empty((len(motions.first), 3))
    J = np.empty((3, 6 + motions.parameters.shape[1]))
    for m in range(len(e)):
        motion_error(m, motions, values, e[m], J)
        for k in range(3):
            w[m, k] = (nu + 1.0) / (nu + e[m, k] ** 2)
    return e, w


@njit
def errors_of_readings(readings: ReadingArrays, values: Variables, nu: float) -> tuple[FloatArray, FloatArray]:
    """Return whitened residuals (M, 2) and weights (M,) of readings."""
    readings, values = borrow(readings), borrow(values)
    e, w = np.empty((len(readings.pose), 2)), np.empty(len(readings.pose))
    J, H = np.empty((2, N_READING)), np.empty((2, N_READING))
    for m in range(len(e)):
        reading_error(m, readings, values, e[m], J, H)
        w[m] = (nu + 2.0) / (nu + e[m, 0] ** 2 + e[m, 1] ** 2)
    return e, w


@njit
def errors_of_ties(ties: Ties, values: Variables, nu: float) -> tuple[FloatArray, FloatArray]:
    """Return whitened residuals (M, 2) and weights (M,) of ties."""
    ties, values = borrow(ties), borrow(values)
    e, w, J = np.empty((len(ties.case), 2)), np.empty(len(ties.case)), np.zeros((2, 5))
    for m in range(len(e)):
        tie_error(m, ties, values, 1.0, e[m], J)
        w[m] = (nu + 2.0) / (nu + e[m, 0] ** 2 + e[m, 1] ** 2)
    return e, w


@njit
def selected_inverse(nodes: Nodes, entries: FloatVector) -> FloatArray:
    """Return the entries of H^-1 within all fronts, from those of R with R^T R = H (Erisman and Tinney 1975).

    From the root down, with O the columns that a front eliminates and A the others: Z_OA = -X Z_AA and
    Z_OO = (R_OO^T R_OO)^-1 + X Z_AA X^T, with X = R_OO^-1 R_OA. Both triangles are set.
    """
    nodes = borrow(nodes)
    Z = np.zeros(len(entries))
    for i in range(len(nodes.parent) - 1, -1, -1):
        size, n = nodes.start[i + 1] - nodes.start[i], nodes.n_own[i]
        R = entries[nodes.offset[i] : nodes.offset[i + 1]].reshape(size, size)
        own = Z[nodes.offset[i] : nodes.offset[i + 1]].reshape(size, size)
        rest = size - n
        inverse = np.zeros((n, n))  # of R_OO
        for c in range(n):
            inverse[c, c] = 1.0 / R[c, c]
            for r in range(c - 1, -1, -1):
                total = 0.0
                for k in range(r + 1, c + 1):
                    total += R[r, k] * inverse[k, c]
                inverse[r, c] = -total / R[r, r]
        if rest > 0:
            p = nodes.parent[i]
            above_size = nodes.start[p + 1] - nodes.start[p]
            above = Z[nodes.offset[p] : nodes.offset[p + 1]].reshape(above_size, above_size)
            for a in range(n, size):
                row = nodes.in_parent[nodes.start[i] + a]
                for b in range(n, size):
                    own[a, b] = above[row, nodes.in_parent[nodes.start[i] + b]]
            X = inverse @ R[:n, n:].copy()
            shared = own[n:, n:].copy()
            across = X @ shared
            own[:n, n:] = -across
            own[n:, :n] = -across.T
            own[:n, :n] = inverse @ inverse.T + across @ X.T
        else:
            own[:n, :n] = inverse @ inverse.T
    return Z


@inner
def _gather(kind: Kind, m: int, nodes: Nodes, Z: FloatArray, out: FloatArray) -> None:
    """Set out (k, k) to the covariance of one factor's columns; 0 where fixed."""
    node = kind.node[m]
    size = nodes.start[node + 1] - nodes.start[node]
    begin = nodes.offset[node]
    n = kind.place.shape[1]
    for a in range(n):
        for b in range(n):
            row, column = kind.place[m, a], kind.place[m, b]
            out[a, b] = Z[begin + row * size + column] if row >= 0 and column >= 0 else 0.0


@inner
def _covariances(J: FloatArray, Z: FloatArray, out: FloatArray) -> None:
    """Set out (d, k) to J Z, the covariance of each residual with the factor's variables."""
    for r in range(J.shape[0]):
        for b in range(J.shape[1]):
            total = 0.0
            for a in range(J.shape[1]):
                total += J[r, a] * Z[a, b]
            out[r, b] = total


@inner
def _product(a: FloatArray, b: FloatArray) -> float:
    total = 0.0
    for k in range(len(a)):
        total += a[k] * b[k]
    return total


@inner
def _shift_motion(motions: MotionArrays, m: int, a: int, values: Variables, step: float) -> float:
    """Add a step to the a-th variable of a motion; return its value before."""
    if a < 6:
        pose, k = motions.first[m] + a // 3, a % 3
        kept = float(values.poses[pose, k])
        values.poses[pose, k] = kept + step
        return kept
    kept = float(values.calibration[motions.parameters[m, a - 6]])
    values.calibration[motions.parameters[m, a - 6]] = kept + step
    return kept


@inner
def _restore_motion(motions: MotionArrays, m: int, a: int, values: Variables, kept: float) -> None:
    if a < 6:
        values.poses[motions.first[m] + a // 3, a % 3] = kept
    else:
        values.calibration[motions.parameters[m, a - 6]] = kept


@inner
def _shift_reading(readings: ReadingArrays, m: int, a: int, values: Variables, step: float) -> float:
    """Add a step to the a-th variable of a reading; return its value before."""
    if a < 3:
        kept = float(values.poses[readings.pose[m], a])
        values.poses[readings.pose[m], a] = kept + step
        return kept
    if a < 5:
        kept = float(values.points[readings.point[m], a - 3])
        values.points[readings.point[m], a - 3] = kept + step
        return kept
    kept = float(values.calibration[readings.parameters[m, a - 5]])
    values.calibration[readings.parameters[m, a - 5]] = kept + step
    return kept


@inner
def _stretch_reading(readings: ReadingArrays, m: int, values: Variables, by: float) -> None:
    for k in range(2):
        values.poses[readings.pose[m], k] *= by
        values.points[readings.point[m], k] *= by


@inner
def _restore_reading(readings: ReadingArrays, m: int, a: int, values: Variables, kept: float) -> None:
    if a < 3:
        values.poses[readings.pose[m], a] = kept
    elif a < 5:
        values.points[readings.point[m], a - 3] = kept
    else:
        values.calibration[readings.parameters[m, a - 5]] = kept


@njit
def trace_motions(
    motions: MotionArrays, kind: Kind, values: Variables, nu: float, nodes: Nodes, Z: FloatVector, tilt: FloatVector
) -> FloatArray:
    """Return the diagonals (M, 3) of J Z J^T, and add the gradient of 1/2 ln det H by motions to tilt (n,).

    The gradient is 1/2 tr(Z dH) = tr(J Z W dJ^T) with dJ the change of the Jacobians, by central differences, and with
    the weights W held.
    """
    motions, kind, values, nodes = borrow(motions), borrow(kind), borrow(values), borrow(nodes)
    n = 6 + motions.parameters.shape[1]
    e, w, J, C, G = np.empty(3), np.empty(3), np.empty((3, n)), np.empty((n, n)), np.empty((3, n))
    h = np.empty((len(motions.first), 3))
    for m in range(len(motions.first)):
        motion_error(m, motions, values, e, J)
        _gather(kind, m, nodes, Z, C)
        _covariances(J, C, G)
        for k in range(3):
            w[k] = (nu + 1.0) / (nu + e[k] * e[k])
            h[m, k] = _product(G[k], J[k])
        for a in range(n):
            if kind.columns[m, a] < 0 or a == 6:
                continue
            for sign in (1.0, -1.0):
                kept = _shift_motion(motions, m, a, values, sign * _STEP)
                motion_error(m, motions, values, e, J)
                _restore_motion(motions, m, a, values, kept)
                change = w[0] * _product(G[0], J[0]) + w[1] * _product(G[1], J[1]) + w[2] * _product(G[2], J[2])
                tilt[kind.columns[m, a]] += 0.5 * sign * change / _STEP
    return h


@njit
def trace_readings(
    readings: ReadingArrays, kind: Kind, values: Variables, nu: float, nodes: Nodes, Z: FloatVector, tilt: FloatVector
) -> FloatArray:
    """Return J Z J^T (M, 2, 2), and add the gradient of 1/2 ln det H by readings to tilt (n,), as `trace_motions`."""
    readings, kind, values, nodes = borrow(readings), borrow(kind), borrow(values), borrow(nodes)
    n = N_READING
    e, J, H, C, G = np.empty(2), np.empty((2, n)), np.empty((2, n)), np.empty((n, n)), np.empty((2, n))
    B = np.empty((len(readings.pose), 2, 2))
    for m in range(len(readings.pose)):
        reading_error(m, readings, values, e, J, H)
        _gather(kind, m, nodes, Z, C)
        _covariances(J, C, G)
        w = (nu + 2.0) / (nu + e[0] * e[0] + e[1] * e[1])
        for r in range(2):
            for s in range(2):
                B[m, r, s] = _product(G[r], J[s])
        for a in range(n):
            if kind.columns[m, a] < 0:
                continue
            for sign in (1.0, -1.0):
                if a >= _DISTANCE:
                    _stretch_reading(readings, m, values, np.exp(sign * _STEP))
                    reading_error(m, readings, values, e, J, H)
                    _stretch_reading(readings, m, values, np.exp(-sign * _STEP))
                    for k in (0, 1, 3, 4):  # by the places before they were stretched
                        J[0, k] *= np.exp(sign * _STEP)
                        J[1, k] *= np.exp(sign * _STEP)
                else:
                    kept = _shift_reading(readings, m, a, values, sign * _STEP)
                    reading_error(m, readings, values, e, J, H)
                    _restore_reading(readings, m, a, values, kept)
                change = w * (_product(G[0], J[0]) + _product(G[1], J[1]))
                tilt[kind.columns[m, a]] += 0.5 * sign * change / _STEP
    return B


@njit
def trace_ties(
    ties: Ties, kind: Kind, values: Variables, nu: float, nodes: Nodes, Z: FloatVector, tilt: FloatVector
) -> FloatArray:
    """Return (M,) the trace of J Z J^T of each tie, and add to tilt (n,) as `trace_motions`."""
    ties, kind, values, nodes = borrow(ties), borrow(kind), borrow(values), borrow(nodes)
    e, J, C, G, h = np.empty(2), np.zeros((2, 5)), np.empty((5, 5)), np.empty((2, 5)), np.empty(len(ties.case))
    for m in range(len(h)):
        _gather(kind, m, nodes, Z, C)
        tie_error(m, ties, values, 1.0, e, J)
        _covariances(J, C, G)
        h[m] = _product(G[0], J[0]) + _product(G[1], J[1])
        w = (nu + 2.0) / (nu + e[0] * e[0] + e[1] * e[1])
        if ties.inside[m] > 0.5:
            continue
        inverse = np.exp(-values.calibration[ties.unit[m]]) / ties.sigma[m]
        for a in (0, 1, 4):
            if kind.columns[m, a] < 0:
                continue
            for sign in (1.0, -1.0):
                step = sign * _STEP
                tie_error(m, ties, values, np.exp(step) if a == 4 else 1.0, e, J)
                if a < 2:
                    J[a, 4] += step * inverse
                change = w * (_product(G[0], J[0]) + _product(G[1], J[1]))
                tilt[kind.columns[m, a]] += 0.5 * change / step
    return h


@njit
def pull_motions(
    motions: MotionArrays, kind: Kind, values: Variables, which: IntVector, V: FloatBlocks, out: FloatMatrix
) -> None:
    """Add J^T v of some motions to out (k, n), for each of V (k, len(which), 3)."""
    motions, kind, values = borrow(motions), borrow(kind), borrow(values)
    e, J = np.empty(3), np.empty((3, 6 + motions.parameters.shape[1]))
    for i in range(len(which)):
        motion_error(which[i], motions, values, e, J)
        _pull(kind, which[i], J, V, i, out)


@njit
def pull_readings(
    readings: ReadingArrays, kind: Kind, values: Variables, which: IntVector, V: FloatBlocks, out: FloatMatrix
) -> None:
    """Add J^T v of some readings to out (k, n), for each of V (k, len(which), 2)."""
    readings, kind, values = borrow(readings), borrow(kind), borrow(values)
    e, J, H = np.empty(2), np.empty((2, N_READING)), np.empty((2, N_READING))
    for i in range(len(which)):
        reading_error(which[i], readings, values, e, J, H)
        _pull(kind, which[i], J, V, i, out)


@njit
def pull_ties(ties: Ties, kind: Kind, values: Variables, V: FloatBlocks, out: FloatMatrix) -> None:
    """Add J^T v of all ties to out (k, n), for each of V (k, M, 2)."""
    ties, kind, values = borrow(ties), borrow(kind), borrow(values)
    e, J = np.empty(2), np.zeros((2, 5))
    for i in range(len(ties.case)):
        tie_error(i, ties, values, 1.0, e, J)
        _pull(kind, i, J, V, i, out)


@inner
def _pull(kind: Kind, m: int, J: FloatArray, V: FloatArray, i: int, out: FloatArray) -> None:
    for a in range(J.shape[1]):
        column = kind.columns[m, a]
        if column < 0:
            continue
        for k in range(len(V)):
            total = 0.0
            for r in range(J.shape[0]):
                total += J[r, a] * V[k, i, r]
            out[k, column] += total
