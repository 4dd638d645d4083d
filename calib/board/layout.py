"""Positions of a board's corners, and what is printed around them."""

from dataclasses import dataclass
from functools import cache
from typing import Final

import numpy as np

from groundsbot.calib.board.board import AprilGrid, Board, CharucoBoard, Chessboard
from groundsbot.calib.foundation import BoolArray, FloatArray

_NO_MARKER: Final = 2.0  # of `clear`: beyond the squares that meet at a corner
_TAG_BORDER: Final = 0.2  # width over the side of a tag, in Kalibr's prints; twice what is used where it is 0.125


@dataclass(frozen=True, eq=False)
class BoardLayout:
    """The K corners of a board, numbered row by row from the upper left.

    Their frame has its origin at the outer corner of the print at the upper left, x right, y down, z into the paper.

    Attributes:
        corners_m: (K, 3).
        columns: number of corners in a row.
        square_m: side of the even black and white squares that meet at a corner.
        spacing_m: largest distance of two neighbouring corners of a row.
        white_diagonal: (K,) whether the square towards positive x and y is white.
        clear: width of the white margin around a marker, in squares.
    """

    corners_m: FloatArray
    columns: int
    square_m: float
    spacing_m: float
    white_diagonal: BoolArray
    clear: float


@cache
def board_layout(board: Board) -> BoardLayout:
    """Return the layout of a board."""
    clear, inverse = _NO_MARKER, False
    if isinstance(board, AprilGrid):
        across_mm, down_mm = (_tag_edges_mm(board, n_tags) for n_tags in (board.columns, board.rows))
        square_mm, spacing_mm = min(board.gap_mm, _TAG_BORDER * board.tag_mm), max(board.tag_mm, board.gap_mm)
    else:
        square_mm = spacing_mm = board.square_mm
        less = 0 if isinstance(board, Chessboard) else 1  # squares are one more than inner corners
        across_mm, down_mm = (square_mm * np.arange(1.0, count - less + 1) for count in (board.columns, board.rows))
    if isinstance(board, CharucoBoard):
        clear, inverse = 0.5 * (1.0 - board.marker_mm / square_mm), board.legacy and board.rows % 2 == 0
    x, y = np.meshgrid(across_mm / 1000.0, down_mm / 1000.0)
    row, column = np.indices(x.shape)
    return BoardLayout(
        np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3), len(across_mm), square_mm / 1000.0,
        spacing_mm / 1000.0, ((column + row) % 2 == (0 if inverse else 1)).ravel(), clear,
    )  # fmt: skip


def _tag_edges_mm(board: AprilGrid, n_tags: int) -> FloatArray:
    """Return (2 n_tags,) the first and second edge of each tag along one side of the grid."""
    first_mm = board.gap_mm + (board.tag_mm + board.gap_mm) * np.arange(n_tags)
    return np.stack([first_mm, first_mm + board.tag_mm], axis=-1).ravel()
