"""Motion model of a differential drive: two wheel advances give a motion on an exact arc.

With d = (left + right) / 2 and a = (right - left) / track, the motion in the frame of its start is
(d sin(a)/a, d (1 - cos a)/a, a), the exponential of (d, 0, a). y is to the left, so a faster right wheel turns left.
The paper has a wrong sign in its heading row, and an Euler step instead of the arc.
"""

import numpy as np
from numpy.typing import ArrayLike

from groundsbot.calib.foundation import FloatArray
from groundsbot.calib.geometry.se2 import one_minus_cos_over_square

_SERIES_BELOW_RAD = 0.5


def advance(left_m: ArrayLike, right_m: ArrayLike, track_m: ArrayLike) -> FloatArray:
    """Return the motion of the base over one step.

    Args:
        left_m: `[...]` distance that the left wheel rolled, forward positive.
        right_m: `[...]` the same for the right wheel.
        track_m: `[...]` distance between the contact points of the wheels.

    Returns:
        `[..., 3]` (x_m, y_m, theta_rad), the pose at the end of the step in the frame of its start. theta is not
        wrapped.
    """
    distance, turn = _distance_and_turn(left_m, right_m, track_m)
    return _arc(distance, turn)


def advance_with_jacobians(
    left_m: ArrayLike, right_m: ArrayLike, track_m: ArrayLike
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the motion as `advance` does, with the derivatives of its coordinates (x, y, theta).

    Derivatives in the right tangent space (T o exp(delta)), which factors use, are
    `se2.right_tangent_from_coordinates(motion) @ d_motion_d_wheels`.

    Returns:
        The motion `[..., 3]`, its derivatives `[..., 3, 2]` by (left_m, right_m), and `[..., 3]` by track_m.
    """
    distance, turn = _distance_and_turn(left_m, right_m, track_m)
    track = np.asarray(track_m, dtype=np.float64)
    along, across = np.sinc(turn / np.pi), turn * one_minus_cos_over_square(turn)
    d_x_d_turn = distance * _sinc_slope(turn)
    d_y_d_turn = distance * (along - one_minus_cos_over_square(turn))

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
        [distance * np.sinc(turn / np.pi), distance * turn * one_minus_cos_over_square(turn), turn], axis=-1
    )


def _sinc_slope(turn: FloatArray) -> FloatArray:
    """Return d/da of sin(a)/a, near zero by its series, where (a cos a - sin a) / a^2 cancels."""
    square = turn * turn
    series = -turn / 3 * (1 - square / 10 * (1 - square / 28 * (1 - square / 54 * (1 - square / 88))))
    small = np.abs(turn) < _SERIES_BELOW_RAD
    safe = np.where(small, 1.0, turn)
    return np.where(small, series, (safe * np.cos(safe) - np.sin(safe)) / (safe * safe))
