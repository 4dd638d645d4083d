"""Compiled inner loops of the online estimate: solutions, covariances and tests from the root of `online.kernels`."""

from typing import Final, NamedTuple

import numpy as np

from groundsbot.calib.foundation import FloatArray
from groundsbot.offline.foundation import njit
from groundsbot.offline.localization.online.kernels import Border, Motions, PresentObservations, scatter_row
from groundsbot.offline.sam import N_OBSERVATION, Values, motion_at, observation_factor, series, wheel_correction, wrap

# Eigenvalues below this share of the largest are rounding.
_LEAST_SHARE: Final = 1e-9


class LeaveOneOut(NamedTuple):
    """The effect of removing the map's prior from one tag.

    Attributes:
        at: the tag's first column in the border.
        by_shift: (3 + n, 2) derivative of the step of pose and border by the tag's shift.
        shift_m: (2,) of the tag from its position in the map.
        covariance: (2, 2) of the shift.
    """

    at: int
    by_shift: FloatArray
    shift_m: FloatArray
    covariance: FloatArray


@njit
def solve_root(border: Border, pose: FloatArray, right: FloatArray, n: int) -> FloatArray:
    """Solve (pose rows; S) x = right for (3 + n,) x; zero for variables without information."""
    x = np.zeros(3 + n)
    for i in range(n):
        total = right[3 + i]
        for j in range(i):
            total -= border.root[i, j] * x[3 + j]
        if border.root[i, i] > 0.0:
            x[3 + i] = total / border.root[i, i]
    for i in range(2, -1, -1):
        total = right[i]
        for j in range(n):
            total -= pose[i, 4 + j] * x[3 + j]
        for c in range(i + 1, 3):
            total -= pose[i, c] * x[c]
        if pose[i, i] != 0.0:
            x[i] = total / pose[i, i]
    return x


@njit
def whiten_rows(border: Border, pose: FloatArray, rows: FloatArray, n: int) -> FloatArray:
    """Solve Y (pose rows; S) = rows (m, 3 + n) for Y; the covariance of rows times the variables is Y Y^T."""
    whitened = rows.copy()
    for k in range(len(whitened)):
        y = whitened[k]
        for c in range(3):
            if y[c] == 0.0:
                continue
            y[c] /= pose[c, c]
            for i in range(c + 1, 3):
                y[i] -= pose[c, i] * y[c]
            for j in range(n):
                y[3 + j] -= pose[c, 4 + j] * y[c]
        for j in range(n - 1, -1, -1):
            if y[3 + j] == 0.0:
                continue
            y[3 + j] /= border.root[j, j]
            for i in range(j):
                y[3 + i] -= border.root[j, i] * y[3 + j]
    return whitened


@njit
def leave_one_out_test(
    border: Border, pose: FloatArray, prior: FloatArray, off: FloatArray, n: int, at: int, unmodelled: float
) -> float:
    """Return the squared sigmas of a held tag's shift against all other measurements, as in `solve_in_map`.

    Args:
        border: S.
        pose: rows of the present pose.
        prior: (>= n, >= n) lower triangular square-root information of the prior.
        off: (n,) offset of the estimate from the prior's mean.
        n: length of the border.
        at: the tag's first column.
        unmodelled: additional variance of each coordinate, m^2.
    """
    rows, weighted_off, residual_information = np.zeros((2, 3 + n)), np.zeros(2), np.zeros((2, 2))
    for k in range(2):
        for i in range(at + k, n):
            w = prior[i, at + k]
            for j in range(i + 1):
                rows[k, 3 + j] += w * prior[i, j]
        for j in range(n):
            weighted_off[k] += rows[k, 3 + j] * off[j]
    whitened = whiten_rows(border, pose, rows, n)
    for i in range(2):
        for k in range(2):
            residual_information[i, k] = rows[i, 3 + at + k] - (whitened[i] * whitened[k]).sum()
    # The tag's shift is N^+ weighted_off with the residual information N. It is singular in directions that only the
    # prior determines, where nothing can contradict the prior.
    a, d = residual_information[0, 0], residual_information[1, 1]
    b = 0.5 * (residual_information[0, 1] + residual_information[1, 0])
    mean, radius = 0.5 * (a + d), np.sqrt(0.25 * (a - d) ** 2 + b * b)
    squared, angle = 0.0, 0.5 * np.arctan2(2.0 * b, a - d)
    for k in range(2):
        eigenvalue = mean + radius if k == 0 else mean - radius
        if eigenvalue > _LEAST_SHARE * (mean + radius) > 0.0:
            axis = angle + 0.5 * np.pi * k
            shift = (np.cos(axis) * weighted_off[0] + np.sin(axis) * weighted_off[1]) / eigenvalue
            squared += shift * shift / (1.0 / eigenvalue + unmodelled)
    return squared


@njit
def predict(
    border: Border, n: int, observations: PresentObservations, values: Values, step: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the first observation's residual (2,), its Jacobian (2, 3 + n), and that by its tag (2, 2)."""
    r, J, row, rows = np.empty(2), np.empty((2, N_OBSERVATION)), np.empty(4 + n), np.empty((2, 3 + n))
    observation_factor(observations, 0, values, True, r, J)  # type: ignore[arg-type] # has the fields in use
    for i in range(2):
        scatter_row(border, observations, 0, J[i], row)
        rows[i, :3], rows[i, 3:] = row[:3], row[4:]
        for j in range(3 + n):
            r[i] += rows[i, j] * step[j]
    return r, rows, J[:, 3:5].copy()


@njit
def huber_weight(innovation: FloatArray, covariance: FloatArray, threshold: float) -> float:
    """Return Huber's weight of an observation by its residual after the update, which depends on the weight.

    Args:
        innovation: (2,) whitened residual before the update.
        covariance: (2, 2) of the whitened prediction.
        threshold: threshold of Huber's loss.
    """
    weight = 1.0
    for _ in range(4):  # fixed-point iteration
        a, b, d = 1.0 + weight * covariance[0, 0], weight * covariance[0, 1], 1.0 + weight * covariance[1, 1]
        scale = 1.0 / (a * d - b * b)
        x, y = scale * (d * innovation[0] - b * innovation[1]), scale * (a * innovation[1] - b * innovation[0])
        length = np.sqrt(x * x + y * y)
        if length <= threshold:
            return 1.0
        weight = threshold / length
    return weight


@njit
def back_substitute(
    eliminated: FloatArray,
    points: FloatArray,
    after: FloatArray,
    border: FloatArray,
    twist: FloatArray,
    out: FloatArray,
) -> FloatArray:
    """Substitute back to M eliminated poses.

    Args:
        eliminated: (M, 3, 7 + n) from `sweep`.
        points: (M, 3) linearisation points.
        after: (3,) step of the pose after them.
        border: (>= n,) step of the border.
        twist: (5,) as in `move`.
        out: (M, 3) output, the poses.

    Returns:
        (3,) the step of the first of them.
    """
    n = eliminated.shape[2] - 7
    following, step = after.copy(), np.empty(3)
    for m in range(len(eliminated) - 1, -1, -1):
        for i in range(2, -1, -1):
            row = eliminated[m, i]
            total = row[6]
            for c in range(3):
                total -= row[3 + c] * following[c]
            for j in range(n):
                total -= row[7 + j] * border[j]
            for c in range(i + 1, 3):
                total -= row[c] * step[c]
            step[i] = total / row[i]
        following[:] = step
        move(points[m], step, twist, out[m])
    return following


@njit
def move(point: FloatArray, step: FloatArray, twist: FloatArray, out: FloatArray) -> None:
    """Fill `out` (3,) with a pose moved by a step (3,) that contains the common twist (5,) of `moving_frame`."""
    turn, dx, dy, cx, cy = twist[0], twist[1], twist[2], twist[3], twist[4]
    cos, sin = np.cos(point[2]), np.sin(point[2])
    vx, vy = dx - turn * (point[1] - cy), dy + turn * (point[0] - cx)
    own = step[2] - turn
    along, even, _ = series(own)
    u, v = step[0] - cos * vx - sin * vy, step[1] + sin * vx - cos * vy
    x, y = along * u - own * even * v, own * even * u + along * v
    x, y = point[0] + cos * x - sin * y - cx, point[1] + sin * x + cos * y - cy
    along, even, _ = series(turn)
    cos, sin = np.cos(turn), np.sin(turn)
    out[0] = cx + along * dx - turn * even * dy + cos * x - sin * y
    out[1] = cy + turn * even * dx + along * dy + sin * x + cos * y
    out[2] = wrap(point[2] + step[2])


@njit
def propagate(pose: FloatArray, motions: Motions, m: int, calibration: FloatArray) -> FloatArray:
    """Return (3,) the pose after motion m."""
    t = wheel_correction(motions, m, calibration)  # type: ignore[arg-type] # has the fields in use
    x, y, turn, _, _ = motion_at(motions, m, t)  # type: ignore[arg-type]
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    return np.array([pose[0] + cos * x - sin * y, pose[1] + sin * x + cos * y, wrap(pose[2] + turn)])
