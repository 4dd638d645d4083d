"""Pictures of tags whose corners are known."""

import cv2
import numpy as np
from numpy.typing import NDArray

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.tags.family import tag_bits

SUPERSAMPLING = 8


def draw_tag(family: str, tag_id: int, corners_px: FloatArray, size: tuple[int, int] = (480, 640)) -> NDArray[np.uint8]:
    """A tag in perspective on a light wall, its border's outer corners (TL, TR, BR, BL) at given pixels."""
    bits = np.pad(tag_bits(family, tag_id), 1, constant_values=True)  # a white margin of one module
    n = bits.shape[0]
    module_px = 40
    texture = np.asarray(
        np.kron(np.where(bits, np.uint8(230), np.uint8(20)), np.ones((module_px, module_px), np.uint8)), dtype=np.uint8
    )
    inner = (
        np.array([[1, 1], [n - 1, 1], [n - 1, n - 1], [1, n - 1]]) * module_px - 0.5
    )  # pixel centres at whole numbers
    # Centre of the fine pixel (i) lies at (i + 0.5) / SUPERSAMPLING - 0.5 of the coarse picture.
    fine = (corners_px + 0.5) * SUPERSAMPLING - 0.5
    turn = cv2.getPerspectiveTransform(inner.astype(np.float32), fine.astype(np.float32))
    height, width = size
    picture = cv2.warpPerspective(
        texture, turn, (width * SUPERSAMPLING, height * SUPERSAMPLING), flags=cv2.INTER_LINEAR, borderValue=(180.0,)
    )
    small = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.GaussianBlur(small, (0, 0), 0.6), dtype=np.uint8)
