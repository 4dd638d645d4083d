"""Coverage of the picture, of tilts and of distances by views of a board, and hints on the views still missing.

This needs no calibration. Near its middle a board is imaged by an affine map. The larger singular value gives the
scale, and the ratio of the two gives the tilt against the picture plane.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Final, cast

import cv2
import numpy as np

from groundsbot.calib.board.board import Board
from groundsbot.calib.board.layout import board_layout
from groundsbot.calib.foundation import FloatArray, IntArray

# The uncertainty of a calibration grows with the distance from the nearest observed corners, so the border is a region
# of its own.
_BORDER: Final = 0.2  # of the picture's width and height
_ROWS: Final = ("top", "", "bottom")
_COLUMNS: Final = ("left", "", "right")
_LEAST_CORNERS: Final = 6  # four determine a homography
_CORNERS_IN_REGION: Final = 3
# Focal length and distance of a board parallel to the picture are not separately observable; tilted views are needed.
_TILTED_DEG: Final = 20.0
_NEAR: Final = 0.5  # the board's diagonal over the picture's
_FAR: Final = 0.35
_VIEWS_OF_EACH: Final = 2  # one view may be rejected later


@dataclass(frozen=True, eq=False)
class SeenBoard:
    """A board as seen in one picture.

    Attributes:
        ids: `[N]` numbers of the corners seen.
        pixels: `[N, 2]` their positions.
        regions: rows and columns of the regions, three by three, that contain some of them.
        tilt_deg: `[2]` tilt against the picture plane, positive where the right side, or the lower side, is nearer. At
            the border of a wide-angle picture it lies between that and the tilt against the line of sight.
        share: diagonal of the board, as if parallel to the picture, over the picture's diagonal.
    """

    ids: IntArray
    pixels: FloatArray
    regions: frozenset[tuple[int, int]]
    tilt_deg: FloatArray
    share: float


def describe_board(ids: IntArray, pixels: FloatArray, board: Board, size_px: tuple[int, int]) -> SeenBoard | None:
    """Describe a view.

    Args:
        ids: `[N]` numbers of the corners seen.
        pixels: `[N, 2]` their positions.
        board: the board.
        size_px: width and height of the picture.

    Returns:
        The description, or None with fewer than six corners or with all corners in one line.
    """
    places = 1000.0 * board_layout(board).corners_m[ids, :2]  # in mm
    if len(ids) < _LEAST_CORNERS or (np.ptp(places, axis=0) == 0.0).any():
        return None
    places -= places.mean(axis=0)
    # findHomography returns None on failure; OpenCV's stubs do not declare that.
    H = cast(FloatArray | None, cv2.findHomography(places, pixels)[0])
    if H is None:
        return None
    tilt_deg, px_per_mm = _tilt_and_size(H)
    diagonal_px = px_per_mm * float(np.hypot(*board.size_mm))
    return SeenBoard(ids, pixels, _regions(pixels, size_px), tilt_deg, diagonal_px / float(np.hypot(*size_px)))


def region_shares(row: int, column: int) -> tuple[FloatArray, FloatArray]:
    """Return upper left and lower right corner of a region, `[2]` as shares of the picture's width and height."""
    edges = np.array([0.0, _BORDER, 1.0 - _BORDER, 1.0])
    return edges[[column, row]], edges[[column + 1, row + 1]]


class Coverage:
    """Coverage by the views so far."""

    def __init__(self, views: Iterable[SeenBoard] = ()) -> None:
        self._views = list(views)

    def add(self, view: SeenBoard) -> None:
        """Add a view."""
        self._views.append(view)

    def is_covered(self, row: int, column: int) -> bool:
        """Return whether enough views show corners in a region of the picture."""
        return sum((row, column) in view.regions for view in self._views) >= _VIEWS_OF_EACH

    def missing(self) -> list[str]:
        """Return hints on the views still needed, most important first; empty if the views suffice."""
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
    """Return the tilt as in `SeenBoard` and the pixels of a millimetre without foreshortening.

    H maps board coordinates, with (0, 0) in the middle, to pixels. With w = H[2] . (x, y, 1) the derivative of the
    pixels is (H[:2, :2] - pixel H[2, :2]) / w. A smaller w means a nearer point of the board.
    """
    H = H / H[2, 2]
    J = H[:2, :2] - np.outer(H[:2, 2], H[2, :2])
    along, (large, small), _ = np.linalg.svd(J)
    tilt_deg = float(np.degrees(np.arccos(np.clip(small / large, 0.0, 1.0))))
    foreshortened = along[:, 1]  # direction of the tilt in the picture
    # Change of w along the direction on the board that is imaged to it.
    change = float(H[2, :2] @ np.linalg.solve(J, foreshortened))
    return -np.sign(change) * tilt_deg * foreshortened, float(large)


def _regions(pixels: FloatArray, size_px: tuple[int, int]) -> frozenset[tuple[int, int]]:
    shares = (pixels + 0.5) / size_px
    cells = (shares > _BORDER).astype(int) + (shares > 1.0 - _BORDER)
    found, counts = np.unique(cells, axis=0, return_counts=True)
    return frozenset(
        (int(y), int(x)) for (x, y), count in zip(found, counts, strict=True) if count >= _CORNERS_IN_REGION
    )
