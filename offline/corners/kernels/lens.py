"""Compiled lens models: distortion and its derivative."""

from functools import lru_cache
from typing import Final

import numpy as np

from groundsbot.calib.camera import CameraModel, Distortion
from groundsbot.calib.foundation import FloatArray
from groundsbot.offline.foundation import inner

_N_NUMERATOR: Final = 5
_N_DENOMINATOR: Final = 4
# Positions in a row of `lenses_of`.
CENTRE, _TANGENTIAL, _LIMIT, _IS_EQUIDISTANT, _NUMERATOR, _DENOMINATOR = 2, 4, 6, 7, 8, 8 + _N_NUMERATOR
_NEAR_AXIS: Final = 1e-16


@lru_cache(maxsize=16)
def lenses_of(cameras: tuple[CameraModel, ...]) -> FloatArray:
    """Return (C, 17): focal lengths, centre, p1, p2, limit, whether equidistant, numerator (5), denominator (4)."""
    rows = np.zeros((len(cameras), _DENOMINATOR + _N_DENOMINATOR))
    for row, camera in zip(rows, cameras, strict=True):
        lens = Distortion.of(camera.distortion_model, camera.distortion)
        row[:_NUMERATOR] = (
            camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px, lens.p1, lens.p2, lens.limit, lens.is_equidistant,
        )  # fmt: skip
        row[_NUMERATOR : _NUMERATOR + len(lens.numerator)] = lens.numerator
        row[_DENOMINATOR : _DENOMINATOR + len(lens.denominator)] = lens.denominator
    return rows


@inner
def distort(lens: FloatArray, x: float, y: float, z: float) -> tuple[float, float, float, float, float, float, float]:
    """Return the distorted normalised coordinates of a point in the optical frame, as `Distortion.apply`.

    Returns:
        Distorted (u, v), the derivatives du/dx, du/dy = dv/dx and dv/dy, and undistorted (x, y) = (X, Y) / Z. All are
        NaN for a point behind the camera or outside the image circle.
    """
    if not z > 0.0:
        return np.nan, np.nan, np.nan, np.nan, np.nan, np.nan, np.nan
    inverse = 1.0 / z
    x, y = x * inverse, y * inverse
    square = x * x + y * y
    if not square < lens[_LIMIT] * lens[_LIMIT]:
        return np.nan, np.nan, np.nan, np.nan, np.nan, np.nan, np.nan
    factor, slope = _factor(lens, square)
    p1, p2 = lens[_TANGENTIAL], lens[_TANGENTIAL + 1]
    return (
        factor * x + 2.0 * p1 * x * y + p2 * (square + 2.0 * x * x),
        factor * y + p1 * (square + 2.0 * y * y) + 2.0 * p2 * x * y,
        factor + 2.0 * x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x,
        2.0 * x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y,
        factor + 2.0 * y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x,
        x,
        y,
    )


@inner
def _factor(lens: FloatArray, square: float) -> tuple[float, float]:
    """Return g(s) and dg/ds, as `Distortion._factor`."""
    if lens[_IS_EQUIDISTANT] == 0.0:
        above, above_slope = _polynomial(lens, _NUMERATOR, _N_NUMERATOR, square)
        below, below_slope = _polynomial(lens, _DENOMINATOR, _N_DENOMINATOR, square)
        inverse = 1.0 / below
        factor = above * inverse
        return factor, (above_slope - factor * below_slope) * inverse
    if square < _NEAR_AXIS:
        return 1.0, lens[_NUMERATOR + 1] - 1.0 / 3.0
    radius = np.sqrt(square)
    angle = np.arctan(radius)
    value, by_square = _polynomial(lens, _NUMERATOR, _N_NUMERATOR, angle * angle)
    factor = angle * value / radius
    return factor, ((value + 2.0 * angle * angle * by_square) / (1.0 + square) - factor) / (2.0 * square)


@inner
def _polynomial(lens: FloatArray, first: int, count: int, at: float) -> tuple[float, float]:
    """Return value and derivative; the constant comes first. Without slices the compiler unrolls the loop."""
    value, slope = 0.0, 0.0
    for i in range(first + count - 1, first - 1, -1):
        slope = slope * at + value
        value = value * at + lens[i]
    return value, slope
