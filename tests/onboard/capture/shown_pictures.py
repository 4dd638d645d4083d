"""Pictures that are shown to a capture."""

import cv2
import numpy as np
from numpy.typing import NDArray

from tests.support.board_views import render_views

MS = 1_000_000
STEP_NS = 110 * MS
EMPTY = np.full((480, 640), 120, np.uint8)


def jpeg(picture: NDArray[np.uint8]) -> bytes:
    return cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()


def thrice(*indices: int) -> list[NDArray[np.uint8]]:
    return [render_views()[index] for index in indices for _ in range(3)]
