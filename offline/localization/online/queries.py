"""Compiled inner loops of the online estimate: what its square root information matrix says. See `online.kernels`."""

from typing import Final

import numpy as np

from groundsbot.calib.foundation import FloatArray
from groundsbot.offline.foundation import njit
from groundsbot.offline.localization.online.kernels import Border, Motions, PresentObservations, inflate
from groundsbot.offline.sam import N_OBSERVATION, Values, motion_at, observation_factor, series, wheel_correction, wrap

# Of what is checked of a tag, below which rounding is all there is.
_LEAST_SHARE: Final = 1e-9


@njit
def through(border: Border, pose: FloatArray, right: FloatArray, n: int) -> FloatArray:
    """(3 + n,) x of (pose and S) x = right (3 + n,), by pose and border; zero for what nothing tells of."""
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
def carry_rows(border: Border, pose: FloatArray, rows: FloatArray, n: int) -> FloatArray:
    """(m, 3 + n) Y with Y times (pose and S) = rows (m, 3 + n) by pose and border: they vary by Y Y^T."""
    found = rows.copy()
    for k in range(len(found)):
        y = found[k]
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
    return found


@njit
def leave_one_out_test(
    border: Border, pose: FloatArray, prior: FloatArray, off: FloatArray, n: int, at: int, unmodelled: float
) -> float:
    """Squared sigmas of a tag that holds against all else, as of `solve_in_map`.

    Args:
        border: S.
        pose: rows of the present pose.
        prior: (>= n, >= n) square root information of what is known beforehand, lower triangular.
        off: (n,) of the estimate from what is known beforehand.
        n: length of the border.
        at: the tag's first column.
        unmodelled: variance of each coordinate besides.
    """
    ways, pull, checked = np.zeros((2, 3 + n)), np.zeros(2), np.zeros((2, 2))
    for k in range(2):
        for i in range(at + k, n):
            w = prior[i, at + k]
            for j in range(i + 1):
                ways[k, 3 + j] += w * prior[i, j]
        for j in range(n):
            pull[k] += ways[k, 3 + j] * off[j]
    taken = carry_rows(border, pose, ways, n)
    for i in range(2):
        for k in range(2):
            checked[i, k] = ways[i, 3 + at + k] - (taken[i] * taken[k]).sum()
    # The shift of its place is C pull with C the pseudo-inverse of what is checked: along what nothing else tells of,
    # nothing can contradict.
    a, b, d = checked[0, 0], 0.5 * (checked[0, 1] + checked[1, 0]), checked[1, 1]
    middle, apart = 0.5 * (a + d), np.sqrt(0.25 * (a - d) ** 2 + b * b)
    squares, angle = 0.0, 0.5 * np.arctan2(2.0 * b, a - d)
    for k in range(2):
        value = middle + apart if k == 0 else middle - apart
        if value > _LEAST_SHARE * (middle + apart) > 0.0:
            turn = angle + 0.5 * np.pi * k
            along = (np.cos(turn) * pull[0] + np.sin(turn) * pull[1]) / value
            squares += along * along / (1.0 / value + unmodelled)
    return squares


@njit
def predict(
    border: Border, n: int, sights: PresentObservations, values: Values, step: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the first observation's residual (2,), its Jacobian (2, 3 + n), and that by its tag (2, 2)."""
    r, J, row, rows = np.empty(2), np.empty((2, N_OBSERVATION)), np.empty(4 + n), np.empty((2, 3 + n))
    observation_factor(sights, 0, values, True, r, J)  # type: ignore[arg-type] # it has what that reads
    for i in range(2):
        inflate(border, sights, 0, J[i], row)
        rows[i, :3], rows[i, 3:] = row[:3], row[4:]
        for j in range(3 + n):
            r[i] += rows[i, j] * step[j]
    return r, rows, J[:, 3:5].copy()


@njit
def huber_weight(residual: FloatArray, spread: FloatArray, threshold: float) -> float:
    """Huber's weight of an observation (2,) by what it leaves over, which depends on its weight."""
    weight = 1.0
    for _ in range(4):
        a, b, d = 1.0 + weight * spread[0, 0], weight * spread[0, 1], 1.0 + weight * spread[1, 1]
        scale = 1.0 / (a * d - b * b)
        x, y = scale * (d * residual[0] - b * residual[1]), scale * (a * residual[1] - b * residual[0])
        length = np.sqrt(x * x + y * y)
        if length <= threshold:
            return 1.0
        weight = threshold / length
    return weight


@njit
def back_substitute(
    left: FloatArray, points: FloatArray, after: FloatArray, border: FloatArray, twist: FloatArray, out: FloatArray
) -> FloatArray:
    """Poses from the rows that they left.

    Args:
        left: (M, 3, 7 + n) of `sweep`.
        points: (M, 3) about which they are.
        after: (3,) step of the pose after them.
        border: (>= n,) step of the border.
        twist: (5,) of `move`.
        out: (M, 3) takes the poses.

    Returns:
        (3,) step of the first.
    """
    n = left.shape[2] - 7
    following, step = after.copy(), np.empty(3)
    for m in range(len(left) - 1, -1, -1):
        for i in range(2, -1, -1):
            row = left[m, i]
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
    """Sets a pose (3,) to where a step (3,) takes it of which a twist (5,) is common to all, see `moving_frame`."""
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
    """(3,) where a motion leads to."""
    t = wheel_correction(motions, m, calibration)  # type: ignore[arg-type] # they have what that reads
    x, y, turn, _, _ = motion_at(motions, m, t)  # type: ignore[arg-type] # likewise
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    return np.array([pose[0] + cos * x - sin * y, pose[1] + sin * x + cos * y, wrap(pose[2] + turn)])
