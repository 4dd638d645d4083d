"""What the bytes of a PNG or JPEG file tell before anything is decoded."""

import struct
from typing import Final

# Detecting takes 11 bytes of memory for each.
MOST_PIXELS: Final = 1 << 24
JPEG_END: Final = b"\xff\xd9"
_PNG_SIZE_AT: Final = 16
_JPEG_FRAMES: Final = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # the markers that begin a frame


def size_in_header(encoded: bytes) -> tuple[int, int]:
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


def is_jpeg(encoded: bytes) -> bool:
    """Whether the bytes begin as a JPEG file does."""
    return encoded.startswith(b"\xff\xd8\xff")


def is_complete(encoded: bytes) -> bool:
    """Whether a PNG or JPEG file's bytes reach its end mark: OpenCV decodes half a JPEG without a word."""
    if is_jpeg(encoded):
        return encoded.endswith(JPEG_END)
    return encoded.startswith(b"\x89PNG\r\n\x1a\n") and encoded.endswith(b"IEND\xaeB`\x82")
