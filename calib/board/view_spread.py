"""How views of a board spread over a picture, over tilts and distances, and what they still miss, in words.

No calibration is needed to tell: near its middle a board is seen through an affine map, whose singular values are its
size and, by their ratio, its tilt against the picture's plane.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Final, cast

import cv2
import numpy as np

from groundsbot.calib.board.board import Board
from groundsbot.calib.foundation import FloatArray, IntArray

# A calibration is the less certain the farther it must reach beyond the corners seen; so the border counts for itself.
_BORDER: Final = 0.2  # of the picture's width and height
_ROWS: Final = ("top", "", "bottom")
_COLUMNS: Final = ("left", "", "right")
_LEAST_CORNERS: Final = 6  # a homography takes four
_CORNERS_IN_REGION: Final = 3
# Focal length and distance of a board that faces the camera are one unknown: only its tilt tells them apart.
_TILTED_DEG: Final = 20.0
_NEAR: Final = 0.5  # the board's diagonal, of the picture's
_FAR: Final = 0.35
_VIEWS_OF_EACH: Final = 2  # one may turn out to be of no use


@dataclass(frozen=True, eq=False)
class SeenBoard:
    """A board as one picture shows it.

    Attributes:
        ids: `[N]` of the inner corners seen, as OpenCV numbers them.
        pixels: `[N, 2]` where they are.
        regions: of the picture, by row and column of three each, in which some of them are.
        tilt_deg: `[2]` against the picture's plane, positive where its right side, its lower side is nearer; at the
            border of a wide picture something between that and the tilt against the line of sight.
        share: its diagonal, if it faced the camera, of the picture's.
    """

    ids: IntArray
    pixels: FloatArray
    regions: frozenset[tuple[int, int]]
    tilt_deg: FloatArray
    share: float


def describe_board(ids: IntArray, pixels: FloatArray, board: Board, size_px: tuple[int, int]) -> SeenBoard | None:
    """Describes a view.

    Args:
        ids: `[N]` of the inner corners seen.
        pixels: `[N, 2]` where they are.
        board: which.
        size_px: width and height of the picture.

    Returns:
        None where the corners are too few, or in one line, so that they tell nothing.
    """
    column, row = ids % (board.columns - 1), ids // (board.columns - 1)
    if len(ids) < _LEAST_CORNERS or np.ptp(column) == 0 or np.ptp(row) == 0:
        return None
    places = np.stack([column, row], axis=-1).astype(np.float64)
    places -= places.mean(axis=0)  # in squares
    # None where there is none, which OpenCV's stubs do not know.
    H = cast(FloatArray | None, cv2.findHomography(places, pixels)[0])
    if H is None:
        return None
    tilt_deg, size_px_per_square = _tilt_and_size(H)
    diagonal_px = size_px_per_square * float(np.hypot(board.columns, board.rows))
    return SeenBoard(ids, pixels, _regions(pixels, size_px), tilt_deg, diagonal_px / float(np.hypot(*size_px)))


def region_shares(row: int, column: int) -> tuple[FloatArray, FloatArray]:
    """Upper left and lower right corner of a region, `[2]` as shares of the picture's width and height."""
    edges = np.array([0.0, _BORDER, 1.0 - _BORDER, 1.0])
    return edges[[column, row]], edges[[column + 1, row + 1]]


class Coverage:
    """What the views so far cover."""

    def __init__(self, views: Iterable[SeenBoard] = ()) -> None:
        """Begins with some."""
        self._views = list(views)

    def add(self, view: SeenBoard) -> None:
        """One more."""
        self._views.append(view)

    def is_covered(self, row: int, column: int) -> bool:
        """Whether enough views show corners in a region of the picture."""
        return sum((row, column) in view.regions for view in self._views) >= _VIEWS_OF_EACH

    def missing(self) -> list[str]:
        """What to do next, the most needed first; nothing where the views do."""
        return [*self._regions_missing(), *self._tilts_missing(), *self._distances_missing()]

    def _regions_missing(self) -> Iterator[str]:
        bare = [
            " ".join(filter(None, (_ROWS[row], _COLUMNS[column]))) or "middle"
            for row in range(3)
            for column in range(3)
            if not self.is_covered(row, column)
        ]
        if bare:
            yield f"show the board at the picture's {', '.join(bare)}"

    def _tilts_missing(self) -> Iterator[str]:
        sides = [
            side
            for axis, sign, side in ((0, -1, "left"), (0, 1, "right"), (1, -1, "upper"), (1, 1, "lower"))
            if sum(sign * view.tilt_deg[axis] >= _TILTED_DEG for view in self._views) < _VIEWS_OF_EACH
        ]
        if sides:
            yield f"tilt the board, its {', '.join(sides)} side nearer to the camera"

    def _distances_missing(self) -> Iterator[str]:
        if sum(view.share >= _NEAR for view in self._views) < _VIEWS_OF_EACH:
            yield "bring the board nearer"
        if sum(view.share <= _FAR for view in self._views) < _VIEWS_OF_EACH:
            yield "take the board farther away"


def _tilt_and_size(H: FloatArray) -> tuple[FloatArray, float]:
    """Tilt as in `SeenBoard`, and how many pixels a square would measure if it were not foreshortened.

    H takes places on the board, (0, 0) its middle, to pixels. With w = H[2] . (x, y, 1) the derivative of the pixels is
    (H[:2, :2] - pixel H[2, :2]) / w, and the board is the nearer the smaller w is.
    """
    H = H / H[2, 2]
    J = H[:2, :2] - np.outer(H[:2, 2], H[2, :2])
    along, (large, small), _ = np.linalg.svd(J)
    tilt_deg = float(np.degrees(np.arccos(np.clip(small / large, 0.0, 1.0))))
    foreshortened = along[:, 1]  # the picture's direction in which the board runs off
    # The way on the board that leads in that direction, and how w changes on it.
    change = float(H[2, :2] @ np.linalg.solve(J, foreshortened))
    return -np.sign(change) * tilt_deg * foreshortened, float(large)


def _regions(pixels: FloatArray, size_px: tuple[int, int]) -> frozenset[tuple[int, int]]:
    shares = (pixels + 0.5) / size_px
    cells = (shares > _BORDER).astype(int) + (shares > 1.0 - _BORDER)
    found, counts = np.unique(cells, axis=0, return_counts=True)
    return frozenset(
        (int(y), int(x)) for (x, y), count in zip(found, counts, strict=True) if count >= _CORNERS_IN_REGION
    )
