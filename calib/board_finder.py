"""A calibration board in a picture: OpenCV finds markers and numbers corners, `corner_fit` says where they are."""

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.arrays import BoolArray, FloatArray, IntArray
from calib.board import Board
from calib.corner_fit import FIRST_RADIUS_PX, RADIUS_PX, Corners, Surroundings, bends, fitted_corners

_LOCAL_SQUARES: Final = 1.2  # sigma: how far around a corner others tell the direction of its edges
_LEAST_CORNERS: Final = 6  # a homography takes four; two more to test it
_BEND_STEP: Final = 0.25  # of a square


@dataclass(frozen=True)
class View:
    """A picture in which the board was found."""

    name: str
    picture: NDArray[np.uint8]
    corners: Corners


class BoardFinder:
    """Finds one board."""

    def __init__(self, board: Board) -> None:
        charuco = board.charuco()
        self._detector = cv2.aruco.CharucoDetector(charuco)
        self._board = board
        places = np.asarray(charuco.getChessboardCorners(), dtype=np.float64)
        self.corners_m: FloatArray = places  # (K, 3) of all inner corners, in the board's frame
        column, row = np.arange(len(places)) % (board.columns - 1), np.arange(len(places)) // (board.columns - 1)
        self._white_diagonal: BoolArray = (column + row) % 2 == 1
        self._clear = 0.5 * (1.0 - board.marker_mm / board.square_mm)

    def find(self, picture: NDArray[np.uint8], name: str = "") -> View | None:
        """The board in a grey picture `[H, W]`; None where fewer than six corners of it are seen clearly."""
        found, ids, _, _ = self._detector.detectBoard(picture)
        if np.size(ids) < _LEAST_CORNERS:  # None where there are none at all
            return None
        numbers, pixels = ids.ravel().astype(np.int64), found.reshape(-1, 2).astype(np.float64)
        squares, straight = self._local_squares(numbers, pixels), np.zeros((len(numbers), 2))
        around = self._surroundings(numbers, pixels, squares, straight, FIRST_RADIUS_PX)
        corners = fitted_corners(picture, numbers, around)
        return View(name, picture, corners) if len(corners.ids) >= _LEAST_CORNERS else None

    def find_again(self, view: View, projected_px: FloatArray) -> View:
        """The same view where a camera tells which corners are in the picture and how the edges bend.

        Args:
            view: the view.
            projected_px: (K, 5, 2) where `places_around_m` are projected.
        """
        at, left, right, above, below = np.moveaxis(projected_px, 1, 0)
        squares = np.stack([right - left, below - above], axis=-1) / (2.0 * _BEND_STEP)
        bend = np.stack([bends(left, at, right), bends(above, at, below)], axis=-1)
        ids = np.arange(len(at))
        around = self._surroundings(ids, at, squares, bend, RADIUS_PX)
        return View(view.name, view.picture, fitted_corners(view.picture, ids, around))

    def places_around_m(self) -> FloatArray:
        """(K, 5, 3) in the board's frame, each corner, a quarter of a square before and behind it along x, then y."""
        step_m = _BEND_STEP * self._board.square_mm / 1000.0
        steps = step_m * np.array([[0, 0, 0], [-1, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0]], dtype=np.float64)
        return np.asarray(self.corners_m[:, None] + steps)

    def _surroundings(
        self, ids: IntArray, pixels: FloatArray, squares: FloatArray, bend: FloatArray, radius_px: int
    ) -> Surroundings:
        return Surroundings(pixels, squares, self._white_diagonal[ids], bend, self._clear, radius_px)

    def _local_squares(self, ids: IntArray, pixels: FloatArray) -> FloatArray:
        """(N, 2, 2) how far one square leads near each corner: an affine map fitted to the corners around it."""
        places = self.corners_m[ids, :2] / (self._board.square_mm / 1000.0)
        off, moved = places[None] - places[:, None], pixels[None] - pixels[:, None]
        weight = np.exp(-0.5 * (off**2).sum(axis=-1) / _LOCAL_SQUARES**2)
        normal = np.einsum("nm,nmi,nmj->nij", weight, off, off) + 1e-9 * np.eye(2)
        right = np.einsum("nm,nmi,nmj->nij", weight, off, moved)
        return np.linalg.solve(normal, right).swapaxes(-1, -2)
