"""Reasons why a board is not found in pictures: mirrored, another pattern or board, or none."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import cv2
import numpy as np

from groundsbot.calib.board.board import AprilGrid, Board, CharucoBoard, Chessboard
from groundsbot.calib.board.detection import tag_detectors
from groundsbot.calib.board.finder import BoardFinder
from groundsbot.calib.board.picture_source import GreyPicture

_LOOKED_AT: Final = 5
_LEAST_MARKERS: Final = 4  # false detections of single markers occur
_OTHERS: Final = ("4X4_1000", "5X5_1000", "6X6_1000", "7X7_1000", "APRILTAG_36h11", "ARUCO_ORIGINAL")


def why_no_board(pictures: Sequence[GreyPicture], board: Board, finder: BoardFinder) -> str:
    """Return what pictures without the board show instead, and the way out, as the end of a sentence."""
    some = [pictures[index] for index in np.linspace(0, len(pictures) - 1, min(_LOOKED_AT, len(pictures))).astype(int)]
    if any(finder.find(np.ascontiguousarray(picture[:, ::-1])) is not None for picture in some):
        return (
            "but its mirror image is; the print or the pictures are flipped left to right: print it again, or switch "
            "the camera's mirroring off"
        )
    for other in _alternatives(board):
        if any(BoardFinder(other).find(picture) is not None for picture in some):
            return f"but {other.specification} is; give that as --board"
    if isinstance(board, CharucoBoard):
        ours, dictionary = max(_markers(picture, board.charuco().getDictionary()) for picture in some), board.dictionary
    elif isinstance(board, AprilGrid):
        dictionary = "apriltag_36h11"
        ours = max(len(detector.detectMarkers(picture)[0]) for picture in some for detector in tag_detectors())
    else:
        ours, dictionary = 0, ""
    if ours >= _LEAST_MARKERS:
        return (
            f"but {ours} markers of its dictionary {dictionary} are there; it is another board, or too "
            "much of it is covered: give --board as it is printed on the sheet"
        )
    for name in _OTHERS:
        markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{name}"))
        count = max(_markers(picture, markers) for picture in some)
        if count >= _LEAST_MARKERS:
            return (
                f"but {count} markers of dictionary {name.lower()} are there; it is another board: give --board as it "
                "is printed on the sheet"
            )
    if isinstance(board, Chessboard):
        return (
            "nor any markers; its inner corners are counted, not squares, and all must be in the picture: show the "
            "whole board with white around it, light it well, and hold it still"
        )
    return "nor any markers; bring it nearer, light it well, and hold it still"


def _alternatives(board: Board) -> Sequence[Board]:
    """Return the boards that are easily taken for this one."""
    if isinstance(board, CharucoBoard):
        return [replace(board, legacy=not board.legacy)]
    if isinstance(board, AprilGrid):
        return [replace(board, columns=board.rows, rows=board.columns)]
    columns, rows = board.columns - 1, board.rows - 1  # squares given instead of inner corners
    return [replace(board, columns=columns, rows=rows)] if min(columns, rows) >= 3 else []


def _markers(picture: GreyPicture, dictionary: cv2.aruco.Dictionary) -> int:
    return len(cv2.aruco.ArucoDetector(dictionary).detectMarkers(picture)[0])
