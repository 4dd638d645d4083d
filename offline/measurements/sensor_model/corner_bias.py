"""What corners that were refined on the picture err by in the same way in look after look.

The scatter of refined corners does not tell how far off they are: what blur, light and the cells beside a border do to
a tag's sides is the same in one picture as in the next, and no number of looks averages it out.
"""

from typing import Final

import numpy as np

from groundsbot.calib.foundation import FloatArray
from groundsbot.offline.measurements.sensor_model.observations import Observations

# Measured on rendered drives, as is what follows (docs/accuracy.md). Up and down tags of any size are seen right to
# less than this, and that alone is what ranges come from. Left and right sides are those beside half hidden margins,
# and those that smear when the robot turns.
_UPRIGHT_PX: Final = 0.01
_ANYHOW_PX: Final = 0.02
# A cell of the tag's border is three pixels wide where its side has this many. Below, the blur of one cell reaches into
# the next, sides can often not be told from the picture, and tags look smaller than they are.
_SMALL_PX: Final = 24.0
_SMALL_BIAS_PX: Final = 0.04
_POWER: Final = 4
_LEAST_PX: Final = 3.0  # nothing is detected that is so small


def refined_bias_px(corners_px: FloatArray) -> FloatArray:
    """(M, 2) sigmas of what each tag's refined corners (M, 4, 2) err by alike: up and down, and in all ways."""
    (ax, ay), (bx, by) = ((corners_px[:, i + 2] - corners_px[:, i]).T for i in (0, 1))
    with np.errstate(over="ignore", invalid="ignore"):  # corners that are no tag's
        side_px = np.sqrt(0.5 * np.abs(ax * by - ay * bx))  # of a square as large
    small_px = _SMALL_BIAS_PX * (_SMALL_PX / np.maximum(side_px, _LEAST_PX)) ** _POWER
    return np.asarray(np.hypot(small_px[:, None], (_UPRIGHT_PX, _ANYHOW_PX)))


def least_shared_variance(observations: Observations) -> FloatArray:
    """Return (M, 2) least variances shared with neighbouring observations, as multiples of their own."""
    if not observations.corner_bias_px.any():
        return np.zeros((len(observations), 2))
    unit = observations.parts.of(("sigma_corner_px",))[0]
    by_pixel = np.einsum("mii->mi", unit) / np.einsum("mii->mi", observations.covariance)
    return np.asarray(by_pixel * observations.corner_bias_px[:, :1] ** 2)


def least_shared_by_corners(observations: Observations, sigma_corner_px: float) -> FloatArray:
    """(M,) the same of the corners themselves, whose noise beside has this sigma."""
    variance = observations.corner_bias_px[:, 1] ** 2
    return np.asarray(variance / (sigma_corner_px**2 + variance))
