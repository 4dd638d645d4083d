"""Compiled linearisation of tag corners and of odometry into the fronts."""

from typing import Final

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.corners.kernels.view import (
    CameraPose,
    CornerObservations,
    SpatialValues,
    corner_factor,
    set_mount,
)
from groundsbot.offline.foundation import borrow, inner, njit
from groundsbot.offline.sam import (
    FrontalSystem,
    Kind,
    Loss,
    OdometryArrays,
    Values,
    add_matrix,
    add_vector,
    error_by_wheels,
    error_of,
    loss_and_weight,
    motion_at,
    scaled_information,
    wheel_correction,
)

N_DETECTION: Final = 19  # columns of a detection
N_POSE: Final = 3  # the first ones of them
N_POSES: Final = 6  # columns of an odometry factor before those of its parameters
_WIDTH: Final = 20  # padded with a zero, since columns are processed in pairs


@njit
def add_corners(
    detections: CornerObservations,
    lenses: FloatArray,
    loss: Loss,
    values: SpatialValues,
    kind: Kind,
    order: IntArray,
    system: FrontalSystem,
) -> float:
    """Add J^T W J and J^T W r of all detections; return the sum of their losses.

    Only gradients are added if the system has no matrices. Detections are processed in the given order (M,):
    consecutive ones that differ in the pose only are summed before their other entries are added to the front.
    """
    detections, values, kind, system = borrow(detections), borrow(values), borrow(kind), borrow(system)
    r, J, B, normal, vector = _corner_scratch()
    eye = CameraPose(np.full(6, np.nan), np.empty((3, 3)), np.empty((3, 3)))
    total, is_whole, last = 0.0, len(system.entries) > 0, -1
    free, place = np.empty(N_DETECTION, dtype=np.uint64), np.empty(N_DETECTION, dtype=np.uint64)
    for m in order:
        set_mount(detections, m, values.calibration, eye)
        corner_factor(detections, lenses, m, values, eye, r, J, B)
        square = 0.0
        for i in range(8):
            square += r[i] * r[i]
        rho, w = loss_and_weight(loss, square)
        total += rho
        f0, f1, f2, f3 = w * r[0], w * r[1], w * r[2], w * r[3]
        f4, f5, f6, f7 = w * r[4], w * r[5], w * r[6], w * r[7]
        _combine(J, f0, f1, f2, f3, f4, f5, f6, f7, vector)
        add_vector(kind, m, vector[:N_DETECTION], system.gradient)
        if is_whole:
            if last >= 0 and not _is_alike(kind, last, m):
                add_matrix(kind, last, normal, N_POSE, N_DETECTION, system, free, place)
                normal[N_POSE:] = 0.0
            last = m
            normal[:N_POSE] = 0.0
            _add_square(J, w, normal)
            add_matrix(kind, m, normal, 0, N_POSE, system, free, place)
    if last >= 0:
        add_matrix(kind, last, normal, N_POSE, N_DETECTION, system, free, place)
    return total


@inner
def _corner_scratch() -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return work arrays: residual, Jacobians of the columns and of ATTITUDE, normal matrix and gradient."""
    return np.empty(8), np.zeros((8, _WIDTH)), np.empty((8, 3)), np.zeros((_WIDTH, _WIDTH)), np.zeros(_WIDTH)


@inner
def _is_alike(kind: Kind, m: int, other: int) -> bool:
    """Return whether two detections differ in the pose only."""
    apart = abs(kind.node[m] - kind.node[other])
    for a in range(N_POSE, N_DETECTION):
        apart += abs(kind.place[m, a] - kind.place[other, a])
    return bool(apart == 0)


@inner
def _add_square(J: FloatArray, w: float, normal: FloatArray) -> None:
    """Add w J^T J in both triangles, two rows at once, since this vectorises better than one triangle."""
    for a in range(0, _WIDTH, 2):
        f0, f1, f2, f3 = w * J[0, a], w * J[1, a], w * J[2, a], w * J[3, a]
        f4, f5, f6, f7 = w * J[4, a], w * J[5, a], w * J[6, a], w * J[7, a]
        g0, g1, g2, g3 = w * J[0, a + 1], w * J[1, a + 1], w * J[2, a + 1], w * J[3, a + 1]
        g4, g5, g6, g7 = w * J[4, a + 1], w * J[5, a + 1], w * J[6, a + 1], w * J[7, a + 1]
        one, other = normal[a], normal[a + 1]
        for b in range(len(one)):
            j0, j1, j2, j3, j4, j5, j6, j7 = J[0, b], J[1, b], J[2, b], J[3, b], J[4, b], J[5, b], J[6, b], J[7, b]
            one[b] += (f0 * j0 + f1 * j1 + f2 * j2 + f3 * j3) + (f4 * j4 + f5 * j5 + f6 * j6 + f7 * j7)
            other[b] += (g0 * j0 + g1 * j1 + g2 * j2 + g3 * j3) + (g4 * j4 + g5 * j5 + g6 * j6 + g7 * j7)


@njit
def linearise_corners(
    detections: CornerObservations,
    lenses: FloatArray,
    values: SpatialValues,
    r: FloatArray,
    J: FloatArray,
    B: FloatArray,
) -> None:
    """Set residuals r (M, 8) and derivatives J (M, 8, 19) and B (M, 8, 3) of all detections, as `corner_factor`."""
    detections, values = borrow(detections), borrow(values)
    eye = CameraPose(np.full(6, np.nan), np.empty((3, 3)), np.empty((3, 3)))
    for m in range(len(detections.pose)):
        set_mount(detections, m, values.calibration, eye)
        corner_factor(detections, lenses, m, values, eye, r[m], J[m], B[m])


@njit
def add_attitude_noise(
    detections: CornerObservations,
    lenses: FloatArray,
    loss: Loss,
    values: SpatialValues,
    given: FloatArray,
    picture: IntArray,
    weight: FloatArray,
    own: FloatArray,
    force: FloatArray,
    coupled: FloatArray,
) -> None:
    """Add B^T W B (P, 3, 3) and B^T W r (P, 3) of P images, and set B^T W J (M, 3, 19), with B as in `corner_factor`.

    Also set the weights (M,): the given ones, or those of the loss for level images if none are given.
    """
    detections, values = borrow(detections), borrow(values)
    r, J, B, _, vector = _corner_scratch()
    eye = CameraPose(np.full(6, np.nan), np.empty((3, 3)), np.empty((3, 3)))
    for m in range(len(detections.pose)):
        set_mount(detections, m, values.calibration, eye)
        corner_factor(detections, lenses, m, values, eye, r, J, B)
        square = 0.0
        for i in range(8):
            square += r[i] * r[i]
        w = given[m] if len(given) else loss_and_weight(loss, square)[1]
        weight[m] = w
        for k in range(3):
            f0, f1, f2, f3 = w * B[0, k], w * B[1, k], w * B[2, k], w * B[3, k]
            f4, f5, f6, f7 = w * B[4, k], w * B[5, k], w * B[6, k], w * B[7, k]
            _combine(J, f0, f1, f2, f3, f4, f5, f6, f7, vector)
            coupled[m, k] = vector[:N_DETECTION]
            for i in range(8):
                force[picture[m], k] += w * B[i, k] * r[i]
                for j in range(3):
                    own[picture[m], k, j] += w * B[i, k] * B[i, j]


@njit
def add_motions(odometry: OdometryArrays, loss: Loss, values: Values, kind: Kind, system: FrontalSystem) -> float:
    """Add J^T W J and J^T W r of all odometry factors; return the sum of their losses.

    Only gradients are added if the system has no matrices.
    """
    odometry, values, kind, system = borrow(odometry), borrow(values), borrow(kind), borrow(system)
    n_parameters = odometry.jacobian.shape[2]
    n = N_POSES + n_parameters
    C, J, heavy = np.empty((3, n_parameters)), np.empty((3, n)), np.empty((3, n))
    normal, vector = np.empty((n, n)), np.empty(n)
    free, place = np.empty(n, dtype=np.uint64), np.empty(n, dtype=np.uint64)
    total, is_whole, last, cos_j, sin_j = 0.0, len(system.entries) > 0, -1, 1.0, 0.0
    for m in range(len(odometry.first)):
        i = odometry.first[m]
        before, after = values.poses[i], values.poses[i + 1]
        cos_i, sin_i = cos_j, sin_j
        if i != last:
            cos_i, sin_i = np.cos(before[2]), np.sin(before[2])
        last, cos_j, sin_j = i + 1, np.cos(after[2]), np.sin(after[2])
        apart_x, apart_y = after[0] - before[0], after[1] - before[1]
        x, y = cos_i * apart_x + sin_i * apart_y, cos_i * apart_y - sin_i * apart_x
        t = wheel_correction(odometry, m, values.calibration)
        e, (a, b, p, q) = error_of(motion_at(odometry, m, t), x, y, after[2] - before[2])
        s = 1.0 / (1.0 + values.calibration[odometry.parameters[m, 0]])
        error_by_wheels(odometry.jacobian[m], t, e, s, C)
        # Jr^-1(e) by the second pose; by the first one that times the negative adjoint of the inverse motion.
        J[0, 3], J[0, 4], J[0, 5], J[1, 3], J[1, 4], J[1, 5] = a, -b, p, b, a, q
        J[2, 3], J[2, 4], J[2, 5] = 0.0, 0.0, 1.0
        cos, sin = cos_i * cos_j + sin_i * sin_j, cos_i * sin_j - sin_i * cos_j
        u, v = sin * x - cos * y, cos * x + sin * y
        for k in range(3):
            J[k, 0] = -(J[k, 3] * cos - J[k, 4] * sin)
            J[k, 1] = -(J[k, 3] * sin + J[k, 4] * cos)
            J[k, 2] = -(J[k, 3] * u + J[k, 4] * v + J[k, 5])
            for j in range(n_parameters):
                J[k, N_POSES + j] = C[k, j]
        l0, l1, l2, l3, l4, l5 = scaled_information(odometry.information[m], s)
        f0 = l0 * e[0] + l1 * e[1] + l2 * e[2]
        f1 = l1 * e[0] + l3 * e[1] + l4 * e[2]
        f2 = l2 * e[0] + l4 * e[1] + l5 * e[2]
        rho, w = loss_and_weight(loss, e[0] * f0 + e[1] * f1 + e[2] * f2)
        total += rho
        for k in range(n):
            vector[k] = w * (f0 * J[0, k] + f1 * J[1, k] + f2 * J[2, k])
        add_vector(kind, m, vector, system.gradient)
        if is_whole:
            for k in range(n):
                heavy[0, k] = w * (l0 * J[0, k] + l1 * J[1, k] + l2 * J[2, k])
                heavy[1, k] = w * (l1 * J[0, k] + l3 * J[1, k] + l4 * J[2, k])
                heavy[2, k] = w * (l2 * J[0, k] + l4 * J[1, k] + l5 * J[2, k])
            for k in range(n):
                c0, c1, c2 = J[0, k], J[1, k], J[2, k]
                for j in range(k, n):
                    normal[k, j] = c0 * heavy[0, j] + c1 * heavy[1, j] + c2 * heavy[2, j]
            add_matrix(kind, m, normal, 0, n, system, free, place)
    return total


@inner
def _combine(
    J: FloatArray,
    f0: float,
    f1: float,
    f2: float,
    f3: float,
    f4: float,
    f5: float,
    f6: float,
    f7: float,
    out: FloatArray,
) -> None:
    """Set out (20,) to the sum of the rows of J (8, 20), each times its factor."""
    for b in range(len(out)):
        out[b] = (f0 * J[0, b] + f1 * J[1, b] + f2 * J[2, b] + f3 * J[3, b]) + (
            f4 * J[4, b] + f5 * J[5, b] + f6 * J[6, b] + f7 * J[7, b]
        )
