"""Surroundings of chessboard corners as predicted from the camera and the board, before a fit to the picture."""

from dataclasses import dataclass, fields
from typing import Final

import numpy as np

from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray, erf

FIRST_RADIUS_PX: Final = 6  # while the bends of the edges are unknown
RADIUS_PX: Final = 16  # with known bends; time grows with its square, and half a square is the most that can be used
_CLEAR_OF_PX: Final = 1.5  # distance from other print; beyond it `marker_light` models the blur of the markers


@dataclass(frozen=True)
class Surroundings:
    """Predicted surroundings of N corners.

    Attributes:
        pixels: (N, 2) approximate positions.
        squares_px: (N, 2, 2) shift in the picture, in its columns, for one square along the board's x and y.
        growth_px: (N, 2, 3) second derivatives of the picture position: xx, xy, yy, per square.
        white_diagonal: (N,) whether the square towards positive x and y is white.
        bend: (N, 2, 3) second to fourth derivative of the deviation of the edges along x and along y, see `bends`.
        blur_px: (N,) sigma of the blur of the markers beside the corner.
        clear: width of the white margin around a marker, in squares.
        radius_px: distance from a corner up to which pixels are used.
    """

    pixels: FloatArray
    squares_px: FloatArray
    growth_px: FloatArray
    white_diagonal: BoolArray
    bend: FloatArray
    blur_px: FloatArray
    clear: float
    radius_px: int

    def where(self, mask: BoolArray) -> "Surroundings":
        """Return the surroundings of the corners selected by a mask (N,)."""
        own = {field.name: getattr(self, field.name) for field in fields(self)}
        return Surroundings(**{name: each[mask] if np.ndim(each) else each for name, each in own.items()})

    def squares_at(self, places: FloatArray) -> FloatArray:
        """Return board coordinates (N, P, 2), in squares from the corner, of picture positions (N, P, 2)."""
        turned, off = np.linalg.inv(self.squares_px), places - self.pixels[:, None]
        straight = np.einsum("nij,npj->npi", turned, off)
        x, y = straight[..., 0], straight[..., 1]
        second = np.stack([0.5 * x * x, x * y, 0.5 * y * y], axis=-1)
        return np.asarray(straight - np.einsum("nij,njk,npk->npi", turned, self.growth_px, second))

    def is_white(self, squares: FloatArray) -> BoolArray:
        """Return (N, P) whether the square is white at board coordinates (N, P, 2) as `squares_at` returns them."""
        return np.asarray((squares.prod(axis=-1) > 0.0) == self.white_diagonal[:, None])

    def marker_light(self, places: FloatArray) -> FloatArray:
        """Return (N, P) the term m of `corner_fit` at picture positions (N, P, 2).

        It is twice the share of a marker's black, with the sign of the white square.
        """
        squares = self.squares_at(places)
        determinant = np.abs(np.linalg.det(self.squares_px))
        width_px = determinant[:, None] / np.linalg.norm(self.squares_px[:, :, ::-1], axis=1)  # between opposite sides
        scale = width_px / (np.sqrt(2.0) * self.blur_px[:, None])
        share = (0.5 + 0.5 * erf((np.abs(squares) - self.clear) * scale[:, None])).prod(axis=-1)
        sign = np.where(self.white_diagonal, -1.0, 1.0)[:, None]
        return np.asarray(np.where(self.is_white(squares), 2.0 * sign * share, 0.0))

    def own_squares(self, places: FloatArray, size: IntArray) -> BoolArray:
        """Return (N, P) whether a pixel shows the corner's own squares only and is nearest to this corner.

        Args:
            places: (N, P, 2) in the picture.
            size: (2,) width and height of the picture.
        """
        place = self.squares_at(places)
        side_px = np.linalg.norm(self.squares_px, axis=1)[:, None]  # (N, 1, 2)
        blur = _CLEAR_OF_PX / side_px  # in squares
        # Small squares would leave too few pixels, so neighbouring corners share some.
        own = np.maximum(0.5, FIRST_RADIUS_PX / side_px)
        near = (np.abs(place) < np.minimum(own, 1.0 - blur)).all(axis=-1)
        in_marker = (np.abs(place) > self.clear - blur).all(axis=-1) & self.is_white(place)
        in_picture = ((places >= 0.0) & (places < size)).all(axis=-1)
        return np.asarray(near & ~in_marker & in_picture)


def bends(points_px: FloatArray) -> FloatArray:
    """Return (N, 3) second to fourth derivatives of lines through five neighbouring points, at the middle one.

    The function differentiated is the distance of the line from its tangent, positive towards (-y, x) for a line of
    direction (x, y). It is differentiated by the distance back along the tangent. NaN where points are not finite or
    coincide.

    Args:
        points_px: (N, 5, 2) in the picture.
    """
    along = points_px[:, 1] - points_px[:, 3]
    along = along / np.maximum(np.linalg.norm(along, axis=1), 1e-12)[:, None]
    off = points_px[:, [0, 1, 3, 4]] - points_px[:, 2:3]
    way = np.einsum("npi,ni->np", off, along)
    aside = off[..., 0] * along[:, None, 1] - off[..., 1] * along[:, None, 0]
    powers = np.stack([way, way**2 / 2.0, way**3 / 6.0, way**4 / 24.0], axis=-1)
    known = np.isfinite(powers).all(axis=(1, 2)) & (np.diff(np.sort(way, axis=1), axis=1) > 1e-6).all(axis=1)
    out = np.full((len(off), 3), np.nan)
    out[known] = np.linalg.solve(powers[known], aside[known][..., None])[:, 1:, 0]
    return out
