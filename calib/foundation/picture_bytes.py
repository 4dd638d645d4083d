"""Checks of PNG and JPEG files on their encoded bytes, before decoding."""

import struct
from typing import Final

# Detection needs 11 bytes of memory per pixel.
MOST_PIXELS: Final = 1 << 24
# Of an encoded picture; a PNG in colour that does not compress takes three bytes per pixel.
MOST_PICTURE_BYTES: Final = 4 * MOST_PIXELS
JPEG_END: Final = b"\xff\xd9"
_PNG_SIZE_AT: Final = 16
_JPEG_FRAMES: Final = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # start of frame


def size_in_header(encoded: bytes) -> tuple[int, int]:
    """Return (width_px, height_px) from the header of a PNG or JPEG file, or (0, 0) without a frame header."""
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
    """Return whether the bytes begin as a JPEG file."""
    return encoded.startswith(b"\xff\xd8\xff")


def is_complete(encoded: bytes) -> bool:
    """Return whether a PNG or JPEG file ends with its end marker; OpenCV decodes truncated JPEGs without an error."""
    if is_jpeg(encoded):
        return encoded.endswith(JPEG_END)
    return encoded.startswith(b"\x89PNG\r\n\x1a\n") and encoded.endswith(b"IEND\xaeB`\x82")
