"""Detection of a board's corners by OpenCV, to a pixel or better, and their numbers; `corner_fit` refines them."""

from collections.abc import Callable
from itertools import product
from typing import Any, Final, TypeAlias, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from groundsbot.calib.board.board import AprilGrid, Board, Chessboard
from groundsbot.calib.board.layout import board_layout
from groundsbot.calib.foundation import FloatArray, IntArray

BoardDetector: TypeAlias = Callable[[NDArray[np.uint8]], tuple[IntArray, FloatArray]]
_NONE: Final[tuple[IntArray, FloatArray]] = np.zeros(0, dtype=np.int64), np.zeros((0, 2))
_LEAST_TAGS: Final = 2
_BORDER_CELLS: Final = (2, 1)  # width of the black border of tags: Kalibr's, and others'
_SIZES: Final = (1, 2)  # times the picture's; thin borders of small tags are found in the enlarged picture only
_FARTHEST: Final = 0.5  # sides of a tag, median distance from a homography: up to 0.3 in a fisheye, 0.8 on other boards
_SUBPIXEL_PX: Final = 3  # half the window of the first refinement of tags' corners


def board_detector(board: Board) -> BoardDetector:
    """Return a function of a grey picture `[H, W]` that returns numbers (N,) and pixels (N, 2) of the corners found."""
    if isinstance(board, Chessboard):
        return lambda picture: _chessboard_corners(board, picture)
    if isinstance(board, AprilGrid):
        detectors = tag_detectors()
        return lambda picture: _grid_corners(board, detectors, picture)
    charuco = cv2.aruco.CharucoDetector(board.charuco())

    def detect(picture: NDArray[np.uint8]) -> tuple[IntArray, FloatArray]:
        # OpenCV returns None without corners; its stubs do not declare that.
        pixels, ids = cast(tuple[Any, Any], charuco.detectBoard(picture)[:2])
        return _NONE if ids is None else (np.ravel(ids).astype(np.int64), _points(pixels))

    return detect


def tag_detectors() -> "list[cv2.aruco.ArucoDetector]":
    """Return OpenCV's detectors of tags 36h11, one for each width of the black border."""
    tags, detectors = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11), []
    for cells in _BORDER_CELLS:
        parameters = cv2.aruco.DetectorParameters()
        parameters.markerBorderBits = cells
        detectors.append(cv2.aruco.ArucoDetector(tags, parameters))
    return detectors


def _chessboard_corners(board: Chessboard, picture: NDArray[np.uint8]) -> tuple[IntArray, FloatArray]:
    """Return all corners of a chessboard, or none; where a turn of the board looks the same, numbered in one way."""
    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE
    found, pixels = cv2.findChessboardCornersSB(picture, (board.columns, board.rows), flags=flags)
    return (np.arange(board.rows * board.columns), _points(pixels)) if found else _NONE


def _grid_corners(
    board: AprilGrid, detectors: "list[cv2.aruco.ArucoDetector]", picture: NDArray[np.uint8]
) -> tuple[IntArray, FloatArray]:
    """Return the corners of the tags found, whichever way the tags are turned in the grid."""
    tags: IntArray = np.zeros(0, dtype=np.int64)
    pixels = np.zeros((0, 4, 2))
    for size, detector in product(_SIZES, detectors):
        if len(tags) == board.columns * board.rows:
            break
        large = cv2.resize(picture, None, fx=size, fy=size, interpolation=cv2.INTER_CUBIC) if size > 1 else picture
        corners, found, _ = cast(tuple[Any, Any, Any], detector.detectMarkers(large))
        ids = np.zeros(0, dtype=np.int64) if found is None else np.ravel(found).astype(np.int64)
        once = np.isin(ids, [each for each in range(board.columns * board.rows) if (ids == each).sum() == 1])
        if once.sum() > len(tags):
            tags, pixels = ids[once], (_points(corners).reshape(-1, 4, 2)[once] + 0.5) / size - 0.5
    if len(tags) < _LEAST_TAGS:
        return _NONE
    layout = board_layout(board)
    left, top = 2 * (tags % board.columns), 2 * (board.rows - 1 - tags // board.columns)
    upper = top * layout.columns + left
    clockwise = np.stack([upper, upper + 1, upper + layout.columns + 1, upper + layout.columns], axis=-1)
    off_px, numbers = min(
        ((_homography_error_px(layout.corners_m[each.ravel(), :2], pixels.reshape(-1, 2)), each) for each in
         (np.roll(clockwise, turn, axis=1) for turn in range(4))), key=lambda each: each[0],
    )  # fmt: skip
    side_px = float(np.median(np.linalg.norm(np.diff(pixels, axis=1), axis=-1)))
    if not off_px < _FARTHEST * side_px:
        return _NONE
    start = np.ascontiguousarray(pixels.reshape(-1, 1, 2), dtype=np.float32)
    end = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 20, 0.01)
    return numbers.ravel(), _points(cv2.cornerSubPix(picture, start, (_SUBPIXEL_PX, _SUBPIXEL_PX), (-1, -1), end))


def _homography_error_px(places_m: FloatArray, pixels: FloatArray) -> float:
    """Return the median distance of pixels (N, 2) from the homography fitted to them, infinite if there is none."""
    H = cast(FloatArray | None, cv2.findHomography(places_m, pixels)[0])
    if H is None:
        return np.inf
    mapped = cv2.perspectiveTransform(places_m[:, None], H)[:, 0]
    return float(np.median(np.linalg.norm(mapped - pixels, axis=1)))


def _points(found: object) -> FloatArray:
    return np.asarray(found, dtype=np.float64).reshape(-1, 2)
