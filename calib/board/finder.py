"""Detection of a calibration board: `detection` finds and numbers corners, `corner_fit` refines them."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from groundsbot.calib.board.board import Board
from groundsbot.calib.board.corner_fit import FIRST_BLUR_PX, Corners, fit_corners
from groundsbot.calib.board.corner_surroundings import FIRST_RADIUS_PX, RADIUS_PX, Surroundings, bends
from groundsbot.calib.board.detection import board_detector
from groundsbot.calib.board.layout import board_layout
from groundsbot.calib.foundation import FloatArray, IntArray

_LOCAL: Final = 1.2  # sigma, in spacings, of the weights with which other corners determine the edges' directions
_LEAST_CORNERS: Final = 6  # four determine a homography, two more test it
_STEP: Final = 0.25  # in squares


@dataclass(frozen=True)
class BoardView:
    """A picture in which the board was found."""

    name: str
    picture: NDArray[np.uint8]
    corners: Corners


class BoardFinder:
    """Detector of one board.

    Attributes:
        board: the board.
        corners_m: (K, 3) all corners, in the board's frame.
    """

    def __init__(self, board: Board) -> None:
        self.board = board
        self._detect = board_detector(board)
        self._layout = board_layout(board)
        self.corners_m: FloatArray = self._layout.corners_m

    def find(self, picture: NDArray[np.uint8], name: str = "") -> BoardView | None:
        """Return the view of the board in a grey picture `[H, W]`, or None with fewer than six accepted corners."""
        numbers, pixels = self._detect(picture)
        if len(numbers) < _LEAST_CORNERS:
            return None
        squares, straight = self._local_squares(numbers, pixels), np.zeros((len(numbers), 2, 3))
        growth, blur_px = np.zeros((len(numbers), 2, 3)), np.full(len(numbers), FIRST_BLUR_PX)
        around = self._surroundings(numbers, pixels, squares, growth, straight, blur_px, FIRST_RADIUS_PX)
        corners = fit_corners(picture, numbers, around)
        return BoardView(name, picture, corners) if len(corners.ids) >= _LEAST_CORNERS else None

    def find_again(self, view: BoardView, projected_px: FloatArray) -> BoardView:
        """Return the view with its corners fitted again, at positions and with bends predicted by a camera.

        Args:
            view: the view as found so far.
            projected_px: (K, 13, 2) projections of `places_around_m`.
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
        """Return (K, 13, 3) points around each corner, in the board's frame.

        The first nine form a 3 by 3 grid with a step of a quarter of a square, row by row. The others lie half a square
        before and behind the corner along x, then along y.
        """
        near = [(x, y, 0) for y in (-1, 0, 1) for x in (-1, 0, 1)]
        steps = np.array([*near, (-2, 0, 0), (2, 0, 0), (0, -2, 0), (0, 2, 0)], dtype=np.float64)
        return np.asarray(self.corners_m[:, None] + _STEP * self._layout.square_m * steps)

    @staticmethod
    def largest_shift_px(before_px: FloatArray, after_px: FloatArray) -> FloatArray:
        """Return upper bounds (...) of the shift of corners that a change of the edges' bends causes.

        The shift is the mean over an edge of its deviation from the tangent, which is a third of the deviation at the
        end.

        Args:
            before_px: (..., 13, 2) points around each corner as in `places_around_m`, projected before the change.
            after_px: (..., 13, 2) the same after the change.
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
        white = self._layout.white_diagonal[ids]
        return Surroundings(pixels, squares, growth, white, bend, blur_px, self._layout.clear, radius_px)

    def _local_squares(self, ids: IntArray, pixels: FloatArray) -> FloatArray:
        """Return (N, 2, 2) shifts in the picture for one square, by an affine map fitted around each corner."""
        places = self.corners_m[ids, :2] / self._layout.spacing_m
        off, moved = places[None] - places[:, None], pixels[None] - pixels[:, None]
        weight = np.exp(-0.5 * (off**2).sum(axis=-1) / _LOCAL**2)
        normal = np.einsum("nm,nmi,nmj->nij", weight, off, off) + 1e-9 * np.eye(2)
        right = np.einsum("nm,nmi,nmj->nij", weight, off, moved)
        by_spacing = np.linalg.solve(normal, right).swapaxes(-1, -2)
        return np.asarray(by_spacing * (self._layout.square_m / self._layout.spacing_m))
