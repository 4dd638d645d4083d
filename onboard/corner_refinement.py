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
_N: Final = 5  # distance at the side's begin, at its end, a, h, logarithm of s
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
    sides = _Sides(grey, corners_px, cells, _sagitta(corners_px, camera))
    moved, good = sides.fitted()
    found = sides.corners(moved)
    good &= np.linalg.norm(found - corners_px, axis=-1).max(axis=-1) < 2.0 * _FARTHEST_PX
    return np.where(good[:, None, None], found, corners_px), good


def _sagitta(corners_px: FloatArray, camera: CameraModel | None) -> FloatArray:
    """(T, 4) how far the lens bends the middle of each side off its chord, along `_normal`."""
    if camera is None:
        return np.zeros(corners_px.shape[:2])
    rays = camera.unproject(corners_px)
    flat = rays / rays[..., 2:]
    middle = camera.project(0.5 * (flat + np.roll(flat, -1, axis=1)))
    ends = corners_px, np.roll(corners_px, -1, axis=1)
    off = ((middle - 0.5 * (ends[0] + ends[1])) * _normal(ends[1] - ends[0])).sum(axis=-1)
    return np.asarray(np.nan_to_num(off), dtype=np.float64)


def _normal(along: FloatArray) -> FloatArray:
    """Unit vectors across, turned from x towards y."""
    length = np.maximum(np.linalg.norm(along, axis=-1, keepdims=True), 1e-9)
    return np.asarray(np.stack([-along[..., 1], along[..., 0]], axis=-1) / length)


class _Sides:
    """The pixels about the four sides of T tags: S = 4 T sides, P pixels each."""

    def __init__(self, grey: NDArray[np.uint8], corners_px: FloatArray, cells: IntArray, sagitta: FloatArray) -> None:
        self._begin = corners_px.reshape(-1, 2)
        self._along = np.roll(corners_px, -1, axis=1).reshape(-1, 2) - self._begin
        self._length = np.maximum(np.linalg.norm(self._along, axis=-1), 1e-9)
        self._across = _normal(self._along)
        self._sagitta = sagitta.ravel()
        band_px = np.clip(self._depth(corners_px) / np.repeat(cells, 4) - _CLEAR_PX, _LEAST_BAND_PX, _ACROSS)[:, None]
        self._light, places, inside = self._pixels(grey, float(band_px.max()))
        off = places - self._begin[:, None]
        self._share = (off * self._along[:, None]).sum(axis=-1) / self._length[:, None] ** 2
        bend = 4.0 * self._sagitta[:, None] * self._share * (1.0 - self._share)
        self._distance = (off * self._across[:, None]).sum(axis=-1) - bend
        clear = np.minimum(_CLEAR_OF_CORNER_PX / self._length, 0.25)[:, None]
        near = (np.abs(self._distance) < band_px) & (np.abs(self._share - 0.5) < 0.5 - clear)
        self._seen = (inside & near).astype(np.float64)

    def _depth(self, corners_px: FloatArray) -> FloatArray:
        """(S,) how far the tag reaches across each side, to the nearer of the two corners opposite."""
        opposite = np.stack([np.roll(corners_px, -k, axis=1).reshape(-1, 2) for k in (2, 3)], axis=1)
        across = ((opposite - self._begin[:, None]) * self._across[:, None]).sum(axis=-1)
        return np.asarray(np.abs(across).min(axis=1))

    def _pixels(self, grey: NDArray[np.uint8], band_px: float) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Light (S, P), places (S, P, 2), and (S, P) whether they are in the picture: whole pixels, each taken once.

        A side that runs along the rows rather than the columns has pixels of as many columns, in each of them those
        nearest to it; and the other way round.
        """
        share = (np.arange(_ALONG) + 0.5) / _ALONG
        on_side = self._begin[:, None] + share[:, None] * self._along[:, None]  # (S, A, 2)
        on_side = on_side + (4.0 * self._sagitta[:, None] * share * (1.0 - share))[..., None] * self._across[:, None]
        runs_along_rows = np.abs(self._along[:, 0]) > np.abs(self._along[:, 1])
        middle = np.rint(on_side).astype(np.int64)
        step = np.where(runs_along_rows[:, None], [0, 1], [1, 0])  # (S, 2)
        # Along rows or columns it is farther to the band's edges than across a side at a slant.
        slant = np.abs(self._along).max(axis=1) / self._length
        reach = int(np.ceil(band_px / float(slant.min())))
        offsets = np.arange(-reach, reach + 1)
        places = middle[:, :, None] + offsets[:, None] * step[:, None, None]  # (S, A, O, 2)
        first = np.ones(middle.shape[:2], dtype=np.bool_)
        line = np.where(runs_along_rows[:, None], middle[..., 0], middle[..., 1])
        first[:, 1:] = np.diff(line, axis=1) != 0
        flat = places.reshape(len(places), -1, 2)
        size = np.array(grey.shape[::-1])
        inside = ((flat >= 0) & (flat < size)).all(axis=-1) & np.repeat(first, len(offsets), axis=1)
        clipped = np.clip(flat, 0, size - 1)
        return grey[clipped[..., 1], clipped[..., 0]].astype(np.float64), flat.astype(np.float64), np.asarray(inside)

    def fitted(self) -> tuple[FloatArray, BoolArray]:
        """(S, 2) how far each side lies from the detector's at both ends; (T,) of which tags all four look right."""
        p = np.zeros((len(self._light), _N))
        p[:, 4] = np.log(_FIRST_BLUR_PX)
        for _ in range(_ROUNDS):
            edge, slope, width = self._edge(p)
            p[:, 2:4] = self._levels(edge)
            along = self._seen * p[:, 3, None] * slope / (np.sqrt(2.0) * width)
            begin, ended, blur = -along * (1.0 - self._share), -along * self._share, -along * self._off(p)
            J = np.stack([begin, ended, self._seen, self._seen * edge, blur], axis=1)  # (S, 5, P)
            residual = self._seen * (p[:, 2, None] + p[:, 3, None] * edge - self._light)
            normal = J @ J.swapaxes(-1, -2)
            gradient = (J @ residual[..., None])[..., 0]
            diagonal = np.einsum("sii->si", normal)
            normal = normal + (1e-3 * diagonal + 1e-6)[:, :, None] * np.eye(_N)
            step = np.clip(np.linalg.solve(normal, gradient[..., None])[..., 0], -_LONGEST_STEP, _LONGEST_STEP)
            p[:, :2] -= step[:, :2]
            p[:, 4] = np.clip(p[:, 4] - step[:, 4], *np.log(_BLUR_PX))
            if np.abs(step[:, :2]).max() < _ARRIVED_PX:
                break
        return p[:, :2], np.asarray(self._looks_right(p).reshape(-1, 4).all(axis=1))

    def _off(self, p: FloatArray) -> FloatArray:
        return np.asarray(self._distance - p[:, :1] * (1.0 - self._share) - p[:, 1:2] * self._share)

    def _edge(self, p: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """The step (S, P), its slope by d / (sqrt(2) s), and s."""
        width = np.exp(p[:, 4, None])
        scaled = self._off(p) / (np.sqrt(2.0) * width)
        return erf(scaled), (2.0 / np.sqrt(np.pi)) * np.exp(-(scaled**2)), width

    def _levels(self, edge: FloatArray) -> FloatArray:
        """(S, 2) a and h of steps (S, P), by linear least squares."""
        n = np.maximum(self._seen.sum(axis=1), 1.0)
        mean_edge, mean_light = ((self._seen * each).sum(axis=1) / n for each in (edge, self._light))
        off = self._seen * (edge - mean_edge[:, None])
        h = (off * self._light).sum(axis=1) / np.maximum((off**2).sum(axis=1), 1e-9)
        return np.stack([mean_light - h * mean_edge, h], axis=-1)

    def _looks_right(self, p: FloatArray) -> BoolArray:
        edge, _, _ = self._edge(p)
        n = self._seen.sum(axis=1)
        level = self._levels(edge)
        residual = self._seen * (level[:, :1] + level[:, 1:] * edge - self._light)
        contrast = 2.0 * np.abs(level[:, 1])
        rms = np.sqrt((residual**2).sum(axis=1) / np.maximum(n, 1.0))
        signs = np.sign(level[:, 1]).reshape(-1, 4)
        one_way = np.repeat(np.abs(signs.sum(axis=1)) == 4.0, 4)
        good = (n >= _LEAST_PIXELS) & (contrast > _LEAST_CONTRAST) & (rms < _ROUGHEST * contrast) & one_way
        # A blur at its limit is one that light and blur trade places in: too few pixels tell them apart.
        good &= p[:, 4] < np.log(_BLUR_PX[1]) - 1e-6
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
