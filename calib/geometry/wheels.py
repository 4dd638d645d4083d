"""Differential drive: two wheel advances are one motion on an exact arc.

With d = (left + right) / 2 and a = (right - left) / track, the motion in the frame of its start is
(d sin(a)/a, d (1 - cos a)/a, a): the exponential of (d, 0, a). y is to the left, so a faster right wheel turns left.
The paper's heading row has a sign slip and an Euler step where this has the arc.
"""

import numpy as np
from numpy.typing import ArrayLike

from groundsbot.calib.foundation import FloatArray

_SERIES_BELOW_RAD = 0.5


def advance(left_m: ArrayLike, right_m: ArrayLike, track_m: ArrayLike) -> FloatArray:
    """Motion `[..., 3]` (x_m, y_m, theta_rad) of the base over one step.

    Args:
        left_m: `[...]` how far the left wheel rolled, forward positive.
        right_m: `[...]` the same of the right wheel.
        track_m: `[...]` distance between the wheels' contact points.

    Returns:
        The pose at the step's end in the frame of its start; theta is the whole turn, not wrapped.
    """
    distance, turn = _distance_and_turn(left_m, right_m, track_m)
    return _arc(distance, turn)


def advance_with_jacobians(
    left_m: ArrayLike, right_m: ArrayLike, track_m: ArrayLike
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """As `advance`, with the derivatives of the coordinates (x, y, theta).

    They become derivatives in the right tangent space (T o exp(delta), as factors use it) by
    `se2.right_tangent_from_coordinates(motion) @ d_motion_d_wheels`.

    Returns:
        motion `[..., 3]`; d_motion_d_wheels `[..., 3, 2]` by (left_m, right_m); d_motion_d_track `[..., 3]`.
    """
    distance, turn = _distance_and_turn(left_m, right_m, track_m)
    track = np.asarray(track_m, dtype=np.float64)
    along, across = np.sinc(turn / np.pi), turn * _versine_over_square(turn)
    d_x_d_turn = distance * _sinc_slope(turn)
    d_y_d_turn = distance * (along - _versine_over_square(turn))

    d_wheels = np.empty((*turn.shape, 3, 2))
    for column, d_turn in enumerate((-1.0 / track, 1.0 / track)):
        d_wheels[..., 0, column] = 0.5 * along + d_x_d_turn * d_turn
        d_wheels[..., 1, column] = 0.5 * across + d_y_d_turn * d_turn
        d_wheels[..., 2, column] = d_turn

    d_turn_d_track = -turn / track
    d_track = np.stack([d_x_d_turn * d_turn_d_track, d_y_d_turn * d_turn_d_track, d_turn_d_track], axis=-1)
    return _arc(distance, turn), d_wheels, d_track


def _distance_and_turn(left_m: ArrayLike, right_m: ArrayLike, track_m: ArrayLike) -> tuple[FloatArray, FloatArray]:
    left, right = np.asarray(left_m, dtype=np.float64), np.asarray(right_m, dtype=np.float64)
    distance, turn = np.broadcast_arrays(0.5 * (left + right), (right - left) / np.asarray(track_m, dtype=np.float64))
    return distance, turn


def _arc(distance: FloatArray, turn: FloatArray) -> FloatArray:
    return np.stack(
        [distance * np.sinc(turn / np.pi), distance * turn * _versine_over_square(turn), turn],
        axis=-1,
    )


def _versine_over_square(turn: FloatArray) -> FloatArray:
    """(1 - cos a) / a^2, by the half angle so that nothing cancels."""
    return 0.5 * np.sinc(turn / (2.0 * np.pi)) ** 2


def _sinc_slope(turn: FloatArray) -> FloatArray:
    """d/da of sin(a)/a, by its series near zero where (a cos a - sin a) / a^2 cancels."""
    square = turn * turn
    series = -turn / 3 * (1 - square / 10 * (1 - square / 28 * (1 - square / 54 * (1 - square / 88))))
    small = np.abs(turn) < _SERIES_BELOW_RAD
    safe = np.where(small, 1.0, turn)
    return np.where(small, series, (safe * np.cos(safe) - np.sin(safe)) / (safe * safe))
