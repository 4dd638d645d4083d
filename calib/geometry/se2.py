"""SE(2) on arrays of any batch shape.

A transform T_a_b is an array `[..., 3]` of (x_m, y_m, theta_rad): position and heading of frame b in frame a.
A tangent vector is an array `[..., 3]` in the same order (x, y, theta). Perturbations are on the right:
T o exp(delta). Batch shapes broadcast. Source of the formulas: Sola, Deray, Atchuthan, "A micro Lie theory for state
estimation in robotics" (2018), appendix on SE(2).
"""

import numpy as np
from numpy.typing import ArrayLike

from groundsbot.calib.foundation import FloatArray

_SERIES_BELOW_RAD = 0.5  # below this (w - sin w) / w^2 loses digits and its series is used


def wrap_angle(angle_rad: ArrayLike) -> FloatArray:
    """Return the angle in (-pi, pi]. Angles in that interval are returned unchanged to the last bit."""
    angle = np.asarray(angle_rad, dtype=np.float64)
    turns = np.ceil((angle - np.pi) / (2.0 * np.pi))
    wrapped = angle - 2.0 * np.pi * turns
    # Rounding may give a value just outside, or turn an angle just above -pi into pi.
    wrapped = np.where(wrapped <= -np.pi, np.pi, np.minimum(wrapped, np.pi))
    return np.where((angle > -np.pi) & (angle <= np.pi), angle, wrapped)


def compose(T_a_b: ArrayLike, T_b_c: ArrayLike) -> FloatArray:
    """Return T_a_c = T_a_b o T_b_c, with the heading in (-pi, pi]."""
    first, second = _arrays(T_a_b, T_b_c)
    return _stack(*_transform(first, second[..., 0], second[..., 1]), wrap_angle(first[..., 2] + second[..., 2]))


def inverse(T_a_b: ArrayLike) -> FloatArray:
    """Return T_b_a."""
    x, y, theta = _parts(T_a_b)
    cos, sin = np.cos(theta), np.sin(theta)
    return _stack(-cos * x - sin * y, sin * x - cos * y, wrap_angle(-theta))


def between(T_w_a: ArrayLike, T_w_b: ArrayLike) -> FloatArray:
    """Return T_a_b = inverse(T_w_a) o T_w_b, with the heading in (-pi, pi]."""
    first, second = _arrays(T_w_a, T_w_b)
    x, y = second[..., 0] - first[..., 0], second[..., 1] - first[..., 1]
    cos, sin = np.cos(first[..., 2]), np.sin(first[..., 2])
    return _stack(cos * x + sin * y, cos * y - sin * x, wrap_angle(second[..., 2] - first[..., 2]))


def apply(T_a_b: ArrayLike, points_b: ArrayLike) -> FloatArray:
    """Transform points `[..., 2]` from frame b to frame a; the batch shapes of transform and points broadcast."""
    transform = np.asarray(T_a_b, dtype=np.float64)
    points = np.asarray(points_b, dtype=np.float64)
    x, y = _transform(transform, points[..., 0], points[..., 1])
    return np.stack([x, y], axis=-1)


def exp(xi: ArrayLike) -> FloatArray:
    """Return the exponential of a twist: the motion along constant `xi` for one unit, with the heading in (-pi, pi]."""
    x, y, omega = _parts(xi)
    along, across = _sin_over(omega), _one_minus_cos_over(omega)
    return _stack(along * x - across * y, across * x + along * y, wrap_angle(omega))


def log(T_a_b: ArrayLike) -> FloatArray:
    """Return the logarithm: the twist `xi` with exp(xi) = T_a_b and the turn in (-pi, pi]."""
    x, y, theta = _parts(T_a_b)
    omega = wrap_angle(theta)
    half, cotangent = 0.5 * omega, _half_angle_cotangent(omega)
    return _stack(cotangent * x + half * y, cotangent * y - half * x, omega)


def adjoint(T_a_b: ArrayLike) -> FloatArray:
    """Return matrices `[..., 3, 3]` with T o exp(xi) = exp(adjoint(T) xi) o T."""
    x, y, theta = _parts(T_a_b)
    cos, sin = np.cos(theta), np.sin(theta)
    return _affine(cos, -sin, y, sin, cos, -x)


def right_jacobian(xi: ArrayLike) -> FloatArray:
    """Return matrices `[..., 3, 3]` with exp(xi + d) = exp(xi) o exp(right_jacobian(xi) d) to first order."""
    x, y, omega = _parts(xi)
    along, across = _sin_over(omega), _one_minus_cos_over(omega)
    odd, even = _rest_of_sin_over_square(omega), one_minus_cos_over_square(omega)
    return _affine(along, across, odd * x - even * y, -across, along, even * x + odd * y)


def right_jacobian_inverse(xi: ArrayLike) -> FloatArray:
    """Return matrices J(xi) `[..., 3, 3]` with log(T o exp(d)) = log(T) + J(log(T)) d to first order.

    The inverse exists for turns below a full circle; `log` returns at most half of one.
    """
    x, y, omega = _parts(xi)
    half, cotangent = 0.5 * omega, _half_angle_cotangent(omega)
    odd, even = _rest_of_sin_over_square(omega), one_minus_cos_over_square(omega)
    moved_x, moved_y = odd * x - even * y, even * x + odd * y
    return _affine(
        cotangent, -half, half * moved_y - cotangent * moved_x, half, cotangent, -half * moved_x - cotangent * moved_y
    )


def right_tangent_from_coordinates(T_a_b: ArrayLike) -> FloatArray:
    """Return matrices `[..., 3, 3]` that map a small change of the coordinates (x, y, theta) of T to d in T o exp(d).

    The rows (x, y) are R(theta)^T. Multiply a Jacobian of the coordinates by it from the left.
    """
    theta = np.asarray(T_a_b, dtype=np.float64)[..., 2]
    cos, sin, zero = np.cos(theta), np.sin(theta), np.zeros_like(theta)
    return _affine(cos, sin, zero, -sin, cos, zero)


def interpolate(T_w_a: ArrayLike, T_w_b: ArrayLike, fraction: ArrayLike) -> FloatArray:
    """Return the transforms at `fraction` `[...]` between a (0) and b (1), on the arc of constant twist."""
    share = np.asarray(fraction, dtype=np.float64)[..., np.newaxis]
    return compose(T_w_a, exp(share * log(between(T_w_a, T_w_b))))


def _parts(transform: ArrayLike) -> tuple[FloatArray, FloatArray, FloatArray]:
    array = np.asarray(transform, dtype=np.float64)
    return array[..., 0], array[..., 1], array[..., 2]


def _arrays(first: ArrayLike, second: ArrayLike) -> tuple[FloatArray, FloatArray]:
    return np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)


def _stack(x: FloatArray, y: FloatArray, theta: FloatArray) -> FloatArray:
    out = np.empty((*np.broadcast_shapes(x.shape, y.shape, theta.shape), 3))
    out[..., 0], out[..., 1], out[..., 2] = x, y, theta
    return out


def _affine(
    xx: FloatArray, xy: FloatArray, xt: FloatArray, yx: FloatArray, yy: FloatArray, yt: FloatArray
) -> FloatArray:
    """Return matrices with the two given rows above (0, 0, 1)."""
    out = np.zeros((*np.broadcast_shapes(xx.shape, xt.shape), 3, 3))
    out[..., 0, 0], out[..., 0, 1], out[..., 0, 2] = xx, xy, xt
    out[..., 1, 0], out[..., 1, 1], out[..., 1, 2] = yx, yy, yt
    out[..., 2, 2] = 1.0
    return out


def _transform(transform: FloatArray, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    cos, sin = np.cos(transform[..., 2]), np.sin(transform[..., 2])
    return transform[..., 0] + cos * x - sin * y, transform[..., 1] + sin * x + cos * y


def _sin_over(omega: FloatArray) -> FloatArray:
    """Return sin(w) / w."""
    return np.sinc(omega / np.pi)


def one_minus_cos_over_square(omega: FloatArray) -> FloatArray:
    """Return (1 - cos w) / w^2, computed with the half angle to avoid cancellation."""
    return 0.5 * np.sinc(omega / (2.0 * np.pi)) ** 2


def _one_minus_cos_over(omega: FloatArray) -> FloatArray:
    """Return (1 - cos w) / w."""
    return omega * one_minus_cos_over_square(omega)


def _half_angle_cotangent(omega: FloatArray) -> FloatArray:
    """Return (w/2) cot(w/2)."""
    return np.cos(0.5 * omega) / np.sinc(omega / (2.0 * np.pi))


def _rest_of_sin_over_square(omega: FloatArray) -> FloatArray:
    """Return (w - sin w) / w^2."""
    square = omega * omega
    series = omega / 6 * (1 - square / 20 * (1 - square / 42 * (1 - square / 72 * (1 - square / 110))))
    small = np.abs(omega) < _SERIES_BELOW_RAD
    safe = np.where(small, 1.0, omega)
    return np.where(small, series, (safe - np.sin(safe)) / (safe * safe))


def chain_motions(motions: FloatArray, start: FloatArray) -> FloatArray:
    """Return poses (N+1, 3): `start` (3,) and those after each of N successive motions (N, 3)."""
    theta = start[2] + np.concatenate([[0.0], np.cumsum(motions[:, 2])])
    cos, sin = np.cos(theta[:-1]), np.sin(theta[:-1])
    x = start[0] + np.concatenate([[0.0], np.cumsum(cos * motions[:, 0] - sin * motions[:, 1])])
    y = start[1] + np.concatenate([[0.0], np.cumsum(sin * motions[:, 0] + cos * motions[:, 1])])
    return np.stack([x, y, wrap_angle(theta)], axis=-1)


def fit_transform(a: FloatArray, b: FloatArray, weights: FloatArray | None = None) -> FloatArray:
    """Return T_a_b (3,) that maps points b (n, 2) onto a (n, 2) in least squares, without scale.

    Args:
        a: points.
        b: the same points in another frame.
        weights: (n,) of their squared distances; None: all equal.

    Source: Umeyama, "Least-squares estimation of transformation parameters between two point patterns" (1991), in the
    plane.
    """
    centre_a, centre_b = np.average(a, axis=0, weights=weights), np.average(b, axis=0, weights=weights)
    from_a, from_b = a - centre_a, b - centre_b
    weighted = from_b if weights is None else weights[:, None] * from_b
    dot = (from_a * weighted).sum()
    cross = (weighted[:, 0] * from_a[:, 1] - weighted[:, 1] * from_a[:, 0]).sum()
    turn = np.array([0.0, 0.0, np.arctan2(cross, dot)])
    translation = centre_a - apply(turn, centre_b)
    return np.array([translation[0], translation[1], turn[2]])
