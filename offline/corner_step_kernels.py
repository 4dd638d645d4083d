"""Compiled steps of an estimate on corners: where robots, tags and how these hang are after one."""

import numpy as np

from calib.arrays import FloatArray, IntArray
from offline.corner_kernels import SpatialValues
from offline.jit import borrowed, inner, jitted
from offline.linearise_kernels import series, wrapped


@jitted
def move(
    values: SpatialValues,
    step: FloatArray,
    poses: IntArray,
    tags: IntArray,
    heights: IntArray,
    turns: IntArray,
    anchor: IntArray,
    out: SpatialValues,
) -> None:
    """`CornerProblem.moved`, calibration apart.

    Args:
        values: before.
        step: (n + 1,), the last one zero: where what is held points.
        poses: (P, 3) columns.
        tags: (T, 2) of their places.
        heights: (T,) of theirs.
        turns: (T, 3) of theirs.
        anchor: (T,) a pose from which each tag was seen.
        out: after.
    """
    values, out = borrowed(values), borrowed(out)
    turn, product = np.empty((3, 3)), np.empty((3, 3))
    for p in range(len(values.poses)):
        d0, d1, omega = step[poses[p, 0]], step[poses[p, 1]], step[poses[p, 2]]
        along, even, _ = series(omega)
        across = omega * even
        x, y = along * d0 - across * d1, across * d0 + along * d1
        cos, sin = np.cos(values.poses[p, 2]), np.sin(values.poses[p, 2])
        out.poses[p, 0] = values.poses[p, 0] + cos * x - sin * y
        out.poses[p, 1] = values.poses[p, 1] + sin * x + cos * y
        out.poses[p, 2] = wrapped(values.poses[p, 2] + omega)
    for t in range(len(values.tags)):
        pose = anchor[t]
        before, after = values.poses[pose], out.poses[pose]
        d0, d1, omega = step[poses[pose, 0]], step[poses[pose, 1]], step[poses[pose, 2]]
        own_0, own_1 = step[tags[t, 0]], step[tags[t, 1]]
        cos, sin = np.cos(before[2]), np.sin(before[2])
        dx, dy = values.tags[t, 0] - before[0], values.tags[t, 1] - before[1]
        x, y = cos * dx + sin * dy, cos * dy - sin * dx
        # As seen from the anchor it moves by its own step, but for what the anchor's makes of it.
        x, y = x + (cos * own_0 + sin * own_1 - d0 + omega * y), y + (cos * own_1 - sin * own_0 - d1 - omega * x)
        cos, sin = np.cos(after[2]), np.sin(after[2])
        out.tags[t, 0] = after[0] + cos * x - sin * y
        out.tags[t, 1] = after[1] + sin * x + cos * y
        R = values.turns[t]
        if heights[t] < 0:
            out.heights_m[t] = values.heights_m[t]
            out.turns[t] = R
            continue
        out.heights_m[t] = values.heights_m[t] + step[heights[t]]
        # The anchor's turn about map's vertical, and the rest about the tag's own axes.
        turn_by(step[turns[t, 0]] - R[2, 0] * omega, step[turns[t, 1]] - R[2, 1] * omega,
              step[turns[t, 2]] - R[2, 2] * omega, turn)  # fmt: skip
        turned(R, turn, product)
        cos, sin = np.cos(omega), np.sin(omega)
        for j in range(3):
            out.turns[t, 0, j] = cos * product[0, j] - sin * product[1, j]
            out.turns[t, 1, j] = sin * product[0, j] + cos * product[1, j]
            out.turns[t, 2, j] = product[2, j]


@inner
def turned(R: FloatArray, by: FloatArray, out: FloatArray) -> None:
    """R (3, 3) about its own axes."""
    for i in range(3):
        for j in range(3):
            out[i, j] = R[i, 0] * by[0, j] + R[i, 1] * by[1, j] + R[i, 2] * by[2, j]


@inner
def turn_by(a: float, b: float, c: float, out: FloatArray) -> None:
    """Rodrigues' formula: I + sin w / w K + (1 - cos w) / w^2 K^2."""
    odd, even, _ = series(np.sqrt(a * a + b * b + c * c))
    out[0, 0], out[0, 1], out[0, 2] = 1.0 - even * (b * b + c * c), even * a * b - odd * c, even * a * c + odd * b
    out[1, 0], out[1, 1], out[1, 2] = even * a * b + odd * c, 1.0 - even * (a * a + c * c), even * b * c - odd * a
    out[2, 0], out[2, 1], out[2, 2] = even * a * c - odd * b, even * b * c + odd * a, 1.0 - even * (a * a + b * b)
