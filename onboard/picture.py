"""Pictures as bytes and as arrays."""

import struct
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from onboard.errors import OnboardError

# Detecting takes 11 bytes of memory for each.
_MOST_PIXELS: Final = 1 << 24
_PNG_SIZE_AT: Final = 16
_JPEG_FRAMES: Final = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # the markers that begin a frame
_JPEG_END: Final = b"\xff\xd9"


def decode_grey(encoded: bytes) -> NDArray[np.uint8]:
    """A PNG or JPEG file's bytes as a grey picture [height, width].

    Raises:
        OnboardError: no picture, or not a whole one.
    """
    return _decode(encoded, cv2.IMREAD_GRAYSCALE)


def decode(encoded: bytes) -> NDArray[np.uint8]:
    """A PNG or JPEG file's bytes as it was taken: grey [height, width] or BGR [height, width, 3].

    Raises:
        OnboardError: no picture, or not a whole one.
    """
    return _decode(encoded, cv2.IMREAD_ANYCOLOR)


def _decode(encoded: bytes, mode: int) -> NDArray[np.uint8]:
    if not is_complete(encoded):
        raise OnboardError(f"picture of {len(encoded)} bytes is cut short or neither PNG nor JPEG")
    width_px, height_px = claimed_size(encoded)
    if not 0 < width_px * height_px <= _MOST_PIXELS:
        raise OnboardError(f"picture claims {width_px}x{height_px} pixels, limit {_MOST_PIXELS} in all")
    picture = cv2.imdecode(np.frombuffer(encoded, np.uint8), mode)
    if picture is None:
        raise OnboardError(f"picture of {len(encoded)} bytes cannot be decoded")
    return np.asarray(picture, dtype=np.uint8)


def claimed_size(encoded: bytes) -> tuple[int, int]:
    """(width_px, height_px) as a PNG or JPEG file's head has them, (0, 0) where it has none; nothing is decoded."""
    if not is_jpeg(encoded):
        width_px, height_px = struct.unpack_from(">II", encoded.ljust(_PNG_SIZE_AT + 8, b"\0"), _PNG_SIZE_AT)
        return width_px, height_px
    at = 2
    while at + 9 <= len(encoded):
        _, marker, length, _, height_px, width_px = struct.unpack_from(">BBHBHH", encoded, at)
        if marker in _JPEG_FRAMES:
            return width_px, height_px
        at += 2 + length
    return 0, 0


def encode_jpeg(picture: NDArray[np.uint8], quality: int) -> bytes:
    """A grey or BGR picture as JPEG.

    Raises:
        OnboardError: it cannot be encoded.
    """
    done, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise OnboardError(f"picture of shape {picture.shape} cannot be encoded as JPEG")
    return data.tobytes()


def is_jpeg(encoded: bytes) -> bool:
    """Whether the bytes begin as a JPEG file does."""
    return encoded.startswith(b"\xff\xd8\xff")


def without_padding(encoded: bytes) -> bytes:
    """A JPEG without what a camera's driver leaves behind its end mark."""
    end = encoded.rfind(_JPEG_END)
    return encoded[: end + len(_JPEG_END)] if end >= 0 else encoded


def is_complete(encoded: bytes) -> bool:
    """Whether a PNG or JPEG file's bytes reach its end mark: OpenCV decodes half a JPEG without a word."""
    if is_jpeg(encoded):
        return encoded.endswith(_JPEG_END)
    return encoded.startswith(b"\x89PNG\r\n\x1a\n") and encoded.endswith(b"IEND\xaeB`\x82")


def to_grey(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A grey [height, width] or BGR [height, width, 3] picture as grey.

    Raises:
        OnboardError: it is empty or of another kind.
    """
    if picture.size == 0 or picture.dtype != np.uint8:
        raise OnboardError(f"picture of shape {picture.shape} and type {picture.dtype} is empty or not of bytes")
    if picture.ndim == 2:
        return picture
    if picture.ndim != 3 or picture.shape[2] != 3:
        raise OnboardError(f"picture of shape {picture.shape} is neither grey nor BGR")
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
