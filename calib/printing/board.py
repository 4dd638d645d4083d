"""The calibration board on one sheet of paper."""

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from groundsbot.calib.board import DEFAULT_BOARD, CharucoBoard
from groundsbot.calib.errors import CalibError
from groundsbot.calib.foundation import BoolArray
from groundsbot.calib.printing.sheet import (
    HOW_TO_PRINT,
    Rectangle,
    Sheets,
    black_cells,
    paper_size_mm,
    room_on,
    write_sheets,
)


def print_board(board: CharucoBoard, paper: str, path: Path, overwrite: bool = False) -> None:
    """Write a PDF with the board true to scale, its specification, and a ruler along two edges.

    Raises:
        CalibError: the board does not fit on the paper in either orientation, the paper is unknown, or the file cannot
            be written.
    """
    with write_sheets(
        path, _paper_orientation(board, paper), f"groundsbot board {board.specification}", overwrite
    ) as sheets:
        sheets.rulers()
        _write_head(sheets, board)
        left_mm, top_mm, width_mm, height_mm = room_on((sheets.width_mm, sheets.height_mm))
        board_mm = board.size_mm
        x_mm, y_mm = left_mm + (width_mm - board_mm[0]) / 2, top_mm + (height_mm - board_mm[1]) / 2
        sheets.blacken(_black(board, x_mm, y_mm))
        sheets.end_sheet()


def _paper_orientation(board: CharucoBoard, paper: str) -> tuple[float, float]:
    """Return width and height of the paper in the orientation, portrait first, in which the board fits."""
    upright_mm = paper_size_mm(paper)
    wanted_mm = board.size_mm
    best = 0.0
    for size_mm in (upright_mm, upright_mm[::-1]):
        _, _, *room_mm = room_on(size_mm)
        share = min(room_mm[0] / wanted_mm[0], room_mm[1] / wanted_mm[1])
        if share >= 1.0:
            return size_mm
        best = max(best, share)
    largest_mm = np.floor(10.0 * best * board.square_mm) / 10.0
    raise CalibError(
        f"board of {wanted_mm[0]:g} x {wanted_mm[1]:g} mm does not fit on {paper} beside its rulers; "
        f"take squares of {largest_mm:g} mm at most, fewer of them, or larger paper"
    )


def _write_head(sheets: Sheets, board: CharucoBoard) -> None:
    option = "" if board == DEFAULT_BOARD else f"; --board {board.specification}"
    sheets.head(
        f"Calibration board {board.specification}",
        f"{board.columns} x {board.rows} squares of {board.square_mm:g} mm, markers of {board.marker_mm:g} mm, "
        f"dictionary {board.dictionary}{option}",
        f"{HOW_TO_PRINT} Glue it onto something flat and stiff.",
    )


def _black(board: CharucoBoard, x_mm: float, y_mm: float) -> Iterator[Rectangle]:
    """Yield the black areas of a board whose upper left corner is at x and y."""
    side_mm = board.square_mm
    charuco = board.charuco()
    marked = set[tuple[int, int]]()
    for marker_id, corners_m in zip(np.ravel(charuco.getIds()), charuco.getObjPoints(), strict=True):
        left_mm, top_mm = 1000.0 * np.asarray(corners_m)[:, :2].min(axis=0)
        marked.add((int(left_mm // side_mm), int(top_mm // side_mm)))
        bits = _marker_bits(charuco, int(marker_id))
        yield from black_cells(bits, x_mm + left_mm, y_mm + top_mm, board.marker_mm / len(bits))
    for row in range(board.rows):
        for column in range(board.columns):
            if (column, row) not in marked:
                yield Rectangle(x_mm + column * side_mm, y_mm + row * side_mm, side_mm, side_mm)


def _marker_bits(charuco: "cv2.aruco.CharucoBoard", marker_id: int) -> BoolArray:
    """Return the cells of a marker `[n, n]`, True for white, as OpenCV draws it."""
    dictionary = charuco.getDictionary()
    return np.asarray(dictionary.generateImageMarker(marker_id, dictionary.markerSize + 2) > 127)
