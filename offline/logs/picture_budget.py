"""How much looking at pictures a log is worth: a small file may hold many, of which each takes a detector long."""

from typing import Final

from groundsbot.calib.foundation import MOST_PIXELS, is_jpeg, size_in_header

# A camera's JPEG spends at least 6 bits on 64 pixels, and cannot be packed further; a bomb takes minutes.
_PIXELS_PER_BYTE: Final = 128
# A picture takes as long as so many pixels of a plain one: however small it is; for each byte of a JPEG, since what
# takes bytes has edges; for each pixel of a PNG, which may hold one piece of noise over and over.
_LEAST_PIXELS: Final = 1 << 14
_PIXELS_A_BYTE: Final = 16
_PIXELS_A_PNG_PIXEL: Final = 8


def plausible_pixels(encoded: bytes) -> int | None:
    """Of a PNG or JPEG file; None: more than its bytes can tell, so that it is not worth looking at."""
    width_px, height_px = size_in_header(encoded)
    n_pixels = width_px * height_px
    return n_pixels if n_pixels <= _PIXELS_PER_BYTE * len(encoded) else None


def work_pixels(encoded: bytes) -> int:
    """What looking at a picture takes, as so many pixels of a plain one."""
    n_pixels = (plausible_pixels(encoded) or 0) * (1 if is_jpeg(encoded) else _PIXELS_A_PNG_PIXEL)
    return max(n_pixels, _PIXELS_A_BYTE * len(encoded), _LEAST_PIXELS)


def most_work_pixels(log_bytes: int) -> int:
    """For a log of this size."""
    return MOST_PIXELS + _PIXELS_PER_BYTE * log_bytes
