"""Pictures as bytes and as arrays."""

import cv2
import numpy as np
from numpy.typing import NDArray

from onboard.errors import OnboardError


def decode_grey(encoded: bytes) -> NDArray[np.uint8]:
    """A PNG or JPEG file's bytes as a grey picture [height, width].

    Raises:
        OnboardError: no picture, or not a whole one.
    """
    if not is_complete(encoded):
        raise OnboardError(f"picture of {len(encoded)} bytes is cut short or neither PNG nor JPEG")
    picture = cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_GRAYSCALE)
    if picture is None:
        raise OnboardError(f"picture of {len(encoded)} bytes cannot be decoded")
    return np.asarray(picture, dtype=np.uint8)


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


def is_complete(encoded: bytes) -> bool:
    """Whether a PNG or JPEG file's bytes reach its end mark: OpenCV decodes half a JPEG without a word."""
    if is_jpeg(encoded):
        return encoded.endswith(b"\xff\xd9")
    return encoded.startswith(b"\x89PNG\r\n\x1a\n") and encoded.endswith(b"IEND\xaeB`\x82")
