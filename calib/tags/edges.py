"""Where the corners of a tag go when its sides are seen too far out.

A detector puts a side where the picture is half as bright as on both sides of it. Where light is blurred, that is where
the side is as long as numbers in the picture are proportional to light. A gamma makes all grey brighter, and so do
overexposed sensors: white spreads into the black border, and each side is seen too far in, by as many pixels whatever
the tag's size in the picture. A corner lies where its two sides meet.
"""

from typing import Final

import numpy as np

from groundsbot.calib.foundation import FloatArray

_NEXT: Final = np.array([1, 2, 3, 0])
_LAST: Final = np.array([3, 0, 1, 2])


def outward(corners_px: FloatArray) -> FloatArray:
    """(..., 4, 2) how far corners move per pixel by which all sides move outwards.

    With n and m the unit normals of a corner's two sides, pointing out, the corner moves by d with n.d = m.d = 1, which
    is d = (n + m) / (1 + n.m).

    Args:
        corners_px: (..., 4, 2) clockwise as seen in the picture (y down), as `groundsbot.proto` has them; where two of
            them coincide the result is no number.
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
    """(..., 4, 2) the corners with all sides so many pixels further out."""
    return corners_px if by_px == 0.0 else corners_px + by_px * outward(corners_px)
