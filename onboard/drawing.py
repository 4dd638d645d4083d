"""Detections drawn into the picture they were found in, for people."""

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from calib.files import written_whole
from onboard.detection_process import Picture
from onboard.picture import decode, encode_jpeg
from onboard.tag_detector import Detection

_GREEN: Final = (60, 220, 60)
_RED: Final = (40, 40, 255)
_WIDTH_PX: Final = 2
_FRACTION_BITS: Final = 3
_QUALITY: Final = 90


def save_drawn(picture: Picture, detections: Sequence[Detection], path: Path) -> None:
    """Writes a JPEG: tags outlined, their ids in them, their first corners (top left) marked.

    Raises:
        OnboardError: it is no picture.
        OSError: it cannot be written.
    """
    seen = decode(picture) if isinstance(picture, bytes) else picture
    drawn = cv2.cvtColor(seen, cv2.COLOR_GRAY2BGR) if seen.ndim == 2 else seen.copy()
    for each in detections:
        corners = np.rint(each.corners_px * (1 << _FRACTION_BITS)).astype(np.int32)
        cv2.polylines(drawn, [corners], True, _GREEN, _WIDTH_PX, cv2.LINE_AA, _FRACTION_BITS)
        cv2.circle(drawn, np.rint(each.corners_px[0]).astype(int).tolist(), 2 * _WIDTH_PX, _RED, -1, cv2.LINE_AA)
        middle = np.rint(each.corners_px.mean(axis=0)).astype(int).tolist()
        cv2.putText(drawn, str(each.tag_id), middle, cv2.FONT_HERSHEY_SIMPLEX, 0.7, _RED, _WIDTH_PX, cv2.LINE_AA)
    data = encode_jpeg(np.asarray(drawn, np.uint8), _QUALITY)
    with written_whole(path) as temporary, temporary.open("xb") as file:  # never through a link
        file.write(data)
