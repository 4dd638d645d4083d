"""Shift of a tag's corners caused by an outward shift of its sides in the picture.

A detector puts a side where the grey level is halfway between both sides of it. With blur this is the true position
only if grey levels are proportional to light. A gamma and overexposure brighten intermediate greys. White then spreads
into the black border, and each side appears too far in by a number of pixels that does not depend on the tag's size in
the picture. A corner is the intersection of its two sides.
"""

from typing import Final

import numpy as np

from groundsbot.calib.foundation import FloatArray

_NEXT: Final = np.array([1, 2, 3, 0])
_LAST: Final = np.array([3, 0, 1, 2])


def outward(corners_px: FloatArray) -> FloatArray:
    """Return (..., 4, 2) shifts of the corners per pixel of outward shift of all sides.

    With n and m the outward unit normals of the two sides of a corner, the shift d satisfies n.d = m.d = 1, so
    d = (n + m) / (1 + n.m).

    Args:
        corners_px: (..., 4, 2) clockwise in the picture (y down), as in `groundsbot.proto`. The result is NaN or
            infinite where two of them coincide.
    """
    x, y = corners_px[..., 0], corners_px[..., 1]
    moved: FloatArray = np.empty_like(corners_px)
    with np.errstate(all="ignore"):
        along_x, along_y = x[..., _NEXT] - x, y[..., _NEXT] - y
        length = np.sqrt(along_x**2 + along_y**2)
        n_x, n_y = along_y / length, -along_x / length
        m_x, m_y = n_x[..., _LAST], n_y[..., _LAST]
        parallel = 1.0 + (n_x * m_x + n_y * m_y)
        moved[..., 0], moved[..., 1] = (n_x + m_x) / parallel, (n_y + m_y) / parallel
    return moved


def shift_edges(corners_px: FloatArray, by_px: float) -> FloatArray:
    """Return (..., 4, 2) the corners with all sides shifted outwards by `by_px`."""
    return corners_px if by_px == 0.0 else corners_px + by_px * outward(corners_px)
