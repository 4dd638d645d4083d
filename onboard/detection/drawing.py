"""Pictures with detected tags or board corners drawn into them."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from groundsbot.calib.board import Coverage, SeenBoard, region_shares
from groundsbot.calib.foundation import FloatArray, atomic_write
from groundsbot.onboard.detection.tag_detector import Detection
from groundsbot.onboard.log import Picture, decode, encode_jpeg

_GREEN: Final = (60, 220, 60)
_RED: Final = (40, 40, 255)
_WIDTH_PX: Final = 2
_FRACTION_BITS: Final = 3
_QUALITY: Final = 90


def save_drawing(picture: Picture, detections: Sequence[Detection], path: Path) -> None:
    """Write a JPEG with the outlines and ids of the tags, and a mark at their first (top left) corners.

    Raises:
        OnboardError: the picture cannot be decoded.
        OSError: the file cannot be written.
    """
    drawn = _in_colour(picture)
    draw_tags(drawn, [(each.tag_id, each.corners_px) for each in detections])
    _save(drawn, path)


def draw_tags(drawn: NDArray[np.uint8], tags: Iterable[tuple[int, FloatArray]]) -> None:
    """Draw ids and outlines of tags, by their corners [4, 2] in px, into a BGR picture."""
    for tag_id, corners_px in tags:
        corners = np.rint(corners_px * (1 << _FRACTION_BITS)).astype(np.int32)
        cv2.polylines(drawn, [corners], True, _GREEN, _WIDTH_PX, cv2.LINE_AA, _FRACTION_BITS)
        cv2.circle(drawn, np.rint(corners_px[0]).astype(int).tolist(), 2 * _WIDTH_PX, _RED, -1, cv2.LINE_AA)
        middle = np.rint(corners_px.mean(axis=0)).astype(int).tolist()
        cv2.putText(drawn, str(tag_id), middle, cv2.FONT_HERSHEY_SIMPLEX, 0.7, _RED, _WIDTH_PX, cv2.LINE_AA)


def save_board(picture: Picture, seen: SeenBoard | None, spread: Coverage, path: Path) -> None:
    """Write a JPEG with what `draw_board` draws.

    Raises:
        OnboardError: the picture cannot be decoded.
        OSError: the file cannot be written.
    """
    _save(draw_board(picture, seen, spread), path)


def draw_board(picture: Picture, seen: SeenBoard | None, spread: Coverage) -> NDArray[np.uint8]:
    """Return a BGR picture with the corners of the board, and a frame around each region not covered yet.

    Raises:
        OnboardError: the picture cannot be decoded.
    """
    drawn = _in_colour(picture)
    size_px = np.array([drawn.shape[1], drawn.shape[0]])
    for row in range(3):
        for column in range(3):
            if not spread.is_covered(row, column):
                first, last = (np.rint(size_px * share).astype(int) for share in region_shares(row, column))
                cv2.rectangle(drawn, (first + 4).tolist(), (last - 5).tolist(), _RED, _WIDTH_PX, cv2.LINE_AA)
    for corner in seen.pixels if seen is not None else ():
        at = np.rint(corner * (1 << _FRACTION_BITS)).astype(int).tolist()
        cv2.circle(drawn, at, (2 * _WIDTH_PX) << _FRACTION_BITS, _GREEN, -1, cv2.LINE_AA, _FRACTION_BITS)
    return drawn


def _in_colour(picture: Picture) -> NDArray[np.uint8]:
    seen = decode(picture) if isinstance(picture, bytes) else picture
    return np.asarray(cv2.cvtColor(seen, cv2.COLOR_GRAY2BGR) if seen.ndim == 2 else seen.copy(), np.uint8)


def _save(drawn: NDArray[np.uint8], path: Path) -> None:
    data = encode_jpeg(drawn, _QUALITY)
    with atomic_write(path) as temporary, temporary.open("xb") as file:  # "x": do not follow a link
        file.write(data)
