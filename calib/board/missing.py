"""Reasons why a board is not found in pictures: mirrored, another board, or none."""

from collections.abc import Sequence
from typing import Final

import cv2
import numpy as np

from groundsbot.calib.board.board import Board
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
    ours = max(_markers(picture, f"{board.dictionary.upper()}") for picture in some)
    if ours >= _LEAST_MARKERS:
        return (
            f"but {ours} markers of its dictionary {board.dictionary} are there; it is another board, or too "
            "much of it is covered: give --board as it is printed on the sheet"
        )
    for name in _OTHERS:
        count = max(_markers(picture, name) for picture in some)
        if count >= _LEAST_MARKERS:
            return (
                f"but {count} markers of dictionary {name.lower()} are there; it is another board: give --board as it "
                "is printed on the sheet"
            )
    return "nor any markers; bring it nearer, light it well, and hold it still"


def _markers(picture: GreyPicture, dictionary: str) -> int:
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{dictionary}")))
    return len(detector.detectMarkers(picture)[0])
