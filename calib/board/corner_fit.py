"""Chessboard corners to hundredths of a pixel, by a least-squares fit of two blurred edges to the grey levels.

The grey level around a corner c is modelled as

    (1 + g . (x - c)) (a + b (erf(l_1(x) / (sqrt(2) s_1)) erf(l_2(x) / (sqrt(2) s_2)) - m(x))),
    l_k(x) = n_k . (x - c) - y_k(u) - y_k''(u) s_k^2 / 2,   u = t_k . (x - c)

with two edges through c of normals n_k and directions t_k. Each edge has a blur s_k of its own, from defocus or from
motion during the exposure. The deviation of an edge from its tangent, y_k, is given: lens distortion bends edges, and
a neglected bend shifts corners. Blur shifts a bent edge inwards by the mean of the bend over the blur, which is the
last term of l_k. Overexposure or bleeding ink makes black grow or shrink. That shifts the two halves of an edge in
opposite directions and leaves the corner in place. A light gradient g along an edge (vignetting, a lamp) would shift
both halves in the same direction, so it is estimated.

Blur spreads the black of markers into the white around them. m is this contribution, computed with the blur of the
first fit. Where the scale changes over the picture, one of the two markers is nearer to the corner than the other and
biases it. The markers' positions are therefore predicted by a map of second order. With an affine map the bias is
0.001 px in a fisheye picture, and 0.008 px with a blur of 1 px.

The error of a corner due to image noise falls with the square root of the edges' length. The edges are therefore used
up to the middle of the squares, where those of the next corner begin, so that no pixel is used for two corners.

The fit also returns the blur of each corner.
"""

from dataclasses import dataclass
from dataclasses import fields as dataclass_fields
from typing import Final

import numpy as np
from numpy.typing import NDArray

from groundsbot.calib.board.corner_surroundings import FIRST_RADIUS_PX, Surroundings
from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray, erf

FIRST_BLUR_PX: Final = 0.7
_ROUNDS: Final = 15
_N: Final = 10  # parameters: c (2), directions of the normals (2), a, b, logarithms of the blurs (2), g (2)
_BLURS: Final = slice(6, 8)
_SLOPE: Final = slice(8, 10)  # relative change of the light over the radius
_ARRIVED_PX: Final = 1e-4
_FARTHEST_SQUARES: Final = 0.3  # largest distance of a corner from its initial value
_LEAST_CONTRAST: Final = 16.0  # grey levels between black and white; below it markers are hardly decoded
_ROUGHEST: Final = 0.1  # largest RMS of the residuals over the contrast for a picture of two edges
_MOST_BLUR_SQUARES: Final = 0.25
_LEAST_PIXELS: Final = 50  # five per parameter


@dataclass(frozen=True)
class Corners:
    """N corners in one picture.

    Attributes:
        ids: (N,) OpenCV's numbers of the board's inner corners.
        pixels: (N, 2) positions in the picture.
        blur_px: (N,) sigma of the blur, of the more blurred edge.
    """

    ids: IntArray
    pixels: FloatArray
    blur_px: FloatArray

    def where(self, mask: BoolArray) -> "Corners":
        """Return the corners selected by a mask (N,)."""
        return Corners(*(getattr(self, field.name)[mask] for field in dataclass_fields(self)))


def fit_corners(picture: NDArray[np.uint8], ids: IntArray, around: Surroundings) -> Corners:
    """Fit the corners and return those whose fit is accepted.

    A corner is dropped at the border of the picture, with too little contrast, or where the picture does not show two
    edges.

    Args:
        picture: `[H, W]` grey levels.
        ids: (N,) OpenCV's numbers of the corners.
        around: predicted surroundings of the N corners.
    """
    known = (around.pixels[:, None], around.squares_px, around.growth_px, around.bend)
    inside = np.all([np.isfinite(each).all(axis=(1, 2)) for each in known], axis=0)
    size = np.array(picture.shape[::-1])
    inside &= ((around.pixels > FIRST_RADIUS_PX) & (around.pixels < size - 1 - FIRST_RADIUS_PX)).all(axis=1)
    if not inside.any():
        none = np.zeros((0, 2))
        return Corners(ids[:0], none, none[:, 0])
    return _Patches(picture, around.where(inside)).fit(ids[inside])


class _Patches:
    """Picture patches around N corners, padded to the largest number of pixels P of any corner."""

    def __init__(self, picture: NDArray[np.uint8], around: Surroundings) -> None:
        offsets = np.arange(-around.radius_px, around.radius_px + 1)
        dx, dy = (each.ravel() for each in np.meshgrid(offsets, offsets))
        middle = np.rint(around.pixels).astype(np.int64)
        places = np.stack([middle[:, :1] + dx, middle[:, 1:] + dy], axis=-1)
        self._around = around
        seen = around.own_squares(places.astype(np.float64), np.array(picture.shape[::-1]))
        kept = np.argsort(~seen, axis=1, kind="stable")[:, : int(seen.sum(axis=1).max())]
        self._seen = np.take_along_axis(seen, kept, axis=1).astype(np.float64)  # (N, P) 1.0 for pixels that are used
        places = np.take_along_axis(places, kept[..., np.newaxis], axis=1)
        columns, rows = np.moveaxis(places.clip(0, np.array(picture.shape[::-1]) - 1), -1, 0)
        self._light = picture[rows, columns].astype(np.float64)  # (N, P)
        self._places = places.astype(np.float64)  # (N, P, 2)
        self._marker = around.marker_light(self._places)  # (N, P)

    def fit(self, ids: IntArray) -> Corners:
        """Fit all corners and return the accepted ones."""
        p = self._minimise(self._start())
        good = self._looks_right(p)
        return Corners(ids[good], p[good, :2], np.exp(p[good, _BLURS]).max(axis=1))

    def _minimise(self, p: FloatArray) -> FloatArray:
        """Return the parameters (N, 10) minimised by Levenberg-Marquardt, with one damping per patch."""
        residual, jacobian = self._linearise(p)
        cost, damping = (residual**2).sum(axis=1), np.full(len(p), 1e-3)
        moving = np.arange(len(p))
        for _ in range(_ROUNDS):
            J, r = jacobian[moving], residual[moving]
            normal = J.swapaxes(-1, -2) @ J
            gradient = (r[:, None, :] @ J)[:, 0]
            diagonal = np.einsum("nii->ni", normal)
            damped = normal + (damping[moving, None] * diagonal + 1e-9)[:, :, None] * np.eye(_N)
            step = np.linalg.solve(damped, gradient[..., None])[..., 0]
            tried = p[moving] - step
            tried[:, _BLURS] = np.clip(tried[:, _BLURS], np.log(0.2), np.log(5.0))
            new_residual, new_jacobian = self._linearise(tried, moving)
            new_cost = (new_residual**2).sum(axis=1)
            better = new_cost < cost[moving]
            gained = moving[better]
            p[gained], cost[gained] = tried[better], new_cost[better]
            residual[gained], jacobian[gained] = new_residual[better], new_jacobian[better]
            damping[moving] *= np.where(better, 0.1, 10.0)
            moving = moving[np.abs(step[:, :2]).max(axis=1) > _ARRIVED_PX]
            if not len(moving):
                break
        return p

    def _start(self) -> FloatArray:
        around = self._around
        p = np.zeros((len(around.pixels), _N))
        p[:, :2] = around.pixels
        along_x, along_y = around.squares_px[:, :, 0], around.squares_px[:, :, 1]
        p[:, 2] = np.arctan2(along_x[:, 0], -along_x[:, 1])  # normals: the directions turned by 90 degrees
        p[:, 3] = np.arctan2(along_y[:, 0], -along_y[:, 1])
        p[:, _BLURS] = np.log(FIRST_BLUR_PX)
        p[:, 5] = 1.0
        residual, _ = self._linearise(p)
        shape = residual + self._seen * self._light  # the model with a = 0, b = 1
        count = np.maximum(self._seen.sum(axis=1), 1.0)
        mean_light, mean_shape = (self._seen * self._light).sum(axis=1) / count, shape.sum(axis=1) / count
        off = self._seen * (shape - mean_shape[:, None])
        p[:, 5] = (off * self._light).sum(axis=1) / np.maximum((off**2).sum(axis=1), 1e-9)
        p[:, 4] = mean_light - p[:, 5] * mean_shape
        return p

    def _linearise(self, p: FloatArray, of: IntArray | slice = slice(None)) -> tuple[FloatArray, FloatArray]:
        """Return residuals (N, P), model minus picture, and their derivatives (N, P, 10) for the patches `of`."""
        off = self._places[of] - p[:, None, :2]
        edges, slopes, by_centre, by_turn = [], [], [], []
        for k in (0, 1):
            cos, sin = np.cos(p[:, 2 + k])[:, None], np.sin(p[:, 2 + k])[:, None]
            across, along = cos * off[..., 0] + sin * off[..., 1], -sin * off[..., 0] + cos * off[..., 1]
            blur = np.exp(p[:, 6 + k])[:, None]
            second, third, fourth = (each[..., None] for each in np.moveaxis(self._around.bend[of, k], -1, 0))
            bend, change = second + along * (third + 0.5 * fourth * along), third + fourth * along
            sag = along**2 * (0.5 * second + along * (third / 6.0 + fourth / 24.0 * along))
            slope = along * (second + along * (0.5 * third + fourth / 6.0 * along)) + 0.5 * change * blur**2
            q = (across - sag - 0.5 * bend * blur**2) / (np.sqrt(2.0) * blur)
            edges.append(erf(q))
            slopes.append((2.0 / np.sqrt(np.pi)) * np.exp(-(q**2)))
            scale = 1.0 / (np.sqrt(2.0) * blur)
            by_blur = -q - scale * bend * blur**2
            by_centre.append((scale * (-cos - slope * sin), scale * (-sin + slope * cos), by_blur))
            by_turn.append(scale * (along + slope * across))
        a, b = p[:, 4, None], p[:, 5, None]
        jacobian = np.empty((*off.shape[:2], _N))
        first, second = b * slopes[0] * edges[1], b * slopes[1] * edges[0]
        for axis in (0, 1):
            jacobian[..., axis] = first * by_centre[0][axis] + second * by_centre[1][axis]
        jacobian[..., 2], jacobian[..., 3] = first * by_turn[0], second * by_turn[1]
        shape = edges[0] * edges[1] - self._marker[of]
        jacobian[..., 4], jacobian[..., 5] = 1.0, shape
        jacobian[..., 6], jacobian[..., 7] = first * by_centre[0][2], second * by_centre[1][2]
        reflected = a + b * shape
        away = (self._places[of] - self._around.pixels[of, None]) / self._around.radius_px
        falling = self._seen[of] * (1.0 + np.einsum("npi,ni->np", away, p[:, _SLOPE]))
        jacobian[..., : _SLOPE.start] *= falling[..., None]
        jacobian[..., _SLOPE] = (self._seen[of] * reflected)[..., None] * away
        return falling * reflected - self._seen[of] * self._light[of], jacobian

    def _looks_right(self, p: FloatArray) -> BoolArray:
        """Return (N,) whether two edges that cross near the initial value explain the picture."""
        residual, _ = self._linearise(p)
        count = self._seen.sum(axis=1)
        contrast = 2.0 * np.abs(p[:, 5])
        squares = self._around.squares_px
        side_px = np.linalg.norm(squares, axis=1).min(axis=1)
        rms = np.sqrt((residual**2).sum(axis=1) / np.maximum(count, 1.0))
        moved_px = np.linalg.norm(p[:, :2] - self._around.pixels, axis=1)
        return np.asarray(
            (count > _LEAST_PIXELS)
            & (moved_px < np.minimum(_FARTHEST_SQUARES * side_px, FIRST_RADIUS_PX))
            & (contrast > _LEAST_CONTRAST)
            & (rms < _ROUGHEST * contrast)
            & (np.exp(p[:, _BLURS]).max(axis=1) < _MOST_BLUR_SQUARES * side_px)
        )
