"""Corners of detected tags, sharpened on the picture: each side of the black border fitted to the light about it.

Across a side the light is taken for a blurred step, a + h erf(d / (sqrt(2) s)), d being a pixel's distance from it;
along the side it grows or wanes evenly, white and black by the same share: lamps, and lenses that darken towards the
picture's edge, light one end better, which would pass for a side that lies askew. The side is straight in the world, so
in the picture it is bent as the lens bends it; where it runs is told by its distance from the detector's line at both
ends. These two, a, h, s and the share by which the light grows are fitted to the pixels along the side (Gauss-Newton,
all sides of a picture at once), and corners are where neighbouring sides meet.

Pixels count within a cell of the border, since a white margin of one cell surrounds a tag, but not where the blur of
the next cell's light is, and clear of the corners, where another side is near. A tag one of whose sides does not look
like this (hidden, out of the picture, in a shadow's edge) keeps the detector's corners.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from groundsbot.calib.camera import CameraModel
from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray

_ALONG: Final = 20  # pixels along a side
_ACROSS: Final = 4  # pixels to both of its sides
_ROUNDS: Final = 6
_ARRIVED_PX: Final = 2e-3
_LONGEST_STEP: Final = 0.5  # px, of the blur's logarithm, and of the share by which the light grows
# What is summed over pixels: the derivatives by the distance at the side's begin, at its end and by the blur's
# logarithm, each over a factor that a side's pixels have in common; those by the share by which the light grows along
# the side, by a and by h; and the light.
_BEGIN, _END, _BLUR, _SHADE, _ONE, _EDGE, _LIGHT = range(7)
_N: Final = 6  # unknowns
_MIDDLE_GREY: Final = 128.0  # about as much light above it as below: sums lose fewer digits
# Of a tag's corners, the one that follows each, and the two opposite the side that begins there.
_NEXT: Final = (1, 2, 3, 0)
_BEFORE: Final = (3, 0, 1, 2)
_OPPOSITE: Final = ((2, 3), (3, 0), (0, 1), (1, 2))
_FIRST_BLUR_PX: Final = 0.7
_LOG_BLUR: Final = (np.log(0.2), np.log(3.0))  # of px
# Before a cell is over: where the blur of the next one's light comes in; and for small tags, that need all of a cell.
_CLEAR_PX: Final = 2.0
_LEAST_CLEAR_PX: Final = 0.3
_LEAST_BAND_PX: Final = 1.2
_ENOUGH_BAND_PX: Final = 2.0
_CLEAR_OF_CORNER_PX: Final = 2.0
_FARTHEST_PX: Final = 1.5  # that a side may lie from where the detector saw it
_LEAST_CONTRAST: Final = 10.0  # grey levels: twice h
# Residuals' RMS over the contrast, 0.02 for an edge under a sensor's noise: beyond, something else is there too.
_ROUGHEST: Final = 0.1
# Sigma of the share by which the light grows, for each pixel of a side, against pixels that err by so many grey levels:
# lenses and lamps stay within it, and short sides do not tell it from a slope.
_SHADE_PER_PX: Final = 1e-3
_NOISE_GREY: Final = 4.0
_LEAST_PIXELS: Final = 30  # five for each parameter
# How far from its side an array's place is taken for that holds no pixel: there the blur's slope is 0, and erf 1.
_NOWHERE_PX: Final = 1e3
_NOT_FOUND_PX: Final = 1e9  # where sides do not meet


def refine_corners(
    grey: NDArray[np.uint8], corners_px: FloatArray, cells: IntArray, camera: CameraModel | None = None
) -> tuple[FloatArray, BoolArray]:
    """Sharper corners.

    Args:
        grey: the picture (height, width).
        corners_px: (T, 4, 2) as detected, pixel centres at whole numbers, in order around each tag.
        cells: (T,) how many cells a side of each tag's black border has.
        camera: whose picture it is; None: sides are taken for straight in it.

    Returns:
        (T, 4, 2) corners, and (T,) whether they are refined or else as they were.
    """
    if not len(corners_px):
        return corners_px, np.zeros(0, dtype=np.bool_)
    sides = _Sides(grey, corners_px, cells, camera)
    moved, good = sides.fit()
    found = sides.corners(moved)
    good &= np.linalg.norm(found - corners_px, axis=-1).max(axis=-1) < 2.0 * _FARTHEST_PX
    return np.where(good[:, None, None], found, corners_px), good


def _sagitta(corners_px: FloatArray, across: FloatArray, camera: CameraModel) -> FloatArray:
    """(S,) how far the lens bends the middle of each side off its chord, along `across` (S, 2)."""
    rays = camera.unproject(corners_px)
    flat = rays / rays[..., 2:]
    middle = camera.project(0.5 * (flat + flat[:, _NEXT])).reshape(-1, 2)
    chord = 0.5 * (corners_px + corners_px[:, _NEXT]).reshape(-1, 2)
    bend = ((middle - chord) * across).sum(axis=-1)
    return np.where(np.isfinite(bend), bend, 0.0)


def _band_px(cell_px: FloatArray) -> FloatArray:
    """(S,) how far from a side pixels count, by how wide a cell is across it."""
    enough = np.minimum(cell_px - _LEAST_CLEAR_PX, _ENOUGH_BAND_PX)
    return np.minimum(np.maximum(np.maximum(cell_px - _CLEAR_PX, enough), _LEAST_BAND_PX), _ACROSS)


class _Sides:
    """The pixels about the four sides of T tags: S = 4 T sides, at most P pixels each."""

    def __init__(
        self, grey: NDArray[np.uint8], corners_px: FloatArray, cells: IntArray, camera: CameraModel | None
    ) -> None:
        self._begin = corners_px.reshape(-1, 2)
        self._along = corners_px[:, _NEXT].reshape(-1, 2) - self._begin
        self._length = np.maximum(np.hypot(self._along[:, 0], self._along[:, 1]), 1e-9)
        self._across = self._along[:, ::-1] * (-1.0, 1.0) / self._length[:, None]  # turned from x towards y
        self._sagitta = np.zeros(len(self._begin)) if camera is None else _sagitta(corners_px, self._across, camera)
        self._take(grey, *self._pixels(grey, _band_px(self._depth(corners_px) / np.repeat(cells, 4))))

    def _take(
        self, grey: NDArray[np.uint8], index: IntArray, share: FloatArray, distance: FloatArray, seen: BoolArray
    ) -> None:
        """Keeps of what `_pixels` gives the pixels that are seen: (S, P), a side's first, then places without one."""
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
        """(S,) how far the tag reaches across each side, to the nearer of the two corners opposite."""
        opposite = corners_px[:, _OPPOSITE].reshape(-1, 2, 2)
        across = ((opposite - self._begin[:, None]) * self._across[:, None]).sum(axis=-1)
        return np.asarray(np.abs(across).min(axis=1))

    def _pixels(
        self, grey: NDArray[np.uint8], band_px: FloatArray
    ) -> tuple[IntArray, FloatArray, FloatArray, BoolArray]:
        """Whole pixels about the sides, each once: Q for each side, some of them seen, (S, Q).

        A side that runs along the rows rather than the columns has pixels of as many columns, in each of them those
        nearest to it; and the other way round. So the first of two coordinates is here the one of which a side has
        more: x along the rows, y along the columns.

        Args:
            grey: the picture.
            band_px: (S,) how far from the side a pixel may lie.

        Returns:
            (S, Q) each: where in the picture, row after row; share of the side's length; distance from the side; and
            whether they are seen: near, not at its ends, and in the picture.
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
        # Along rows or columns it is farther to the band's edges than across a side at a slant.
        slant = np.abs(along[:, 0]) / self._length
        reach = int(np.ceil(band_px.max() / slant.min()))
        offsets = np.arange(-reach, reach + 1.0)  # (O,)
        first = (line >= 0) & (line < size[:, :1])
        first[:, 1:] &= np.diff(line, axis=1) != 0
        seen = (offsets >= -middle[..., None]) & (offsets < (size[:, 1:] - middle)[..., None]) & first[..., None]
        index = line * stride[:, :1] + middle * stride[:, 1:]

        def sum_over(over_line: FloatArray, by_offset: FloatArray) -> FloatArray:
            """(S, Q) of (S, A) and (S,): what grows evenly with the pixels' offsets from the line."""
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
        """(S, 2) how far each side lies from the detector's at both ends; (T,) of which tags all four look right."""
        # Distance at the side's begin and at its end, logarithm of s, and by what share the light grows along it.
        p = np.zeros((len(self._begin), 4))
        p[:, _BLUR] = np.log(_FIRST_BLUR_PX)
        stiffness = (_NOISE_GREY / (_SHADE_PER_PX * self._length)) ** 2
        fit: _Fit | None = None
        rounds = 0
        while True:
            rounds += 1
            rate = np.exp(-p[:, _BLUR]) / np.sqrt(2.0)  # of the model's change with the distance: 1 / (sqrt(2) s)
            fit = _Fit(self._sums(p, rate, fit), rate, p[:, _SHADE])
            step = fit.step(stiffness)
            p -= step
            p[:, _BLUR] = np.maximum(np.minimum(p[:, _BLUR], _LOG_BLUR[1]), _LOG_BLUR[0])
            # The first round knows no light yet that could grow.
            if rounds == _ROUNDS or (rounds > 1 and np.abs(step[:, :2]).max() < _ARRIVED_PX):
                break
        return p[:, :2], np.asarray(self._looks_right(p, fit).reshape(-1, 4).all(axis=1))

    def _sums(self, p: FloatArray, rate: FloatArray, before: "_Fit | None") -> FloatArray:
        """(S, 7, 7) sums over the pixels of the products of each two of _BEGIN, ..., _LIGHT.

        Light and contrast, of which a share is what grows along a side, are those of the round before.
        """
        scaled = self._distance * rate[:, None]
        scaled -= self._share * ((p[:, 1] - p[:, 0]) * rate)[:, None]
        scaled -= (p[:, 0] * rate)[:, None]
        rows = self._rows
        erf(scaled, out=rows[:, _EDGE])
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
        """(S,) whether a side is one: `fit` is that of the last round, from which p is a step away."""
        rms = np.sqrt(np.maximum(fit.square, 0.0) / np.maximum(self._count, 1.0))
        contrast = 2.0 * np.abs(fit.h)
        one_way = np.repeat(np.abs(np.sign(fit.h).reshape(-1, 4).sum(axis=1)) == 4.0, 4)
        good = (self._count >= _LEAST_PIXELS) & (contrast > _LEAST_CONTRAST) & (rms < _ROUGHEST * contrast) & one_way
        # A blur at its limit is one that light and blur trade places in: too few pixels tell them apart.
        good &= p[:, _BLUR] < _LOG_BLUR[1] - 1e-6
        return np.asarray(good & (np.abs(p[:, :2]).max(axis=1) < _FARTHEST_PX))

    def corners(self, moved: FloatArray) -> FloatArray:
        """(T, 4, 2) where each side meets the one before it, both taken for straight near there."""
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
    """How well the model fits S sides for the sums over their pixels, and where it would fit better.

    Attributes:
        a: (S,) light on the side itself, over the middle grey; h: (S,) half the contrast: by linear least squares.
        square: (S,) sum of the squared residuals.
    """

    def __init__(self, sums: FloatArray, rate: FloatArray, shade: FloatArray) -> None:
        """Takes what `_Sides` sums, (S,) 1 / (sqrt(2) s), and (S,) the share by which the light grows."""
        n = np.maximum(sums[:, _ONE, _ONE], 1.0)
        even = sums[:, :, _LIGHT] - shade[:, None] * sums[:, :, _SHADE]  # sums with the light without what grows
        mean_edge, mean_light = sums[:, _ONE, _EDGE] / n, even[:, _ONE] / n
        spread = sums[:, _EDGE, _EDGE] - n * mean_edge**2
        self.h = (even[:, _EDGE] - n * mean_edge * mean_light) / np.maximum(spread, 1e-9)
        self.a = mean_light - self.h * mean_edge
        residual = np.zeros((len(sums), _N + 1))  # as a sum of rows
        residual[:, _ONE], residual[:, _EDGE], residual[:, _LIGHT] = self.a, self.h, -1.0
        residual[:, _SHADE] = shade
        self._sums, self._rate, self._shade = sums, rate, shade
        self._products = (sums @ residual[..., None])[..., 0]  # of the residual with each row
        self.square = (self._products * residual).sum(axis=-1)

    def step(self, stiffness: FloatArray) -> FloatArray:
        """(S, 4) of Gauss-Newton in the distances at both ends, the blur's logarithm and the share of the light.

        a and h go along in it. The prior of that share has the weight (S,) `stiffness`.
        """
        factor = np.ones((len(self._sums), _N))  # by which a row is the derivative
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
