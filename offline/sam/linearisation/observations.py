"""Compiled linearisation of tag observations and calibration priors; see `linearisation.kernels`."""

from typing import Final

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.calib.robot import CAMERA_PARAMETERS
from groundsbot.offline.foundation import FloatBlocks, FloatMatrix, FloatVector, borrow, inline, inner, njit
from groundsbot.offline.sam.linearisation.blocks import NormalEquations
from groundsbot.offline.sam.linearisation.kernels import Free, ObservationArrays, Values
from groundsbot.offline.sam.linearisation.robust_losses import Loss, bend, loss_and_weight

_N_CAMERA: Final = len(CAMERA_PARAMETERS)
_N_PARAMETERS: Final = 4 + _N_CAMERA  # mount, tag scale and camera
# A bearing fades out where the predicted range is below this share of the observed one, as it never is of a good
# observation. At the sensor itself a bearing is undefined: its residual would change by radians within micrometres, and
# a solve that gets there would not converge.
FADED_BELOW: Final = 0.2
N_OBSERVATION: Final = 5 + _N_PARAMETERS  # columns of an observation; pose and tag come first


@njit
def add_observations(
    observations: ObservationArrays, loss: Loss, values: Values, free: Free, system: NormalEquations
) -> float:
    """Add all tag observations to the blocks; return the sum of their losses."""
    observations, values, free, system = borrow(observations), borrow(values), borrow(free), borrow(system)
    r, J, columns = np.empty(2), np.empty((2, N_OBSERVATION)), np.empty(_N_PARAMETERS, np.int64)
    total, g, by_calibration = 0.0, system.gradient, system.pose_calibration.shape[2] > 0
    for m in range(len(observations.pose)):
        pose, tag = observations.pose[m], observations.tag[m]
        observation_factor(observations, m, values, by_calibration, r, J)
        square = r[0] * r[0] + r[1] * r[1]
        rho, w = loss_and_weight(loss, square)
        total += rho
        bend(loss, square, r, J)
        a0, a1, a2, b0, b1, b2 = J[0, 0], J[0, 1], J[0, 2], J[1, 0], J[1, 1], J[1, 2]
        c0, c1, d0, d1 = J[0, 3], J[0, 4], J[1, 3], J[1, 4]
        r0, r1 = w * r[0], w * r[1]
        H, N, T = system.pose[pose], system.pose_tag[m], system.tag[tag]
        h01, h02, h12 = w * (a0 * a1 + b0 * b1), w * (a0 * a2 + b0 * b2), w * (a1 * a2 + b1 * b2)
        H[0, 0] += w * (a0 * a0 + b0 * b0)
        H[0, 1] += h01
        H[0, 2] += h02
        H[1, 0] += h01
        H[1, 1] += w * (a1 * a1 + b1 * b1)
        H[1, 2] += h12
        H[2, 0] += h02
        H[2, 1] += h12
        H[2, 2] += w * (a2 * a2 + b2 * b2)
        N[0, 0], N[0, 1] = w * (a0 * c0 + b0 * d0), w * (a0 * c1 + b0 * d1)
        N[1, 0], N[1, 1] = w * (a1 * c0 + b1 * d0), w * (a1 * c1 + b1 * d1)
        N[2, 0], N[2, 1] = w * (a2 * c0 + b2 * d0), w * (a2 * c1 + b2 * d1)
        t01 = w * (c0 * c1 + d0 * d1)
        T[0, 0] += w * (c0 * c0 + d0 * d0)
        T[0, 1] += t01
        T[1, 0] += t01
        T[1, 1] += w * (c1 * c1 + d1 * d1)
        g[3 * pose] += a0 * r0 + b0 * r1
        g[3 * pose + 1] += a1 * r0 + b1 * r1
        g[3 * pose + 2] += a2 * r0 + b2 * r1
        first_tag = 3 * len(values.poses) + 2 * tag
        g[first_tag] += c0 * r0 + d0 * r1
        g[first_tag + 1] += c1 * r0 + d1 * r1
        if by_calibration:
            _add_calibration(observations, m, w, free, r, J, columns, system)
    return total


@njit
def linearise_observations(observations: ObservationArrays, values: Values, r: FloatMatrix, J: FloatBlocks) -> None:
    """Set residuals r (M, 2) and Jacobians J (M, 2, N_OBSERVATION) of all observations; see `observation_factor`."""
    observations, values = borrow(observations), borrow(values)
    for m in range(len(observations.pose)):
        observation_factor(observations, m, values, True, r[m], J[m])


@inner
def _add_calibration(
    observations: ObservationArrays,
    m: int,
    weight: float,
    free: Free,
    r: FloatArray,
    J: FloatArray,
    columns: IntArray,
    system: NormalEquations,
) -> None:
    """Add the blocks of the free parameters of an observation; `columns` (9,) is a work array."""
    N, T = system.pose_calibration[observations.pose[m]], system.tag_calibration[observations.tag_segment[m]]
    own = system.gradient[len(system.gradient) - len(system.calibration) :]
    slots, parameters = observations.slots[m], observations.parameters[m]
    for a in range(_N_PARAMETERS):
        columns[a] = free.calibration[parameters[a]]
    for a in range(_N_PARAMETERS):
        slot, column = slots[a], columns[a]
        if slot < 0:
            continue
        j0, j1 = weight * J[0, 5 + a], weight * J[1, 5 + a]
        N[0, slot] += J[0, 0] * j0 + J[1, 0] * j1
        N[1, slot] += J[0, 1] * j0 + J[1, 1] * j1
        N[2, slot] += J[0, 2] * j0 + J[1, 2] * j1
        T[0, slot] += J[0, 3] * j0 + J[1, 3] * j1
        T[1, slot] += J[0, 4] * j0 + J[1, 4] * j1
        row = system.calibration[column]  # symmetric
        for b in range(_N_PARAMETERS):
            if columns[b] >= 0:
                row[columns[b]] += j0 * J[0, 5 + b] + j1 * J[1, 5 + b]
        own[column] += j0 * r[0] + j1 * r[1]


@inline
def observation_factor(
    observations: ObservationArrays, m: int, values: Values, by_calibration: bool, r: FloatArray, J: FloatArray
) -> None:
    """Set r (2,) = W (predicted - observed) and its Jacobian J (2, N_OBSERVATION); see `ObservationFactors`.

    The columns are pose (3), tag (2), mount (3), tag scale (1) and camera (5); the last nine are set only with
    `by_calibration`.
    """
    pose, tag = observations.pose[m], observations.tag[m]
    theta = values.poses[pose, 2]
    cos, sin = np.cos(theta), np.sin(theta)
    dx, dy = values.tags[tag, 0] - values.poses[pose, 0], values.tags[tag, 1] - values.poses[pose, 1]
    base_x, base_y = cos * dx + sin * dy, cos * dy - sin * dx
    yaw = observations.mount[m, 2] + values.calibration[observations.parameters[m, 2]]
    mount_x = observations.mount[m, 0] + values.calibration[observations.parameters[m, 0]]
    mount_y = observations.mount[m, 1] + values.calibration[observations.parameters[m, 1]]
    scale = 1.0 + values.calibration[observations.parameters[m, 3]]
    c, s = np.cos(yaw), np.sin(yaw)
    x = (c * (base_x - mount_x) + s * (base_y - mount_y)) / scale
    y = (c * (base_y - mount_y) - s * (base_x - mount_x)) / scale
    first, second = _correct(observations, m, values)
    W = observations.whitening[m]
    o00, o01, o10, o11, weight = W[0, 0], W[0, 1], W[1, 0], W[1, 1], 1.0
    if observations.polar[m]:
        range_m = np.sqrt(x * x + y * y)
        d0 = range_m - first
        d1 = np.arctan2(y, x) - second
        d1 -= 2.0 * np.pi * np.rint(d1 / (2.0 * np.pi))
        range_m = max(range_m, 1e-9)
        ux, uy = x / range_m, y / range_m
        vx, vy = -uy / range_m, ux / range_m
        near_m = FADED_BELOW * observations.value[m, 0]
        if range_m < near_m:  # with the weight p (2 - p), p = (range / near)^2, whose derivative is continuous
            part = range_m * range_m / (near_m * near_m)
            weight, slope = part * (2.0 - part), 4.0 * part * (1.0 - part) / range_m * d1
            d1 *= weight
            vx, vy = weight * vx + slope * ux, weight * vy + slope * uy
        o00, o01 = W[0, 0] * ux + W[0, 1] * vx, W[0, 0] * uy + W[0, 1] * vy
        o10, o11 = W[1, 0] * ux + W[1, 1] * vx, W[1, 0] * uy + W[1, 1] * vy
    else:
        d0, d1 = x - first, y - second
    r[0], r[1] = W[0, 0] * d0 + W[0, 1] * d1, W[1, 0] * d0 + W[1, 1] * d1
    for i in range(2):
        a, b = (o00, o01) if i == 0 else (o10, o11)
        # Whitened derivatives: (a, b) with respect to the position in the sensor, (bx, by) to that in base.
        bx, by = (a * c - b * s) / scale, (a * s + b * c) / scale
        # Under T o exp(d), l_base moves by -(d_xy + d_theta K l_base), K the rotation by 90 degrees.
        J[i, 0], J[i, 1], J[i, 2] = -bx, -by, bx * base_y - by * base_x
        J[i, 3], J[i, 4] = bx * cos - by * sin, bx * sin + by * cos
        if by_calibration:
            J[i, 5], J[i, 6], J[i, 7] = -bx, -by, a * y - b * x
            J[i, 8] = -(a * x + b * y) / scale
            for k in range(_N_CAMERA):
                J[i, 9 + k] = -(
                    W[i, 0] * observations.by_camera[m, 0, k] + weight * W[i, 1] * observations.by_camera[m, 1, k]
                )


@inline
def _correct(observations: ObservationArrays, m: int, values: Values) -> tuple[float, float]:
    """Return the observed value, corrected by the camera parameters."""
    first, second = observations.value[m, 0], observations.value[m, 1]
    for k in range(_N_CAMERA):
        c = values.calibration[observations.parameters[m, 4 + k]]
        if c != 0.0:
            first += observations.by_camera[m, 0, k] * c
            second += observations.by_camera[m, 1, k] * c
    return first, second


@njit
def add_priors(sigma: FloatVector, values: Values, free: Free, system: NormalEquations) -> float:
    """Add r = c / sigma for all free parameters; return the sum of squares, which includes fixed parameters."""
    base = len(system.gradient) - len(system.calibration)
    total = 0.0
    for c in range(len(sigma)):
        column = free.calibration[c]
        r = values.calibration[c] / (sigma[c] if sigma[c] > 0.0 else 1.0)
        total += r * r
        if column >= 0:
            system.calibration[column, column] += 1.0 / (sigma[c] * sigma[c])
            system.gradient[base + column] += r / sigma[c]
    return total
