"""Compiled inner loops of the online estimate: update a square-root information matrix by Givens rotations.

The matrix S of the border (calibration, then tags in the order of their first observation) is lower triangular with
S x = d, and the covariance is S^-1 S^-T. The rows of the present pose are stored as (pose, d, border). The pose is
eliminated before the border, so a motion changes these rows only, and a new tag only adds rows to S. See Golub and Van
Loan, "Matrix Computations" (2013), 5.1.8 and 6.5.
"""

from typing import Final, NamedTuple

import numpy as np

from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray
from groundsbot.offline.foundation import inner, njit
from groundsbot.offline.sam import (
    N_OBSERVATION,
    Values,
    error_by_wheels,
    error_of,
    motion_at,
    observation_factor,
    wheel_correction,
    wrap,
)

BY_POINTS: Final = -1.0  # stands for Huber's weight by the residual at the linearisation points


class Motions(NamedTuple):
    """Odometry factors as in `sam.OdometryFactors`, each from a pose to the next.

    Attributes:
        motion: (M, 5) x, y, heading, and the heading's cosine and sine.
        whitening: (M, 3, 3).
        jacobian: (M, 3, P).
        parameters: (M, P) indices of calibration parameters; the last is the bias of a gyro, where there is one.
        difference: (M, P + 1) row of a `HeadingDifferences` by these parameters, and its value; zero where there is
            none.
        bias_walk: (M,) variance of the change of the bias after this motion, of all motions since the last such one.
    """

    motion: FloatArray
    whitening: FloatArray
    jacobian: FloatArray
    parameters: IntArray
    difference: FloatArray
    bias_walk: FloatArray


class PresentObservations(NamedTuple):
    """Observation factors as in `sam.ObservationFactors`, in order of pose; poses are counted from the present one."""

    pose: IntArray
    tag: IntArray
    value: FloatArray
    polar: BoolArray
    whitening: FloatArray
    mount: FloatArray
    by_camera: FloatArray
    parameters: IntArray


class Border(NamedTuple):
    """S and d of the border; the first n rows and columns are in use.

    Attributes:
        root: (N, N) S; right: (N,) d.
        columns: (C,) column of each calibration parameter, -1 where it is fixed.
        first_tag: (1,) column of the first tag.
    """

    root: FloatArray
    right: FloatArray
    columns: IntArray
    first_tag: IntArray


@njit
def sweep(
    border: Border,
    pose: FloatArray,
    n: int,
    motions: Motions,
    observations: PresentObservations,
    weights: FloatArray,
    values: Values,
    threshold: float,
    eliminated: FloatArray,
) -> None:
    """Process M motions and R observations in order of time.

    Args:
        border: updated in place.
        pose: (3, >= 4 + n) rows of the present pose; replaced by those of the last pose.
        n: length of the border.
        motions: M motions.
        observations: R observations.
        weights: (R,) of observations; Huber's weight by the residual at the linearisation points where negative.
        values: linearisation points; poses (M + 1, 3).
        threshold: threshold of Huber's loss.
        eliminated: (M, 3, 7 + n) output, the rows (pose, next pose, d, border) of each eliminated pose.
    """
    row, work = np.empty(4 + n), np.empty((6, 7 + n))
    r, J = np.empty(2), np.empty((2, N_OBSERVATION))
    k = 0
    for m in range(len(eliminated) + 1):
        if m > 0:
            _eliminate_pose(border, pose, n, motions, m - 1, values, work)
            eliminated[m - 1] = work[:3]
            _add_difference(border, pose, n, motions, m - 1, values, row)
            if motions.bias_walk[m - 1] > 0.0:
                at = border.columns[motions.parameters[m - 1, motions.parameters.shape[1] - 1]]
                _let_walk(border, pose, n, at, motions.bias_walk[m - 1], row)
        while k < len(weights) and observations.pose[k] == m:
            observation_factor(observations, k, values, True, r, J)  # type: ignore[arg-type] # has the fields in use
            weight = weights[k]
            if weight < 0.0:
                length = np.sqrt(r[0] * r[0] + r[1] * r[1])
                weight = threshold / length if length > threshold else 1.0
            root = np.sqrt(weight)
            for i in range(2):
                scatter_row(border, observations, k, J[i], row)
                row *= root
                row[3] = -root * r[i]
                _rotate_in(border, pose, n, row)
            k += 1


@inner
def _add_difference(
    border: Border, pose: FloatArray, n: int, motions: Motions, m: int, values: Values, row: FloatArray
) -> None:
    """Add the difference between gyro and wheels of a motion, a linear factor on the calibration."""
    P = motions.parameters.shape[1]
    total, square = motions.difference[m, P], 0.0
    row[:] = 0.0
    for k in range(P):
        c, d = motions.parameters[m, k], motions.difference[m, k]
        total += d * values.calibration[c]
        square += d * d
        if border.columns[c] >= 0:
            row[4 + border.columns[c]] += d
    if square > 0.0:
        row[3] = -total
        _rotate_in(border, pose, n, row)


@inner
def _let_walk(border: Border, pose: FloatArray, n: int, at: int, variance: float, row: FloatArray) -> None:
    """Replace the variable in column `at` by itself plus white noise, and eliminate the old one.

    `row` (pose, d, border) becomes the eliminated row but for its entry of the old variable, which is in `old`. It is
    rotated with the rows from `at` on, in their order, so that each stays in its triangle.
    """
    row[:] = 0.0
    old = 1.0 / np.sqrt(variance)
    row[4 + at] = -old
    right = border.right
    for i in range(at, n):
        own, b = border.root[i], border.root[i, at]
        if b == 0.0:
            continue
        length = np.sqrt(old * old + b * b)
        cos, sin, old = old / length, b / length, length
        own[at] = 0.0
        for j in range(i + 1):
            x, y = own[j], row[4 + j]
            own[j] = cos * x - sin * y
            row[4 + j] = cos * y + sin * x
        x, y = right[i], row[3]
        right[i] = cos * x - sin * y
        row[3] = cos * y + sin * x
    for i in range(2, -1, -1):
        b = pose[i, 4 + at]
        if b == 0.0:
            continue
        length = np.sqrt(old * old + b * b)
        cos, sin, old = old / length, b / length, length
        pose[i, 4 + at] = 0.0
        for j in range(4 + n):
            x, y = pose[i, j], row[j]
            pose[i, j] = cos * x - sin * y
            row[j] = cos * y + sin * x


@njit
def add_rows(border: Border, pose: FloatArray, n: int, rows: FloatArray) -> None:
    """Add measurements given as rows (pose, d, border), (M, <= 4 + n), of the present pose."""
    row = np.empty(4 + n)
    for m in range(len(rows)):
        row[:] = 0.0
        row[: rows.shape[1]] = rows[m]
        _rotate_in(border, pose, n, row)


@inner
def scatter_row(
    border: Border, observations: PresentObservations, k: int, derivative: FloatArray, row: FloatArray
) -> None:
    """Fill a row (pose, d, border) from an observation's derivative with respect to pose, tag and calibration."""
    row[:] = 0.0
    row[:3] = derivative[:3]
    tag = 4 + border.first_tag[0] + 2 * observations.tag[k]
    row[tag], row[tag + 1] = derivative[3], derivative[4]
    for a in range(N_OBSERVATION - 5):
        column = border.columns[observations.parameters[k, a]]
        if column >= 0:
            row[4 + column] += derivative[5 + a]


@inner
def _rotate_in(border: Border, pose: FloatArray, n: int, row: FloatArray) -> None:
    for c in range(3):
        if row[c] != 0.0:
            _rotate(pose[c], row, c, 4 + n)
    right = border.right
    for j in range(n - 1, -1, -1):
        b = row[4 + j]
        if b == 0.0:
            continue
        own = border.root[j]
        length = np.sqrt(own[j] * own[j] + b * b)
        cos, sin = own[j] / length, b / length
        for i in range(j):
            x, y = own[i], row[4 + i]
            own[i] = cos * x + sin * y
            row[4 + i] = cos * y - sin * x
        own[j] = length
        x, y = right[j], row[3]
        right[j] = cos * x + sin * y
        row[3] = cos * y - sin * x


@inner
def _rotate(upper: FloatArray, lower: FloatArray, at: int, end: int) -> None:
    """Rotate two rows from column `at` to `end` such that the lower one becomes zero at `at`."""
    a, b = upper[at], lower[at]
    length = np.sqrt(a * a + b * b)
    cos, sin = a / length, b / length
    for i in range(at, end):
        x, y = upper[i], lower[i]
        upper[i] = cos * x + sin * y
        lower[i] = cos * y - sin * x
    upper[at], lower[at] = length, 0.0


@inner
def _eliminate_pose(
    border: Border, pose: FloatArray, n: int, motions: Motions, m: int, values: Values, work: FloatArray
) -> None:
    """Eliminate a pose by a motion to the next; its rows are returned in `work[:3]`, those of the next in `pose`."""
    for i in range(3):
        for c in range(3):
            work[i, c], work[i, 3 + c] = pose[i, c], 0.0
        work[i, 6 : 7 + n] = pose[i, 3 : 4 + n]
    work[3:] = 0.0
    _linearise_motion(border, motions, m, values, work[3:])
    for c in range(6):
        for i in range(c + 1, 6):
            if work[i, c] != 0.0:
                _rotate(work[c], work[i], c, 7 + n)
    for i in range(3):
        pose[i, : 4 + n] = work[3 + i, 3 : 7 + n]


@inner
def _linearise_motion(border: Border, motions: Motions, m: int, values: Values, out: FloatArray) -> None:
    """Fill the rows (pose, next pose, d, border) of a motion as in `sam.OdometryFactors`."""
    first, second = values.poses[m], values.poses[m + 1]
    cos, sin = np.cos(first[2]), np.sin(first[2])
    dx, dy = second[0] - first[0], second[1] - first[1]
    x, y = cos * dx + sin * dy, cos * dy - sin * dx
    turn = wrap(second[2] - first[2])
    t = wheel_correction(motions, m, values.calibration)  # type: ignore[arg-type] # has the fields in use
    e, J = error_of(motion_at(motions, m, t), x, y, turn)  # type: ignore[arg-type]
    s = 1.0 / (1.0 + values.calibration[motions.parameters[m, 0]])
    C = np.empty_like(motions.jacobian[m])
    error_by_wheels(motions.jacobian[m], t, e, s, C)
    a, b, p, q = J
    cos, sin = np.cos(turn), np.sin(turn)
    u, v = sin * x - cos * y, cos * x + sin * y
    for i in range(3):
        W = motions.whitening[m, i]
        w0, w1, w2 = s * W[0], s * W[1], W[2]
        j0, j1, j2 = a * w0 + b * w1, a * w1 - b * w0, p * w0 + q * w1 + w2
        out[i, 0], out[i, 1], out[i, 2] = -(j0 * cos - j1 * sin), -(j0 * sin + j1 * cos), -(j0 * u + j1 * v + j2)
        out[i, 3], out[i, 4], out[i, 5] = j0, j1, j2
        out[i, 6] = -(w0 * e[0] + w1 * e[1] + w2 * e[2])
        for k in range(motions.parameters.shape[1]):
            column = border.columns[motions.parameters[m, k]]
            if column >= 0:
                out[i, 7 + column] += w0 * C[0, k] + w1 * C[1, k] + w2 * C[2, k]
