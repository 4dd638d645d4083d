"""The bias of refined corners that successive pictures have in common.

Blur, illumination and the cells beside the border shift a tag's sides in nearly the same way in successive pictures.
This error does not show in the scatter of the corners, and averaging does not reduce it.
"""

from typing import Final

import numpy as np

from groundsbot.calib.foundation import FloatArray
from groundsbot.offline.measurements.sensor_model.observations import Observations

# All constants here were measured on rendered drives (docs/accuracy.md). The vertical bias, which alone affects ranges,
# is smaller than the horizontal one: left and right sides may have partly hidden margins, and blur when the robot
# turns.
_VERTICAL_PX: Final = 0.01
_ANY_DIRECTION_PX: Final = 0.02
# A cell of the border is three pixels wide where the side has this length. In smaller tags the blur of one cell reaches
# the next, so sides are often not found in the picture, and tags appear too small.
_SMALL_PX: Final = 24.0
_SMALL_BIAS_PX: Final = 0.04
_POWER: Final = 4
_LEAST_PX: Final = 3.0  # smaller tags are not detected


def refined_bias_px(corners_px: FloatArray) -> FloatArray:
    """Return (M, 2) sigmas of the common bias of each tag's refined corners: vertical, and in any direction.

    Args:
        corners_px: (M, 4, 2) raw pixels.
    """
    (ax, ay), (bx, by) = ((corners_px[:, i + 2] - corners_px[:, i]).T for i in (0, 1))
    with np.errstate(over="ignore", invalid="ignore"):  # for corners that are not of a real tag
        side_px = np.sqrt(0.5 * np.abs(ax * by - ay * bx))  # of the square with the same area
    small_px = _SMALL_BIAS_PX * (_SMALL_PX / np.maximum(side_px, _LEAST_PX)) ** _POWER
    return np.asarray(np.hypot(small_px[:, None], (_VERTICAL_PX, _ANY_DIRECTION_PX)))


def least_shared_variance(observations: Observations) -> FloatArray:
    """Return (M, 2) lower bounds of the variance shared with neighbouring observations, relative to their own."""
    if not observations.corner_bias_px.any():
        return np.zeros((len(observations), 2))
    unit = observations.parts.of(("sigma_corner_px",))[0]
    by_pixel = np.einsum("mii->mi", unit) / np.einsum("mii->mi", observations.covariance)
    return np.asarray(by_pixel * observations.corner_bias_px[:, :1] ** 2)


def least_shared_by_corners(observations: Observations, sigma_corner_px: float) -> FloatArray:
    """Return (M,) the share of the corners' variance that neighbouring observations have in common.

    Args:
        observations: M of them.
        sigma_corner_px: the independent noise of each corner coordinate.
    """
    variance = observations.corner_bias_px[:, 1] ** 2
    return np.asarray(variance / (sigma_corner_px**2 + variance))
