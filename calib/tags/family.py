"""The bit patterns of AprilTags, for printing and rendering.

OpenCV contains the codes, but draws its AprilTag dictionaries rotated by 180 degrees against AprilTag's own pictures.
This module rotates them back; a test detects them with the AprilTag library. OpenCV's tag36h10 is not offered, because
the AprilTag libraries on PyPI cannot detect it.
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
    """Return the names of the supported families, as AprilTag spells them."""
    return tuple(_OPENCV_DICTIONARIES)


def family_size(family: str) -> int:
    """Return the number of tags of a family; the ids are 0 to this minus 1.

    Raises:
        CalibError: the family is unknown.
    """
    return len(_dictionary(family).bytesList)


def tag_bits(family: str, tag_id: int) -> BoolArray:
    """Return the cells of a tag `[n, n]`, True for white, with row 0 at the top of AprilTag's upright picture.

    The outermost ring is the black border; the size of a tag is the side of its outer edge. The white margin of one
    cell is not included; printing and rendering must add it.

    Raises:
        CalibError: the family is unknown, or has no such tag.
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
