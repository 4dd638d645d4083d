"""Compiled retraction of the bundle adjustment."""

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.corners.kernels.view import SpatialValues
from groundsbot.offline.foundation import borrow, inner, njit
from groundsbot.offline.sam import advance, go_along, multiply, series


@njit
def retract(
    values: SpatialValues,
    step: FloatArray,
    poses: IntArray,
    tags: IntArray,
    heights: IntArray,
    turns: IntArray,
    anchor: IntArray,
    out: SpatialValues,
) -> None:
    """Apply `CornerProblem.retract` to all variables but the calibration.

    Args:
        values: values before the step.
        step: (n + 1,) step; the last entry is zero, for fixed variables.
        poses: (P, 3) columns of poses.
        tags: (T, 2) columns of tag positions.
        heights: (T,) columns of tag heights.
        turns: (T, 3) columns of tag rotations.
        anchor: (T,) pose index with which each tag moves.
        out: values after the step.
    """
    values, out = borrow(values), borrow(out)
    turn, turned = np.empty((3, 3)), np.empty((3, 3))
    for p in range(len(values.poses)):
        advance(values.poses[p], step[poses[p, 0]], step[poses[p, 1]], step[poses[p, 2]], out.poses[p])
    for t in range(len(values.tags)):
        at, before, after = poses[anchor[t]], values.poses[anchor[t]], out.poses[anchor[t]]
        omega = step[at[2]]
        go_along(
            values.tags[t], before, after, step[at[0]], step[at[1]], omega, step[tags[t, 0]], step[tags[t, 1]],
            out.tags[t],
        )  # fmt: skip
        R = values.turns[t]
        if heights[t] < 0:
            out.heights_m[t] = values.heights_m[t]
            out.turns[t] = R
            continue
        out.heights_m[t] = values.heights_m[t] + step[heights[t]]
        # The anchor's rotation about the vertical of map, then the remainder about the tag's axes.
        turn_by(step[turns[t, 0]] - R[2, 0] * omega, step[turns[t, 1]] - R[2, 1] * omega,
              step[turns[t, 2]] - R[2, 2] * omega, turn)  # fmt: skip
        multiply(R, turn, turned)
        cos, sin = np.cos(omega), np.sin(omega)
        for j in range(3):
            out.turns[t, 0, j] = cos * turned[0, j] - sin * turned[1, j]
            out.turns[t, 1, j] = sin * turned[0, j] + cos * turned[1, j]
            out.turns[t, 2, j] = turned[2, j]


@inner
def turn_by(a: float, b: float, c: float, out: FloatArray) -> None:
    """Set out to exp of a rotation vector by Rodrigues' formula: I + sin w / w K + (1 - cos w) / w^2 K^2."""
    odd, even, _ = series(np.sqrt(a * a + b * b + c * c))
    out[0, 0], out[0, 1], out[0, 2] = 1.0 - even * (b * b + c * c), even * a * b - odd * c, even * a * c + odd * b
    out[1, 0], out[1, 1], out[1, 2] = even * a * b + odd * c, 1.0 - even * (a * a + c * c), even * b * c - odd * a
    out[2, 0], out[2, 1], out[2, 2] = even * a * c - odd * b, even * b * c + odd * a, 1.0 - even * (a * a + b * b)
