"""Corners of detected tags, sharpened on the picture: each side of the black border fitted to the light about it.

Across a side the light is taken for a blurred step, a + h erf(d / (sqrt(2) s)), d being a pixel's distance from it. The
side is straight in the world, so in the picture it is bent as the lens bends it; where it runs is told by its distance
from the detector's line at both ends. These two, a, h and s are fitted to the pixels along the side (Gauss-Newton, all
sides of a picture at once), and corners are where neighbouring sides meet.

Pixels count from one cell inside the border to one cell outside, since a white margin of one cell surrounds a tag, and
clear of the corners, where another side is near. A tag one of whose sides does not look like this (hidden, out of the
picture, in a shadow's edge) keeps the detector's corners.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from calib.arrays import BoolArray, FloatArray, IntArray
from calib.camera_model import CameraModel

_ALONG: Final = 20  # pixels along a side
_ACROSS: Final = 4  # pixels to both of its sides
_ROUNDS: Final = 6
_ARRIVED_PX: Final = 2e-3
_LONGEST_STEP: Final = 0.5  # px, and of the blur's logarithm
# What is summed over pixels: the derivatives by the distance at the side's begin, at its end and by the blur's
# logarithm, each over -h; those by a and by h; and the light.
_BEGIN, _END, _BLUR, _ONE, _EDGE, _LIGHT = range(6)
_N: Final = 5  # unknowns
# Of a tag's corners, the one that follows each, and the two opposite the side that begins there.
_NEXT: Final = (1, 2, 3, 0)
_OPPOSITE: Final = ((2, 3), (3, 0), (0, 1), (1, 2))
_FIRST_BLUR_PX: Final = 0.7
_BLUR_PX: Final = (0.2, 3.0)
_CLEAR_PX: Final = 0.3  # before a cell is over and the next one's light comes in
_LEAST_BAND_PX: Final = 1.2
_CLEAR_OF_CORNER_PX: Final = 2.0
_FARTHEST_PX: Final = 1.5  # that a side may lie from where the detector saw it
_LEAST_CONTRAST: Final = 10.0  # grey levels: twice h
# Residuals' RMS over the contrast, 0.02 for an edge under a sensor's noise: beyond, something else is there too.
_ROUGHEST: Final = 0.1
_LEAST_PIXELS: Final = 25  # five for each parameter


def refined_corners(
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
    moved, good = sides.fitted()
    found = sides.corners(moved)
    good &= np.linalg.norm(found - corners_px, axis=-1).max(axis=-1) < 2.0 * _FARTHEST_PX
    return np.where(good[:, None, None], found, corners_px), good


def _sagitta(corners_px: FloatArray, across: FloatArray, camera: CameraModel) -> FloatArray:
    """(S,) how far the lens bends the middle of each side off its chord, along `across` (S, 2)."""
    rays = camera.unproject(corners_px)
    flat = rays / rays[..., 2:]
    middle = camera.project(0.5 * (flat + flat[:, _NEXT])).reshape(-1, 2)
    chord = 0.5 * (corners_px + corners_px[:, _NEXT]).reshape(-1, 2)
    return np.asarray(np.nan_to_num(((middle - chord) * across).sum(axis=-1)), dtype=np.float64)


class _Sides:
    """The pixels about the four sides of T tags: S = 4 T sides, at most P pixels each."""

    def __init__(
        self, grey: NDArray[np.uint8], corners_px: FloatArray, cells: IntArray, camera: CameraModel | None
    ) -> None:
        self._begin = corners_px.reshape(-1, 2)
        self._along = corners_px[:, _NEXT].reshape(-1, 2) - self._begin
        self._length = np.maximum(np.linalg.norm(self._along, axis=-1), 1e-9)
        self._across = self._along[:, ::-1] * (-1.0, 1.0) / self._length[:, None]  # turned from x towards y
        self._sagitta = np.zeros(len(self._begin)) if camera is None else _sagitta(corners_px, self._across, camera)
        band_px = np.clip(self._depth(corners_px) / np.repeat(cells, 4) - _CLEAR_PX, _LEAST_BAND_PX, _ACROSS)
        light, share, distance, seen = self._pixels(grey, band_px)
        count = seen.sum(axis=1)
        taken = np.arange(count.max()) < count[:, None]
        self._share, self._distance = np.zeros(taken.shape), np.zeros(taken.shape)
        self._share[taken], self._distance[taken] = share[seen], distance[seen]
        self._seen = taken.astype(np.float64)
        self._rows = np.zeros((len(taken), _N + 1, taken.shape[1]))
        self._rows[:, _ONE] = self._seen
        self._rows[:, _LIGHT][taken] = light - 128.0  # about as much above as below: sums lose fewer digits

    def _depth(self, corners_px: FloatArray) -> FloatArray:
        """(S,) how far the tag reaches across each side, to the nearer of the two corners opposite."""
        opposite = corners_px[:, _OPPOSITE].reshape(-1, 2, 2)
        across = ((opposite - self._begin[:, None]) * self._across[:, None]).sum(axis=-1)
        return np.asarray(np.abs(across).min(axis=1))

    def _pixels(
        self, grey: NDArray[np.uint8], band_px: FloatArray
    ) -> tuple[NDArray[np.uint8], FloatArray, FloatArray, BoolArray]:
        """Whole pixels about the sides, each once: Q for each side, some of them seen, (S, Q).

        A side that runs along the rows rather than the columns has pixels of as many columns, in each of them those
        nearest to it; and the other way round. So the first of two coordinates is here the one of which a side has
        more: x along the rows, y along the columns.

        Args:
            grey: the picture.
            band_px: (S,) how far from the side a pixel may lie.

        Returns:
            Light (of the seen ones, side by side), share of the side's length (S, Q), distance from the side (S, Q),
            and whether they are seen: near, not at its ends, and in the picture (S, Q).
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
        offsets = np.arange(-reach, reach + 1)  # (O,)
        first = (line >= 0) & (line < size[:, :1])
        first[:, 1:] &= np.diff(line, axis=1) != 0
        inside = (offsets >= -middle[..., None]) & (offsets < (size[:, 1:] - middle)[..., None]) & first[..., None]
        index = (line * stride[:, :1] + middle * stride[:, 1:]).astype(np.int64)[..., None]
        index = index + offsets * stride[:, 1:, None]
        off = line - begin[:, :1], middle - begin[:, 1:]
        by_along, distance = (
            ((off[0] * by[:, :1] + off[1] * by[:, 1:])[..., None] + offsets * by[:, 1:, None]).reshape(len(line), -1)
            for by in (along, across)
        )
        share = by_along / self._length[:, None] ** 2
        distance -= (4.0 * self._sagitta)[:, None] * share * (1.0 - share)
        clear = np.minimum(_CLEAR_OF_CORNER_PX / self._length, 0.25)[:, None]
        near = (np.abs(distance) < band_px[:, None]) & (np.abs(share - 0.5) < 0.5 - clear)
        seen = inside.reshape(near.shape) & near
        return grey.reshape(-1)[index.reshape(near.shape)[seen]], share, distance, seen

    def fitted(self) -> tuple[FloatArray, BoolArray]:
        """(S, 2) how far each side lies from the detector's at both ends; (T,) of which tags all four look right."""
        p = np.zeros((len(self._begin), 3))  # distance at the side's begin, at its end, logarithm of s
        p[:, 2] = np.log(_FIRST_BLUR_PX)
        for _ in range(_ROUNDS):
            sums = self._sums(p)
            step = _step(sums, *_levels(sums))
            p[:, :2] -= step[:, :2]
            p[:, 2] = np.clip(p[:, 2] - step[:, 2], *np.log(_BLUR_PX))
            if np.abs(step[:, :2]).max() < _ARRIVED_PX:
                break
        return p[:, :2], np.asarray(self._looks_right(p).reshape(-1, 4).all(axis=1))

    def _sums(self, p: FloatArray) -> FloatArray:
        """(S, 6, 6) sums over the pixels of the products of each two of _BEGIN, ..., _LIGHT."""
        rate = np.exp(-p[:, 2, None]) / np.sqrt(2.0)
        off = self._distance - p[:, :1]
        off -= (p[:, 1:2] - p[:, :1]) * self._share
        scaled = off * rate
        rows = self._rows
        np.multiply(self._seen, erf(scaled), out=rows[:, _EDGE])
        scaled *= -scaled
        slope = np.exp(scaled, out=scaled)
        slope *= self._seen
        slope *= (2.0 / np.sqrt(np.pi)) * rate
        np.multiply(slope, self._share, out=rows[:, _END])
        np.subtract(slope, rows[:, _END], out=rows[:, _BEGIN])
        np.multiply(slope, off, out=rows[:, _BLUR])
        return np.asarray(rows @ rows.swapaxes(-1, -2))

    def _looks_right(self, p: FloatArray) -> BoolArray:
        sums = self._sums(p)
        n = sums[:, _ONE, _ONE]
        a, h = _levels(sums)
        model = np.zeros((len(p), _N + 1))
        model[:, _ONE], model[:, _EDGE], model[:, _LIGHT] = a, h, -1.0
        square = np.einsum("si,sij,sj->s", model, sums, model)
        rms = np.sqrt(np.maximum(square, 0.0) / np.maximum(n, 1.0))
        contrast = 2.0 * np.abs(h)
        one_way = np.repeat(np.abs(np.sign(h).reshape(-1, 4).sum(axis=1)) == 4.0, 4)
        good = (n >= _LEAST_PIXELS) & (contrast > _LEAST_CONTRAST) & (rms < _ROUGHEST * contrast) & one_way
        # A blur at its limit is one that light and blur trade places in: too few pixels tell them apart.
        good &= p[:, 2] < np.log(_BLUR_PX[1]) - 1e-6
        return np.asarray(good & (np.abs(p[:, :2]).max(axis=1) < _FARTHEST_PX))

    def corners(self, moved: FloatArray) -> FloatArray:
        """(T, 4, 2) where each side meets the one before it, both taken for straight near there."""
        slope = (moved[:, 1] - moved[:, 0])[:, None] * self._across
        bend = 4.0 * self._sagitta[:, None] * self._across
        begin, end = self._begin + moved[:, :1] * self._across, self._begin + self._along + moved[:, 1:] * self._across
        leaves, arrives = self._along + slope + bend, self._along + slope - bend
        before = np.roll(np.arange(len(begin)).reshape(-1, 4), 1, axis=1).ravel()
        gap = end[before] - begin
        cross = leaves[:, 0] * arrives[before, 1] - leaves[:, 1] * arrives[before, 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            share = (gap[:, 0] * arrives[before, 1] - gap[:, 1] * arrives[before, 0]) / cross
        return np.asarray(np.nan_to_num(begin + share[:, None] * leaves, nan=1e9).reshape(-1, 4, 2))


def _levels(sums: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(S,) a and h, by linear least squares; a without what `_LIGHT` leaves out."""
    n = np.maximum(sums[:, _ONE, _ONE], 1.0)
    mean_edge, mean_light = sums[:, _ONE, _EDGE] / n, sums[:, _ONE, _LIGHT] / n
    spread = sums[:, _EDGE, _EDGE] - n * mean_edge**2
    h = (sums[:, _EDGE, _LIGHT] - n * mean_edge * mean_light) / np.maximum(spread, 1e-9)
    return mean_light - h * mean_edge, h


def _step(sums: FloatArray, a: FloatArray, h: FloatArray) -> FloatArray:
    """(S, 3) of Gauss-Newton in the distances at both ends and the blur's logarithm; a and h go along in it.

    The five derivatives of a + h erf(...) are rows of `sums` times one factor each, and the residual is a sum of three.
    """
    factor = np.ones((len(sums), _N))
    factor[:, [_BEGIN, _END, _BLUR]] = -h[:, None]
    residual = a[:, None] * sums[:, :_N, _ONE] + h[:, None] * sums[:, :_N, _EDGE] - sums[:, :_N, _LIGHT]
    normal = factor[:, :, None] * sums[:, :_N, :_N] * factor[:, None]
    diagonal = np.einsum("sii->si", normal)
    diagonal += 1e-3 * diagonal + 1e-6
    step = np.linalg.solve(normal, (factor * residual)[..., None])[..., 0]
    return np.asarray(np.clip(step[:, [_BEGIN, _END, _BLUR]], -_LONGEST_STEP, _LONGEST_STEP))
