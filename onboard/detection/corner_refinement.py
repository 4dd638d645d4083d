"""Refinement of tag corners: each side of the black border is fitted to the grey levels around it.

Across a side the grey level is modelled as a blurred step, a + h erf(d / (sqrt(2) s)), where d is the distance of a
pixel from the side. Along the side it changes linearly, by the same relative amount for white and black. Lamps and
vignetting cause such a gradient, and without it in the model the side would appear rotated. The side is straight in the
world and has the bend of the lens distortion in the picture. Its position is given by its distance from the detector's
line at both ends. These two distances, a, h, s and the relative gradient are fitted to the pixels along the side by
Gauss-Newton, for all sides of a picture together. The corners are the intersections of neighbouring sides.

Pixels are used up to one cell from the border, because a tag has a white margin of one cell, except where the next cell
blurs into it, and except near the corners, where another side is near. A tag keeps the detector's corners if one of its
sides does not fit this model because it is hidden, outside the picture or at the edge of a shadow.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from groundsbot.calib.camera import CameraModel
from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray, erf

_ALONG: Final = 20  # pixels along a side
_ACROSS: Final = 4  # pixels on both sides of it, at most
_ROUNDS: Final = 6
_ARRIVED_PX: Final = 2e-3
_LONGEST_STEP: Final = 0.5  # in px, in the logarithm of the blur, and in the relative gradient
# Rows whose products are summed over pixels: the derivatives with respect to the distances at the begin and at the end
# of the side and to the logarithm of the blur, each without a factor that all pixels of a side have in common; the
# derivatives with respect to the relative gradient, to a and to h; and the grey level.
_BEGIN, _END, _BLUR, _SHADE, _ONE, _EDGE, _LIGHT = range(7)
_N: Final = 6  # unknowns
_MIDDLE_GREY: Final = 128.0  # subtracted from grey levels to reduce rounding errors of the sums
# For each corner of a tag: the next one, the previous one, and the two opposite to the side that begins there.
_NEXT: Final = (1, 2, 3, 0)
_BEFORE: Final = (3, 0, 1, 2)
_OPPOSITE: Final = ((2, 3), (3, 0), (0, 1), (1, 2))
_FIRST_BLUR_PX: Final = 0.7
_LOG_BLUR: Final = (np.log(0.2), np.log(3.0))  # limits, blur in px
# Distance kept from the end of a cell, where the next cell blurs into it; and the same for small tags.
_CLEAR_PX: Final = 2.0
_LEAST_CLEAR_PX: Final = 0.3
_LEAST_BAND_PX: Final = 1.2
_ENOUGH_BAND_PX: Final = 2.0
_CLEAR_OF_CORNER_PX: Final = 2.0
_FARTHEST_PX: Final = 1.5  # largest distance of a side from the detector's
_LEAST_CONTRAST: Final = 10.0  # grey levels, twice h
# RMS of the residuals over the contrast. Sensor noise gives 0.02 at an edge; beyond the limit the picture shows more
# than an edge.
_ROUGHEST: Final = 0.1
# Prior sigma of the relative gradient per pixel of a side, for pixels with this noise in grey levels. Lenses and lamps
# stay within it. Short sides cannot distinguish the gradient from a rotation.
_SHADE_PER_PX: Final = 1e-3
_NOISE_GREY: Final = 4.0
_LEAST_PIXELS: Final = 30  # five per parameter
# Distance assigned to array elements without a pixel; there the derivative with respect to the blur is 0 and erf is 1.
_NOWHERE_PX: Final = 1e3
_NOT_FOUND_PX: Final = 1e9  # for sides that do not intersect


def refine_corners(
    grey: NDArray[np.uint8], corners_px: FloatArray, cells: IntArray, camera: CameraModel | None = None
) -> tuple[FloatArray, BoolArray]:
    """Refine the corners of T detected tags.

    Args:
        grey: the picture (height, width).
        corners_px: (T, 4, 2) as detected, pixel centres at whole numbers, in order around each tag.
        cells: (T,) number of cells along a side of each tag, including the black border.
        camera: camera of the picture; without it sides are assumed to be straight in the picture.

    Returns:
        Corners (T, 4, 2), and (T,) whether they are refined; the others are unchanged.
    """
    if not len(corners_px):
        return corners_px, np.zeros(0, dtype=np.bool_)
    sides = _Sides(grey, corners_px, cells, camera)
    moved, good = sides.fit()
    found = sides.corners(moved)
    good &= np.linalg.norm(found - corners_px, axis=-1).max(axis=-1) < 2.0 * _FARTHEST_PX
    return np.where(good[:, None, None], found, corners_px), good


def _sagitta(corners_px: FloatArray, across: FloatArray, camera: CameraModel) -> FloatArray:
    """Return (S,) the distance of the middle of each side from its chord, along `across` (S, 2), due to distortion."""
    rays = camera.unproject(corners_px)
    flat = rays / rays[..., 2:]
    middle = camera.project(0.5 * (flat + flat[:, _NEXT])).reshape(-1, 2)
    chord = 0.5 * (corners_px + corners_px[:, _NEXT]).reshape(-1, 2)
    bend = ((middle - chord) * across).sum(axis=-1)
    return np.where(np.isfinite(bend), bend, 0.0)


def _band_px(cell_px: FloatArray) -> FloatArray:
    """Return (S,) the distance from a side up to which pixels are used, from the width (S,) of a cell across it."""
    enough = np.minimum(cell_px - _LEAST_CLEAR_PX, _ENOUGH_BAND_PX)
    return np.minimum(np.maximum(np.maximum(cell_px - _CLEAR_PX, enough), _LEAST_BAND_PX), _ACROSS)


class _Sides:
    """Pixels around the four sides of T tags: S = 4 T sides with at most P pixels each."""

    def __init__(
        self, grey: NDArray[np.uint8], corners_px: FloatArray, cells: IntArray, camera: CameraModel | None
    ) -> None:
        self._begin = corners_px.reshape(-1, 2)
        self._along = corners_px[:, _NEXT].reshape(-1, 2) - self._begin
        self._length = np.maximum(np.hypot(self._along[:, 0], self._along[:, 1]), 1e-9)
        self._across = self._along[:, ::-1] * (-1.0, 1.0) / self._length[:, None]  # normal, rotated from x towards y
        self._sagitta = np.zeros(len(self._begin)) if camera is None else _sagitta(corners_px, self._across, camera)
        self._take(grey, *self._pixels(grey, _band_px(self._depth(corners_px) / np.repeat(cells, 4))))

    def _take(
        self, grey: NDArray[np.uint8], index: IntArray, share: FloatArray, distance: FloatArray, seen: BoolArray
    ) -> None:
        """Store the seen pixels of `_pixels` as (S, P), padded at the end of each row."""
        self._count = seen.sum(axis=1)
        taken = np.arange(self._count.max()) < self._count[:, None]
        pixels = np.flatnonzero(seen)
        self._share, self._distance = np.zeros(taken.shape), np.full(taken.shape, _NOWHERE_PX)
        self._share[taken], self._distance[taken] = share.take(pixels), distance.take(pixels)
        self._rows = np.zeros((len(taken), _N + 1, taken.shape[1]))
        self._rows[:, _ONE] = taken
        self._rows[:, _LIGHT][taken] = grey.take(index.take(pixels)) - _MIDDLE_GREY
        self._off_middle = (self._share - 0.5) * taken
        self._n_nowhere = taken.shape[1] - self._count

    def _depth(self, corners_px: FloatArray) -> FloatArray:
        """Return (S,) the extent of the tag across each side, to the nearer of the two opposite corners."""
        opposite = corners_px[:, _OPPOSITE].reshape(-1, 2, 2)
        across = ((opposite - self._begin[:, None]) * self._across[:, None]).sum(axis=-1)
        return np.asarray(np.abs(across).min(axis=1))

    def _pixels(
        self, grey: NDArray[np.uint8], band_px: FloatArray
    ) -> tuple[IntArray, FloatArray, FloatArray, BoolArray]:
        """Return the pixels around the sides, each pixel at most once: Q candidates per side.

        For a side that is closer to a row than to a column, pixels nearest to it are taken in several columns, and vice
        versa. The first coordinate is therefore the one along which the side is longer: x or y.

        Args:
            grey: the picture.
            band_px: (S,) largest distance of a pixel from the side.

        Returns:
            Four arrays (S, Q): index in the flattened picture, share of the side's length, distance from the side, and
            whether a pixel is used: near the side, not near its ends, and in the picture.
        """
        along_rows = np.abs(self._along[:, :1]) > np.abs(self._along[:, 1:])
        begin, along, across = (
            np.where(along_rows, each, each[:, ::-1]) for each in (self._begin, self._along, self._across)
        )
        height, width = grey.shape
        size = np.where(along_rows, (width, height), (height, width))
        stride = np.where(along_rows, (1, width), (width, 1))
        share = (np.arange(_ALONG) + 0.5) / _ALONG
        bend = 4.0 * self._sagitta[:, None] * share * (1.0 - share)
        line, middle = (
            np.rint(begin[:, k, None] + share * along[:, k, None] + bend * across[:, k, None]) for k in (0, 1)
        )  # (S, A)
        # Measured along rows or columns the band of an oblique side is wider.
        slant = np.abs(along[:, 0]) / self._length
        reach = int(np.ceil(band_px.max() / slant.min()))
        offsets = np.arange(-reach, reach + 1.0)  # (O,)
        first = (line >= 0) & (line < size[:, :1])
        first[:, 1:] &= np.diff(line, axis=1) != 0
        seen = (offsets >= -middle[..., None]) & (offsets < (size[:, 1:] - middle)[..., None]) & first[..., None]
        index = line * stride[:, :1] + middle * stride[:, 1:]

        def sum_over(over_line: FloatArray, by_offset: FloatArray) -> FloatArray:
            """Return (S, Q) values that are `over_line` (S, A) plus `by_offset` (S,) times the offsets (O,)."""
            return (over_line[..., None] + (by_offset[:, None] * offsets)[:, None]).reshape(len(line), -1)

        off = line - begin[:, :1], middle - begin[:, 1:]
        along /= self._length[:, None] ** 2
        share = sum_over(off[0] * along[:, :1] + off[1] * along[:, 1:], along[:, 1])
        distance = sum_over(off[0] * across[:, :1] + off[1] * across[:, 1:], across[:, 1])
        distance -= (4.0 * self._sagitta)[:, None] * (share - share**2)
        clear = np.minimum(_CLEAR_OF_CORNER_PX / self._length, 0.25)[:, None]
        seen = seen.reshape(distance.shape)
        seen &= (np.abs(distance) < band_px[:, None]) & (clear < share) & (share < 1.0 - clear)
        return sum_over(index, stride[:, 1]).astype(np.int64), share, distance, seen

    def fit(self) -> tuple[FloatArray, BoolArray]:
        """Return distances (S, 2) of each side from the detector's at both ends, and (T,) tags with four good sides."""
        # Distances at the begin and at the end of the side, logarithm of s, and relative gradient along it.
        p = np.zeros((len(self._begin), 4))
        p[:, _BLUR] = np.log(_FIRST_BLUR_PX)
        stiffness = (_NOISE_GREY / (_SHADE_PER_PX * self._length)) ** 2
        fit: _Fit | None = None
        rounds = 0
        while True:
            rounds += 1
            rate = np.exp(-p[:, _BLUR]) / np.sqrt(2.0)  # 1 / (sqrt(2) s)
            fit = _Fit(self._sums(p, rate, fit), rate, p[:, _SHADE])
            step = fit.step(stiffness)
            p -= step
            p[:, _BLUR] = np.maximum(np.minimum(p[:, _BLUR], _LOG_BLUR[1]), _LOG_BLUR[0])
            # The first round has no gradient, as a and h are unknown.
            if rounds == _ROUNDS or (rounds > 1 and np.abs(step[:, :2]).max() < _ARRIVED_PX):
                break
        return p[:, :2], np.asarray(self._looks_right(p, fit).reshape(-1, 4).all(axis=1))

    def _sums(self, p: FloatArray, rate: FloatArray, before: "_Fit | None") -> FloatArray:
        """Return (S, 7, 7) sums over the pixels of the products of the rows _BEGIN, ..., _LIGHT.

        The derivative with respect to the relative gradient is computed with a and h of the round before.
        """
        scaled = self._distance * rate[:, None]
        scaled -= self._share * ((p[:, 1] - p[:, 0]) * rate)[:, None]
        scaled -= (p[:, 0] * rate)[:, None]
        rows = self._rows
        rows[:, _EDGE] = erf(scaled)
        slope = scaled * scaled
        np.exp(np.negative(slope, out=slope), out=slope)
        np.multiply(slope, self._share, out=rows[:, _END])
        np.subtract(slope, rows[:, _END], out=rows[:, _BEGIN])
        np.multiply(slope, scaled, out=rows[:, _BLUR])
        if before is not None:
            light = np.multiply(rows[:, _EDGE], before.h[:, None], out=rows[:, _SHADE])
            light += (before.a + _MIDDLE_GREY)[:, None]
            light *= self._off_middle
        sums = rows @ rows.swapaxes(-1, -2)
        sums[:, _EDGE, _EDGE] -= self._n_nowhere
        return np.asarray(sums)

    def _looks_right(self, p: FloatArray, fit: "_Fit") -> BoolArray:
        """Return (S,) whether a side fits the model; `fit` is that of the last round, one step before p."""
        rms = np.sqrt(np.maximum(fit.square, 0.0) / np.maximum(self._count, 1.0))
        contrast = 2.0 * np.abs(fit.h)
        one_way = np.repeat(np.abs(np.sign(fit.h).reshape(-1, 4).sum(axis=1)) == 4.0, 4)
        good = (self._count >= _LEAST_PIXELS) & (contrast > _LEAST_CONTRAST) & (rms < _ROUGHEST * contrast) & one_way
        # At the limit, blur and contrast cannot be distinguished because there are too few pixels.
        good &= p[:, _BLUR] < _LOG_BLUR[1] - 1e-6
        return np.asarray(good & (np.abs(p[:, :2]).max(axis=1) < _FARTHEST_PX))

    def corners(self, moved: FloatArray) -> FloatArray:
        """Return (T, 4, 2) the intersections of each side with the one before it, by their tangents there."""
        slope = (moved[:, 1] - moved[:, 0])[:, None] * self._across
        bend = 4.0 * self._sagitta[:, None] * self._across
        begin, end = self._begin + moved[:, :1] * self._across, self._begin + self._along + moved[:, 1:] * self._across
        leaves, arrives = self._along + slope + bend, self._along + slope - bend
        end, arrives = (each.reshape(-1, 4, 2)[:, _BEFORE].reshape(-1, 2) for each in (end, arrives))
        gap = end - begin
        cross = leaves[:, 0] * arrives[:, 1] - leaves[:, 1] * arrives[:, 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            share = (gap[:, 0] * arrives[:, 1] - gap[:, 1] * arrives[:, 0]) / cross
            found = begin + share[:, None] * leaves
        return np.where(np.isfinite(found), found, _NOT_FOUND_PX).reshape(-1, 4, 2)


class _Fit:
    """Linear fit of a and h for S sides, and the next Gauss-Newton step.

    Attributes:
        a: (S,) grey level on the side, relative to the middle grey, by linear least squares.
        h: (S,) half the contrast, by linear least squares.
        square: (S,) sum of the squared residuals.
    """

    def __init__(self, sums: FloatArray, rate: FloatArray, shade: FloatArray) -> None:
        """Fit a and h to the sums of `_Sides`, for given 1 / (sqrt(2) s) (S,) and relative gradient (S,)."""
        n = np.maximum(sums[:, _ONE, _ONE], 1.0)
        even = sums[:, :, _LIGHT] - shade[:, None] * sums[:, :, _SHADE]  # sums with the grey level less its gradient
        mean_edge, mean_light = sums[:, _ONE, _EDGE] / n, even[:, _ONE] / n
        spread = sums[:, _EDGE, _EDGE] - n * mean_edge**2
        self.h = (even[:, _EDGE] - n * mean_edge * mean_light) / np.maximum(spread, 1e-9)
        self.a = mean_light - self.h * mean_edge
        residual = np.zeros((len(sums), _N + 1))  # coefficients of the rows
        residual[:, _ONE], residual[:, _EDGE], residual[:, _LIGHT] = self.a, self.h, -1.0
        residual[:, _SHADE] = shade
        self._sums, self._rate, self._shade = sums, rate, shade
        self._products = (sums @ residual[..., None])[..., 0]  # sums of the residual times each row
        self.square = (self._products * residual).sum(axis=-1)

    def step(self, stiffness: FloatArray) -> FloatArray:
        """Return the Gauss-Newton step (S, 4) in the distances at both ends, log blur and relative gradient.

        The normal equations include a and h. `stiffness` (S,) is the weight of the prior of the gradient.
        """
        factor = np.ones((len(self._sums), _N))  # derivatives are rows times this
        factor[:, _BLUR] = (-2.0 / np.sqrt(np.pi)) * self.h
        factor[:, _BEGIN] = factor[:, _END] = factor[:, _BLUR] * self._rate
        normal = factor[:, :, None] * self._sums[:, :_N, :_N] * factor[:, None]
        diagonal = np.einsum("sii->si", normal)
        diagonal[:, _SHADE] += stiffness
        diagonal += 1e-3 * diagonal + 1e-6
        slope = factor * self._products[:, :_N]
        slope[:, _SHADE] += stiffness * self._shade
        step = np.linalg.solve(normal, slope[..., None])[:, : _SHADE + 1, 0]
        return np.asarray(np.maximum(np.minimum(step, _LONGEST_STEP), -_LONGEST_STEP))
