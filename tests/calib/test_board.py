"""The calibration board: printed, scanned, found again by OpenCV; and the word that names it."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from groundsbot.calib.board.board import DEFAULT_BOARD, CharucoBoard, parse_board
from groundsbot.calib.errors import CalibError
from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.printing.board import print_board
from tests.support.scanned_prints import n_pages, scan_page, words

DPI = 300.0


@pytest.mark.parametrize(
    ("board", "paper"),
    [
        (DEFAULT_BOARD, "a4"),
        (DEFAULT_BOARD, "letter"),
        (CharucoBoard(8, 5, 30.0, 22.5, "4x4_50"), "a4"),
        (CharucoBoard(4, 4, 61.3, 40.0, "6x6_250"), "a3"),
    ],
)
def test_the_printed_board_is_found_at_its_true_size(tmp_path: Path, board: CharucoBoard, paper: str) -> None:
    pdf = tmp_path / "board.pdf"
    print_board(board, paper, pdf)
    assert n_pages(pdf) == 1
    said = words(pdf)
    assert board.specification in said
    assert ("--board" in said) == (board != DEFAULT_BOARD)

    scan = scan_page(pdf, DPI)
    corners, ids, _, marker_ids = cv2.aruco.CharucoDetector(board.charuco()).detectBoard(scan.picture)
    assert len(marker_ids) == board.n_markers
    assert len(ids) == (board.columns - 1) * (board.rows - 1)
    found_mm = scan.place_mm(np.asarray(corners, np.float64).reshape(-1, 2))
    expected_mm = 1000.0 * np.asarray(board.charuco().getChessboardCorners(), np.float64)[ids.ravel(), :2]
    # The same but for a shift: not turned, not mirrored, not scaled.
    off_mm = found_mm - found_mm.mean(axis=0) - (expected_mm - expected_mm.mean(axis=0))
    assert np.abs(off_mm).max() < 0.1
    assert _scale(found_mm, expected_mm) * board.square_mm == pytest.approx(board.square_mm, abs=0.01)


def _scale(found: FloatArray, expected: FloatArray) -> float:
    """How many times as large, by least squares about the middle."""
    found, expected = found - found.mean(axis=0), expected - expected.mean(axis=0)
    return float((found * expected).sum() / (expected * expected).sum())


@pytest.mark.parametrize("board", [DEFAULT_BOARD, CharucoBoard(5, 12, 12.5, 9.25, "7x7_1000")])
def test_a_board_is_known_by_its_word(board: CharucoBoard) -> None:
    assert parse_board(board.specification) == board


@pytest.mark.parametrize(
    ("word", "said"),
    [
        ("", "must read like 7x9-25mm-18mm-5x5_100"),
        ("7x9", "'7x9' but must read like"),
        ("7x9-25mm-18mm-8x8_100", "'8x8_100' but must be one of 4x4_50"),
        ("7x2-25mm-18mm-5x5_100", "at least 3x3"),
        ("7x9-25mm-25mm-5x5_100", "at most 0.9 of the square"),
        ("7x9-0mm-0mm-5x5_100", "must be above 0"),
        ("12x12-25mm-18mm-5x5_50", "takes 72 markers but 5x5_50 has 50"),
        ("chessboard-9x6", "must read like 7x9-25mm-18mm-5x5_100 (copy it from the print), chessboard-9x6-25mm"),
        ("chessboard-2x6-25mm", "at least 3x3 inner corners"),
        ("chessboard-9x6-0mm", "squares above 0 mm"),
        ("aprilgrid-6x6-88mm-26.4", "the spacing 0.1 to 1; give the gap between two tags over the side of a tag"),
        ("aprilgrid-6x6-0mm-0.3", "tags must be above 0 mm"),
        ("aprilgrid-30x30-20mm-0.3", "must have 2 to 587 tags"),
        ("11x8-30mm-22mm-apriltag_16h5", "takes 44 markers but apriltag_16h5 has 30"),
    ],
)
def test_a_word_that_names_no_board_is_refused(word: str, said: str) -> None:
    with pytest.raises(CalibError, match=r"^[^\n]+$") as caught:
        parse_board(word)
    assert said in str(caught.value)
