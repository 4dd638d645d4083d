"""Boards of other makers, in pictures warped from an image of the print: found, numbered, calibrated with."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest

from groundsbot.calib.board.board import AprilGrid, Board, CharucoBoard, Chessboard, parse_board
from groundsbot.calib.board.detection import board_detector
from groundsbot.calib.board.finder import BoardFinder
from groundsbot.calib.camera.file import read_camera_yaml, read_estimate
from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.intrinsics.projection_uncertainty import PictureGrid, difference_px, rms_px
from groundsbot.calib.tags.family import tag_bits
from groundsbot.fixtures.pictures.textures import ByteArray
from tests.support.board_views import PLAIN, good_views, hold_board
from tests.support.programs import Run

PX_PER_MM = 4
MARGIN_MM = 15
FINER = 4  # a picture is warped so many times larger, then blurred and averaged
# All are about as large as the default board, so that they are held like it.
BOARDS = {
    "charuco": "5x7-34mm-24mm-aruco_original",
    "apriltags": "6x7-30mm-22mm-apriltag_36h11",
    "legacy": "7x8-26mm-19mm-4x4_50-legacy",
    "chessboard": "chessboard-6x8-25mm",
    "square": "chessboard-6x6-25mm",
    "aprilgrid": "aprilgrid-3x4-40mm-0.3",
    "one cell": "aprilgrid-2x3-60mm-0.25",
    "wide gaps": "aprilgrid-2x3-40mm-0.6",
}
TURNS = {"chessboard": (0, 2), "square": (0, 1, 2, 3)}  # numberings that a chessboard does not distinguish
QUARTER_TURN = np.array([[0.0, -1.0, 0.0, 0.19], [1.0, 0.0, 0.0, 0.02], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])


def print_image(board: Board) -> ByteArray:
    """The print at `PX_PER_MM`, with a white margin."""
    width, height = (round(side * PX_PER_MM) for side in board.size_mm)
    image = np.full((height, width), 255, np.uint8)
    if isinstance(board, CharucoBoard):
        image = np.asarray(board.charuco().generateImage((width, height), marginSize=0))
    elif isinstance(board, Chessboard):
        side = round(board.square_mm * PX_PER_MM)
        row, column = np.indices(image.shape) // side
        image[(row + column) % 2 == 0] = 0
    else:
        blacken(image, board, 1 if board == parse_board(BOARDS["one cell"]) else 2)
    return np.pad(image, MARGIN_MM * PX_PER_MM, constant_values=255)


def blacken(image: ByteArray, board: AprilGrid, border_cells: int) -> None:
    """Kalibr's print: tag 0 at the lower left, a black square at each corner of a tag."""
    gap, tag = (round(each * PX_PER_MM) for each in (board.gap_mm, board.tag_mm))
    for row in range(board.rows + 1):
        for column in range(board.columns + 1):
            y, x = row * (tag + gap), column * (tag + gap)
            image[y : y + gap, x : x + gap] = 0
            if row < board.rows and column < board.columns:
                bits = tag_bits("tag36h11", (board.rows - 1 - row) * board.columns + column)[1:-1, 1:-1]
                cells = np.pad(255 * bits.astype(np.uint8), border_cells)
                drawn = cv2.resize(cells, (tag, tag), interpolation=cv2.INTER_NEAREST)
                image[y + gap : y + gap + tag, x + gap : x + gap + tag] = drawn


def take_pictures(board: Board, poses: Sequence[FloatArray]) -> list[ByteArray]:
    image, rng = print_image(board), np.random.default_rng(0)
    to_m = np.array([[1.0, 0.0, 0.5 - MARGIN_MM * PX_PER_MM], [0.0, 1.0, 0.5 - MARGIN_MM * PX_PER_MM], [0.0, 0.0, 1.0]])
    to_m[:2] /= 1000.0 * PX_PER_MM
    camera = np.array([[PLAIN.fx_px, 0.0, PLAIN.cx_px], [0.0, PLAIN.fy_px, PLAIN.cy_px], [0.0, 0.0, 1.0]])
    finer = np.array([[FINER, 0.0, 0.5 * (FINER - 1)], [0.0, FINER, 0.5 * (FINER - 1)], [0.0, 0.0, 1.0]])
    shown = []
    for T in poses:
        H = finer @ camera @ T[:3, [0, 1, 3]] @ to_m
        large = cv2.warpPerspective(image, H, (640 * FINER, 480 * FINER), flags=cv2.INTER_AREA, borderValue=[90])
        light = cv2.resize(cv2.GaussianBlur(large, (0, 0), 0.6 * FINER), (640, 480), interpolation=cv2.INTER_AREA)
        shown.append(np.clip(30.0 + 0.75 * light + rng.normal(0.0, 1.0, light.shape), 0, 255).astype(np.uint8))
    return shown


@pytest.mark.parametrize("name", BOARDS)
def test_corners_are_found_to_a_fraction_of_a_pixel_and_numbered(name: str) -> None:
    board = parse_board(BOARDS[name])
    assert board.specification == BOARDS[name]
    finder = BoardFinder(board)
    poses = [hold_board((0.55, 0.5), 0.6, right_deg=20.0).T_camera_board, hold_board(share=0.5).T_camera_board]
    poses[1] = poses[1] @ QUARTER_TURN
    for T, picture in zip(poses, take_pictures(board, poses), strict=True):
        true = PLAIN.project(finder.corners_m @ T[:3, :3].T + T[:3, 3])
        first = finder.find(picture)
        assert first is not None
        assert len(first.corners.ids) >= len(true) - 4
        rows = true.reshape(-1, 6, 2)  # a chessboard's; other boards are numbered in one way only
        same = [np.rot90(rows, turn).reshape(-1, 2) for turn in TURNS.get(name, ())] or [true]
        assert min(rms_px(first.corners.pixels - each[first.corners.ids]) for each in same) < 0.03
        again = finder.find_again(first, PLAIN.project(finder.places_around_m() @ T[:3, :3].T + T[:3, 3]))
        assert len(again.corners.ids) == len(true)
        assert rms_px(again.corners.pixels - true) < 0.03


def test_small_tags_are_found_and_fitted_without_their_codes() -> None:
    board, T = parse_board(BOARDS["aprilgrid"]), hold_board((0.2, 0.3), 0.25, right_deg=20.0).T_camera_board
    finder, (picture,) = BoardFinder(board), take_pictures(board, [T])
    assert len(board_detector(board)(picture)[0]) >= 40
    view = finder.find(picture)
    assert view is not None
    true = PLAIN.project(finder.corners_m @ T[:3, :3].T + T[:3, 3])
    assert rms_px(view.corners.pixels - true[view.corners.ids]) < 0.045


def test_a_camera_is_calibrated_and_checked_with_a_grid_of_tags(calib: Run, tmp_path: Path) -> None:
    word = BOARDS["aprilgrid"]
    for index, picture in enumerate(take_pictures(parse_board(word), [view.T_camera_board for view in good_views()])):
        assert cv2.imwrite(str(tmp_path / f"{index}.png"), picture)
    output = tmp_path / "camera.yaml"
    outcome = calib("camera", tmp_path, "-o", output, "--model", "plumb_bob", "--board", word)
    assert outcome.code == 0, outcome.err
    assert f"board {word} is seen in 12 of 12 pictures, 12 views used" in outcome.out
    estimate = read_estimate(output)
    assert estimate is not None
    assert rms_px(difference_px(read_camera_yaml(output), PictureGrid.of(PLAIN))) < estimate.expected_error_px < 0.1
    outcome = calib("check", output, tmp_path, "--board", word)
    assert outcome.code == 0, outcome.err
    assert f"board {word} is seen in 12 of 12 pictures" in outcome.out


@pytest.mark.parametrize(
    ("shown", "word", "said"),
    [
        ("legacy", "7x8-26mm-19mm-4x4_50", "but 7x8-26mm-19mm-4x4_50-legacy is; give that as --board"),
        ("chessboard", "chessboard-7x9-25mm", "but chessboard-6x8-25mm is"),
        ("aprilgrid", "aprilgrid-4x3-40mm-0.3", "but aprilgrid-3x4-40mm-0.3 is; give that as --board"),
        ("legacy", "chessboard-6x8-25mm", "but 28 markers of dictionary 4x4_1000"),
        ("aprilgrid", "aprilgrid-5x5-40mm-0.3", "but 12 markers of its dictionary apriltag_36h11"),
        ("square", "aprilgrid-4x3-40mm-0.3", "nor any markers"),
    ],
)
def test_another_board_is_named(calib: Run, tmp_path: Path, shown: str, word: str, said: str) -> None:
    pose = hold_board(share=0.6, right_deg=20.0).T_camera_board
    assert cv2.imwrite(str(tmp_path / "a.png"), take_pictures(parse_board(BOARDS[shown]), [pose])[0])
    outcome = calib("camera", tmp_path / "a.png", "-o", tmp_path / "camera.yaml", "--board", word)
    assert (outcome.code, outcome.err.count("\n")) == (1, 1)
    assert f"board {word} is not seen clearly in any of 1 picture, {said}" in outcome.err
