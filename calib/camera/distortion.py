"""Lens distortion in normalised image coordinates, as OpenCV and ROS define it.

Every model here is a radial factor g(s), s = x^2 + y^2, plus plumb_bob's two tangential terms:
distorted = g(s) (x, y) + (2 p1 x y + p2 (s + 2 x^2), p1 (s + 2 y^2) + 2 p2 x y).

- plumb_bob (k1, k2, p1, p2, k3): g = 1 + k1 s + k2 s^2 + k3 s^3
- rational_polynomial (k1, k2, p1, p2, k3, k4, k5, k6): g = (1 + k1 s + k2 s^2 + k3 s^3) / (1 + k4 s + k5 s^2 + k6 s^3)
- equidistant (k1, k2, k3, k4): g = t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8) / tan(t), t = atan(sqrt(s))

Far outside the picture the polynomial r g(r^2) reaches a maximum and decreases; points beyond that radius would be
projected into the picture again. `Distortion.limit` is that radius, and points beyond it are not projected.

Fits of rational_polynomial often have a root of the denominator inside the picture that a root of the numerator nearly
cancels. Outside of a narrow ring at that radius the lens is regular, so this root is no limit. Points in the
ring where the image folds are not projected.
Sources: OpenCV, calib3d and fisheye module documentation; ROS sensor_msgs/distortion_models.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
from numpy.polynomial.polynomial import polyfromroots, polyroots, polyval

from groundsbot.calib.foundation import BoolArray, FloatArray

COEFFICIENTS: Final = {"plumb_bob": 5, "rational_polynomial": 8, "equidistant": 4}

_WIDEST_RAD: Final = np.radians(89.0)  # largest angle from the optical axis; z > 0 in any case
_NEWTON_STEPS: Final = 60  # enough for bisection alone to converge to the last bit
_POLISH_STEPS: Final = 12
_POLISHED: Final = 1e-9  # the error of a Newton step is about its square
_RESIDUAL: Final = 1e-12  # normalised: 1e-9 px at a focal length of 1000 px
_CANCELLED: Final = 0.03  # relative distance of a root of the numerator from the root of the denominator it cancels


@dataclass(frozen=True)
class Distortion:
    """Distortion of a lens. Coordinates are `[..., 2]` (x/z, y/z) in the optical frame.

    Attributes:
        numerator: coefficients, constant first, of a polynomial of s, or of t^2 for equidistant.
        denominator: likewise; `[1]` for plumb_bob and equidistant.
        p1: tangential coefficient.
        p2: tangential coefficient.
        is_equidistant: the radial factor is that of equidistant.
        limit: undistorted radius from which on there is no image.
        distorted_limit: distorted radius of `limit`; infinite at a root of the denominator.
        starts: where roots nearly cancel, lenses whose inverses are initial values of this one's: the lens without
            these roots, then the lens up to the first of them. Empty otherwise.
    """

    numerator: FloatArray
    denominator: FloatArray
    p1: float
    p2: float
    is_equidistant: bool
    limit: float
    distorted_limit: float
    starts: "tuple[Distortion, ...]" = ()

    @classmethod
    def of(cls, model: str, coefficients: tuple[float, ...]) -> "Distortion":
        """Return the lens of a model in `COEFFICIENTS`, with coefficients in OpenCV's order."""
        if model == "equidistant":
            # The distorted angle t (1 + k1 t^2 + ...) must increase: d/dt = N + 2 u N' with u = t^2.
            numerator, denominator = np.array([1.0, *coefficients]), np.ones(1)
            angle = np.sqrt(_first_positive_root(_growth(numerator, denominator), float(_WIDEST_RAD) ** 2))
            distorted = float(angle * polyval(angle * angle, numerator))
            return cls(numerator, denominator, 0.0, 0.0, True, float(np.tan(angle)), distorted)
        k1, k2, p1, p2, k3, *below = coefficients
        numerator, denominator = np.array([1.0, k1, k2, k3]), np.array([1.0, *below])
        without = _without_cancelled_roots(numerator, denominator)
        regular = None if without is None else cls._with_limit(*without, p1, p2)
        whole = cls._with_limit(numerator, denominator, p1, p2)
        if regular is None or whole.limit >= regular.limit:
            return whole
        return replace(whole, limit=regular.limit, distorted_limit=regular.distorted_limit, starts=(regular, whole))

    @classmethod
    def _with_limit(cls, numerator: FloatArray, denominator: FloatArray, p1: float, p2: float) -> "Distortion":
        widest = float(np.tan(_WIDEST_RAD)) ** 2
        fold = _first_positive_root(_growth(numerator, denominator), widest)
        pole = _first_positive_root(denominator, fold)
        limit = float(np.sqrt(pole))
        if pole < fold:  # the factor grows beyond all bounds; its value at the rounded root may have either sign
            return cls(numerator, denominator, p1, p2, False, limit, np.inf)
        factor = float(polyval(fold, numerator) / polyval(fold, denominator))
        return cls(numerator, denominator, p1, p2, False, limit, factor * limit)

    @cached_property
    def _numerator_slope(self) -> FloatArray:
        return _slope(self.numerator)

    @cached_property
    def _denominator_slope(self) -> FloatArray:
        return _slope(self.denominator)

    def apply(self, undistorted: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return distorted points `[..., 2]` and their derivatives `[..., 2, 2]`; NaN beyond `limit`."""
        return self._apply(np.where(self._is_imaged(undistorted)[..., np.newaxis], undistorted, np.nan))

    def _is_imaged(self, undistorted: FloatArray) -> BoolArray:
        inside: BoolArray = np.hypot(undistorted[..., 0], undistorted[..., 1]) < self.limit
        if not self.starts:
            return inside
        square = (undistorted**2).sum(axis=-1)
        with np.errstate(all="ignore"):
            factor, slope = self._factor(square)
            return np.asarray(inside & (factor > 0.0) & (factor + 2.0 * square * slope > 0.0))

    def _apply(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        x, y = points[..., 0], points[..., 1]
        square, p1, p2 = x * x + y * y, self.p1, self.p2
        factor, slope = self._factor(square)

        distorted = np.empty(points.shape)
        distorted[..., 0] = factor * x + 2 * p1 * x * y + p2 * (square + 2 * x * x)
        distorted[..., 1] = factor * y + p1 * (square + 2 * y * y) + 2 * p2 * x * y

        jacobian = np.empty((*points.shape, 2))
        jacobian[..., 0, 0] = factor + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
        jacobian[..., 0, 1] = jacobian[..., 1, 0] = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
        jacobian[..., 1, 1] = factor + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x
        return distorted, jacobian

    def remove(self, distorted: FloatArray) -> FloatArray:
        """Return undistorted points `[..., 2]` whose images are `distorted` to 1e-12; NaN where none exists."""
        with np.errstate(all="ignore"):  # iterations without a solution may diverge; they are rejected below
            points, found = np.full_like(distorted, np.nan), np.zeros(distorted.shape[:-1], dtype=np.bool_)
            for start in self.starts or (self,):
                again, found_again = self._polish(start._invert_radial(distorted), distorted)
                points, found = np.where(found[..., np.newaxis], points, again), found | found_again
        return np.where(found[..., np.newaxis], points, np.nan)

    def _polish(self, points: FloatArray, distorted: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Return points improved by Newton's method, and whether their images are `distorted`."""
        if self.p1 or self.p2 or self.starts:
            for _ in range(_POLISH_STEPS):
                image, jacobian = self._apply(points)
                step = _solve_pairs(jacobian, image - distorted)
                points = points - step
                if not np.any(np.abs(step) > _POLISHED):
                    break
        error = np.abs(self._apply(points)[0] - distorted).max(axis=-1, initial=0.0)
        scale = 1.0 + np.abs(distorted).max(axis=-1, initial=0.0)
        return points, np.asarray((error < _RESIDUAL * scale) & self._is_imaged(points))

    def _invert_radial(self, distorted: FloatArray) -> FloatArray:
        """Return points `[..., 2]` that solve the radial part: Newton's method on r g(r^2), safeguarded by bisection.

        The result is exact without tangential terms, and the initial value with them.
        """
        target = np.minimum(np.hypot(distorted[..., 0], distorted[..., 1]), self.distorted_limit)
        low, high = np.zeros_like(target), np.full_like(target, self.limit)
        radius = np.minimum(target, 0.5 * self.limit)
        for _ in range(_NEWTON_STEPS):
            square = radius * radius
            factor, slope = self._factor(square)
            excess = radius * factor - target
            low, high = np.where(excess < 0, radius, low), np.where(excess < 0, high, radius)
            growth = factor + 2 * square * slope
            step = np.divide(excess, growth, out=np.full_like(excess, np.inf), where=growth > 0)
            inside = (radius - step >= low) & (radius - step <= high)
            following = np.where(inside, radius - step, 0.5 * (low + high))
            converged: BoolArray = np.abs(following - radius) <= 1e-15 * (1.0 + radius)
            radius = following
            if np.all(converged | np.isnan(target)):
                break
        length = np.hypot(distorted[..., 0], distorted[..., 1])
        ratio = np.divide(radius, length, out=np.ones_like(length), where=length > 0)
        return distorted * ratio[..., np.newaxis]

    def _factor(self, square: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return g(s) and dg/ds."""
        if self.is_equidistant:
            return self._equidistant_factor(square)
        below = polyval(square, self.denominator)
        factor = polyval(square, self.numerator) / below
        slope = polyval(square, self._numerator_slope) - factor * polyval(square, self._denominator_slope)
        return factor, slope / below

    def _equidistant_factor(self, square: FloatArray) -> tuple[FloatArray, FloatArray]:
        radius = np.sqrt(square)
        angle = np.arctan(radius)
        polynomial = polyval(angle * angle, self.numerator)
        near_axis = square < 1e-16
        safe = np.where(near_axis, 1.0, square)
        factor = np.where(near_axis, 1.0, angle * polynomial / np.sqrt(safe))
        angle_slope = polynomial + 2 * angle * angle * polyval(angle * angle, self._numerator_slope)
        slope = (angle_slope / (1.0 + safe) - factor) / (2.0 * safe)
        # Near the axis t = r - r^3/3, so g = 1 + (k1 - 1/3) s.
        return factor, np.where(near_axis, self.numerator[1] - 1.0 / 3.0, slope)


def _slope(polynomial: FloatArray) -> FloatArray:
    """Return the coefficients of the derivative."""
    return np.asarray((np.arange(len(polynomial)) * polynomial)[1:] if len(polynomial) > 1 else np.zeros(1))


def _growth(numerator: FloatArray, denominator: FloatArray) -> FloatArray:
    """Return (N + 2 s N') D - N 2 s D', a polynomial of s = r^2 with the sign of d/dr of r N(r^2) / D(r^2)."""
    doubled = 2.0 * np.arange(max(len(numerator), len(denominator)))
    grown = np.convolve((1.0 + doubled[: len(numerator)]) * numerator, denominator)
    return np.asarray(grown - np.convolve(numerator, doubled[: len(denominator)] * denominator))


def _first_positive_root(polynomial: FloatArray, bound: float) -> float:
    """Return the smallest root in (0, bound), or `bound` if there is none."""
    trimmed = np.trim_zeros(polynomial, "b")
    if len(trimmed) < 2:
        return bound
    roots = polyroots(trimmed)
    real = roots.real[(np.abs(roots.imag) < 1e-9 * (1.0 + np.abs(roots.real))) & (roots.real > 0)]
    return float(min(real.min(initial=bound), bound))


def _without_cancelled_roots(numerator: FloatArray, denominator: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    """Return both polynomials without the positive roots of the denominator that the numerator nearly cancels.

    None if there is no such root.
    """
    above, below = (polyroots(np.trim_zeros(each, "b")) for each in (numerator, denominator))
    for pole in below[(below.imag == 0.0) & (below.real > 0.0)]:
        near = np.nonzero((above.imag == 0.0) & (np.abs(above - pole) < _CANCELLED * pole.real))[0]
        if len(near):
            above, below = np.delete(above, near[0]), np.delete(below, np.nonzero(below == pole)[0][0])
    if len(below) == len(np.trim_zeros(denominator, "b")) - 1:
        return None
    # Both are 1 at 0, as before.
    of_roots = [np.asarray(polyfromroots(each).real) for each in (above, below)]
    return of_roots[0] / of_roots[0][0], of_roots[1] / of_roots[1][0]


def _solve_pairs(matrices: FloatArray, right: FloatArray) -> FloatArray:
    """Return solutions of `[..., 2, 2]` systems, not finite where singular; LAPACK would raise for the whole batch."""
    a, b, c, d = matrices[..., 0, 0], matrices[..., 0, 1], matrices[..., 1, 0], matrices[..., 1, 1]
    determinant = a * d - b * c
    x = (d * right[..., 0] - b * right[..., 1]) / determinant
    y = (a * right[..., 1] - c * right[..., 0]) / determinant
    return np.stack([x, y], axis=-1)
