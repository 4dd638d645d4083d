"""Conversion of pictures between encoded bytes and arrays."""

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from groundsbot.calib.foundation import JPEG_END, MOST_PIXELS, is_complete, size_in_header
from groundsbot.onboard.errors import OnboardError

Picture = bytes | NDArray[np.uint8]  # bytes of a PNG or JPEG file; or grey [h, w] or BGR [h, w, 3]

_REDUCED: Final = {
    1: cv2.IMREAD_COLOR,
    2: cv2.IMREAD_REDUCED_COLOR_2,
    4: cv2.IMREAD_REDUCED_COLOR_4,
    8: cv2.IMREAD_REDUCED_COLOR_8,
}


def decode_grey(encoded: bytes) -> NDArray[np.uint8]:
    """Decode the bytes of a PNG or JPEG file to a grey picture [height, width].

    Raises:
        OnboardError: the bytes are not a picture, or an incomplete or too large one.
    """
    return _decode(encoded, cv2.IMREAD_GRAYSCALE)


def decode(encoded: bytes) -> NDArray[np.uint8]:
    """Decode the bytes of a PNG or JPEG file to a grey [height, width] or BGR [height, width, 3] picture.

    Raises:
        OnboardError: the bytes are not a picture, or an incomplete or too large one.
    """
    return _decode(encoded, cv2.IMREAD_ANYCOLOR)


def decode_smaller(encoded: bytes, least_width_px: int) -> NDArray[np.uint8]:
    """Decode the bytes of a PNG or JPEG file to a BGR picture, by 1, 2, 4 or 8 smaller in both directions.

    It is the smallest with at least that width; a JPEG is decoded at that size at once, which is quick.

    Raises:
        OnboardError: the bytes are not a picture, or an incomplete or too large one.
    """
    width_px, _ = size_in_header(encoded)
    smallest = next((each for each in (8, 4, 2) if width_px >= each * least_width_px), 1)
    return _decode(encoded, _REDUCED[smallest])


def _decode(encoded: bytes, mode: int) -> NDArray[np.uint8]:
    if not is_complete(encoded):
        raise OnboardError(f"picture of {len(encoded)} bytes is truncated, or neither PNG nor JPEG")
    width_px, height_px = size_in_header(encoded)
    if not 0 < width_px * height_px <= MOST_PIXELS:
        raise OnboardError(f"picture claims {width_px}x{height_px} pixels, limit {MOST_PIXELS} in all")
    picture = cv2.imdecode(np.frombuffer(encoded, np.uint8), mode)
    if picture is None:
        raise OnboardError(f"picture of {len(encoded)} bytes cannot be decoded")
    return np.asarray(picture, dtype=np.uint8)


def encode_jpeg(picture: NDArray[np.uint8], quality: int) -> bytes:
    """Encode a grey or BGR picture as JPEG.

    Raises:
        OnboardError: the picture cannot be encoded.
    """
    done, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise OnboardError(f"picture of shape {picture.shape} cannot be encoded as JPEG")
    return data.tobytes()


def without_padding(encoded: bytes) -> bytes:
    """Return a JPEG without bytes that a camera's driver leaves after its end marker."""
    end = encoded.rfind(JPEG_END)
    return encoded[: end + len(JPEG_END)] if end >= 0 else encoded


def to_grey(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Convert a grey [height, width] or BGR [height, width, 3] picture to grey.

    Raises:
        OnboardError: the picture is empty, not of unsigned bytes, or has another shape.
    """
    if picture.size == 0 or picture.dtype != np.uint8:
        raise OnboardError(f"picture of shape {picture.shape} and type {picture.dtype} is empty or not of bytes")
    if picture.ndim == 2:
        return picture
    if picture.ndim != 3 or picture.shape[2] != 3:
        raise OnboardError(f"picture of shape {picture.shape} is neither grey nor BGR")
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
