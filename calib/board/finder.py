"""A calibration board in a picture: OpenCV finds markers and numbers corners, `corner_fit` says where they are."""

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from groundsbot.calib.board.board import Board
from groundsbot.calib.board.corner_fit import FIRST_BLUR_PX, Corners, fit_corners
from groundsbot.calib.board.corner_surroundings import FIRST_RADIUS_PX, RADIUS_PX, Surroundings, bends
from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray

_LOCAL_SQUARES: Final = 1.2  # sigma: how far around a corner others tell the direction of its edges
_LEAST_CORNERS: Final = 6  # a homography takes four; two more to test it
_STEP: Final = 0.25  # of a square


@dataclass(frozen=True)
class BoardView:
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

    def find(self, picture: NDArray[np.uint8], name: str = "") -> BoardView | None:
        """The board in a grey picture `[H, W]`; None where fewer than six corners of it are seen clearly."""
        found, ids, _, _ = self._detector.detectBoard(picture)
        if np.size(ids) < _LEAST_CORNERS:  # None where there are none at all
            return None
        numbers, pixels = ids.ravel().astype(np.int64), found.reshape(-1, 2).astype(np.float64)
        squares, straight = self._local_squares(numbers, pixels), np.zeros((len(numbers), 2, 3))
        growth, blur_px = np.zeros((len(numbers), 2, 3)), np.full(len(numbers), FIRST_BLUR_PX)
        around = self._surroundings(numbers, pixels, squares, growth, straight, blur_px, FIRST_RADIUS_PX)
        corners = fit_corners(picture, numbers, around)
        return BoardView(name, picture, corners) if len(corners.ids) >= _LEAST_CORNERS else None

    def find_again(self, view: BoardView, projected_px: FloatArray) -> BoardView:
        """The same view where a camera tells which corners are in the picture and how the edges bend.

        Args:
            view: the view.
            projected_px: (K, 13, 2) where `places_around_m` are projected.
        """
        at = projected_px[:, 4]
        before, after = projected_px[:, [3, 1]], projected_px[:, [5, 7]]  # along x, along y
        squares = (after - before).swapaxes(-1, -2) / (2.0 * _STEP)
        twice = (after - 2.0 * at[:, None] + before) / _STEP**2
        mixed = (projected_px[:, [0, 8]] - projected_px[:, [2, 6]]).sum(axis=1) / (2.0 * _STEP) ** 2
        growth = np.stack([twice[:, 0], mixed, twice[:, 1]], axis=-1)
        bend = np.stack([bends(projected_px[:, line]) for line in ([9, 3, 4, 5, 10], [11, 1, 4, 7, 12])], axis=1)
        blur_px = np.full(len(at), np.median(view.corners.blur_px) if len(view.corners.ids) else FIRST_BLUR_PX)
        ids = np.arange(len(at))
        around = self._surroundings(ids, at, squares, growth, bend, blur_px, RADIUS_PX)
        return BoardView(view.name, view.picture, fit_corners(view.picture, ids, around))

    def places_around_m(self) -> FloatArray:
        """(K, 13, 3) in the board's frame, around each corner.

        First 3 by 3 places a quarter of a square apart, row by row, then those half a square before and behind it along
        x, and along y.
        """
        near = [(x, y, 0) for y in (-1, 0, 1) for x in (-1, 0, 1)]
        steps = np.array([*near, (-2, 0, 0), (2, 0, 0), (0, -2, 0), (0, 2, 0)], dtype=np.float64)
        return np.asarray(self.corners_m[:, None] + _STEP * self._board.square_mm / 1000.0 * steps)

    @staticmethod
    def largest_shift_px(before_px: FloatArray, after_px: FloatArray) -> FloatArray:
        """How far at most corners move where edges bend otherwise, of places (..., 13, 2) around them before and after.

        By the mean over the edge of what it bends away from its tangent: a third of that at its end.
        """
        ends = np.array([[9, 10], [11, 12]])
        bent = [0.5 * places[..., ends, :].sum(axis=-2) - places[..., 4:5, :] for places in (before_px, after_px)]
        half_px = 0.5 * np.linalg.norm(np.diff(after_px[..., ends, :], axis=-2)[..., 0, :], axis=-1)
        seen = np.minimum(RADIUS_PX / np.maximum(half_px, 1e-12), 1.0) ** 2
        return np.asarray(np.linalg.norm((bent[1] - bent[0]) * seen[..., None], axis=(-2, -1)) / 3.0)

    def _surroundings(
        self, ids: IntArray, pixels: FloatArray, squares: FloatArray, growth: FloatArray, bend: FloatArray,
        blur_px: FloatArray, radius_px: int,
    ) -> Surroundings:  # fmt: skip
        white = self._white_diagonal[ids]
        return Surroundings(pixels, squares, growth, white, bend, blur_px, self._clear, radius_px)

    def _local_squares(self, ids: IntArray, pixels: FloatArray) -> FloatArray:
        """(N, 2, 2) how far one square leads near each corner: an affine map fitted to the corners around it."""
        places = self.corners_m[ids, :2] / (self._board.square_mm / 1000.0)
        off, moved = places[None] - places[:, None], pixels[None] - pixels[:, None]
        weight = np.exp(-0.5 * (off**2).sum(axis=-1) / _LOCAL_SQUARES**2)
        normal = np.einsum("nm,nmi,nmj->nij", weight, off, off) + 1e-9 * np.eye(2)
        right = np.einsum("nm,nmi,nmj->nij", weight, off, moved)
        return np.linalg.solve(normal, right).swapaxes(-1, -2)
