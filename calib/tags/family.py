"""The bit patterns of AprilTags, once: what prints, renders and detects agree on them.

OpenCV ships the codes, but draws its AprilTag dictionaries turned by 180 degrees against AprilTag's own pictures.
Here they are turned back; a test reads them with the AprilTag library. tag36h10, which OpenCV also has, is left
out: the AprilTag libraries on PyPI cannot detect it.
"""

from functools import cache
from typing import Final

import cv2
import numpy as np

from groundsbot.calib.errors import CalibError
from groundsbot.calib.foundation import BoolArray

_OPENCV_DICTIONARIES: Final = {
    "tag36h11": cv2.aruco.DICT_APRILTAG_36h11,
    "tag25h9": cv2.aruco.DICT_APRILTAG_25h9,
    "tag16h5": cv2.aruco.DICT_APRILTAG_16h5,
}


def families() -> tuple[str, ...]:
    """Names of the families offered, as AprilTag spells them."""
    return tuple(_OPENCV_DICTIONARIES)


def family_size(family: str) -> int:
    """How many tags a family has; their ids are 0 to this minus 1.

    Raises:
        CalibError: no such family.
    """
    return len(_dictionary(family).bytesList)


def tag_bits(family: str, tag_id: int) -> BoolArray:
    """A tag's cells `[n, n]`, True where white, row 0 at the top, as AprilTag draws it upright.

    The outermost ring is the black border; its outer edge is what a tag's size means. A white margin of one
    cell, which printing and rendering must add, is not part of it.

    Raises:
        CalibError: no such family, or no such tag in it.
    """
    size = family_size(family)
    if not 0 <= tag_id < size:
        raise CalibError(f"tag_id is {tag_id} but {family} has the ids 0 to {size - 1}; choose one of these")
    return _bits(family, tag_id).copy()


@cache
def _dictionary(family: str) -> cv2.aruco.Dictionary:
    if family not in _OPENCV_DICTIONARIES:
        raise CalibError(f"tag family is {family!r} but must be one of {', '.join(families())}; choose one of these")
    return cv2.aruco.getPredefinedDictionary(_OPENCV_DICTIONARIES[family])


@cache
def _bits(family: str, tag_id: int) -> BoolArray:
    dictionary = _dictionary(family)
    cells = dictionary.markerSize + 2
    as_opencv_draws = dictionary.generateImageMarker(tag_id, cells) > 127
    return np.rot90(as_opencv_draws, 2)
