"""What a camera and the print tell about the surroundings of a chessboard's corners before their light is looked at."""

from dataclasses import dataclass, fields
from typing import Final

import numpy as np
from scipy.special import erf

from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray

FIRST_RADIUS_PX: Final = 6  # about a corner whose edges' bends are not known yet
RADIUS_PX: Final = 16  # with bends; time grows with its square, what is gained ends with half a square
_CLEAR_OF_PX: Final = 1.5  # of what else is printed: beyond it `marker_light` tells what blur brings


@dataclass(frozen=True)
class Surroundings:
    """What is known around N corners before they are fitted.

    Attributes:
        pixels: (N, 2) about where they are.
        squares_px: (N, 2, 2) in its columns, how far one square along the board's x and y leads.
        growth_px: (N, 2, 3) second derivatives of the same, by x twice, by x and y, by y twice.
        white_diagonal: (N,) whether white lies where x and y both grow.
        bend: (N, 2, 3) second to fourth derivative of y of the edges along x and along y, see `bends`.
        blur_px: (N,) sigma of what is printed beside the corner.
        clear: how far in squares a white square is clear of its marker.
        radius_px: how far from a corner pixels are looked at.
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
        """Those of the mask."""
        own = {field.name: getattr(self, field.name) for field in fields(self)}
        return Surroundings(**{name: each[mask] if np.ndim(each) else each for name, each in own.items()})

    def squares_at(self, places: FloatArray) -> FloatArray:
        """Places (N, P, 2) in the picture as squares along the board's x and y from the corner."""
        turned, off = np.linalg.inv(self.squares_px), places - self.pixels[:, None]
        straight = np.einsum("nij,npj->npi", turned, off)
        x, y = straight[..., 0], straight[..., 1]
        second = np.stack([0.5 * x * x, x * y, 0.5 * y * y], axis=-1)
        return np.asarray(straight - np.einsum("nij,njk,npk->npi", turned, self.growth_px, second))

    def is_white(self, squares: FloatArray) -> BoolArray:
        """(N, P) whether the square is white at places (N, P, 2) as `squares_at` has them."""
        return np.asarray((squares.prod(axis=-1) > 0.0) == self.white_diagonal[:, None])

    def marker_light(self, places: FloatArray) -> FloatArray:
        """(N, P) m at places (N, P, 2): twice the share of a marker's black, with the sign of the white square."""
        squares = self.squares_at(places)
        determinant = np.abs(np.linalg.det(self.squares_px))
        width_px = determinant[:, None] / np.linalg.norm(self.squares_px[:, :, ::-1], axis=1)  # between opposite sides
        scale = width_px / (np.sqrt(2.0) * self.blur_px[:, None])
        share = (0.5 + 0.5 * erf((np.abs(squares) - self.clear) * scale[:, None])).prod(axis=-1)
        sign = np.where(self.white_diagonal, -1.0, 1.0)[:, None]
        return np.asarray(np.where(self.is_white(squares), 2.0 * sign * share, 0.0))

    def own_squares(self, places: FloatArray, size: IntArray) -> BoolArray:
        """(N, P) whether nothing is printed there but the corner's own squares, and it is nearest to this corner."""
        place = self.squares_at(places)
        side_px = np.linalg.norm(self.squares_px, axis=1)[:, None]  # (N, 1, 2)
        blur = _CLEAR_OF_PX / side_px  # in squares
        # Where squares are small, some pixels are shared: too few would be left.
        own = np.maximum(0.5, FIRST_RADIUS_PX / side_px)
        near = (np.abs(place) < np.minimum(own, 1.0 - blur)).all(axis=-1)
        in_marker = (np.abs(place) > self.clear - blur).all(axis=-1) & self.is_white(place)
        in_picture = ((places >= 0.0) & (places < size)).all(axis=-1)
        return np.asarray(near & ~in_marker & in_picture)


def bends(points_px: FloatArray) -> FloatArray:
    """(N, 3) second to fourth derivative of a line through five neighbouring points (N, 5, 2), at the middle one.

    As `Surroundings` has them: of its distance from its tangent, on the side of (-y, x) of the line's direction (x, y),
    by the way back along the tangent. NaN where points are none, or the same.
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
