"""Work budget for tag detection in a log's pictures, as a small crafted file may hold many slow ones."""

from typing import Final

from groundsbot.calib.foundation import MOST_PIXELS, is_jpeg, size_in_header

# A camera's JPEG needs at least 6 bits for 64 pixels and is incompressible; a decompression bomb takes minutes.
_PIXELS_PER_BYTE: Final = 128
# Detection time in pixels of a plain picture: at least; for each byte of a JPEG, as bytes encode edges; for each pixel
# of a PNG, which may repeat one patch of noise.
_LEAST_PIXELS: Final = 1 << 14
_PIXELS_A_BYTE: Final = 16
_PIXELS_A_PNG_PIXEL: Final = 8


def plausible_pixels(encoded: bytes) -> int | None:
    """Return the number of pixels of a PNG or JPEG file; None if implausibly many for its bytes."""
    width_px, height_px = size_in_header(encoded)
    n_pixels = width_px * height_px
    return n_pixels if n_pixels <= _PIXELS_PER_BYTE * len(encoded) else None


def work_pixels(encoded: bytes) -> int:
    """Return the detection work for a picture, in pixels of a plain one."""
    n_pixels = (plausible_pixels(encoded) or 0) * (1 if is_jpeg(encoded) else _PIXELS_A_PNG_PIXEL)
    return max(n_pixels, _PIXELS_A_BYTE * len(encoded), _LEAST_PIXELS)


def most_work_pixels(log_bytes: int) -> int:
    """Return the budget for a log of this size, in pixels."""
    return MOST_PIXELS + _PIXELS_PER_BYTE * log_bytes
