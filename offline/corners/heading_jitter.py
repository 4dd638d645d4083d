"""Whitening of tag corners by the jitter of headings that a gyro does not resolve (`measurements.motion_model`).

A heading off by e with sigma s changes the eight whitened residuals r of a detection by u e / s, u = s dr/dtheta. Their
covariance is I + u u^T, and the symmetric root of its inverse is

    I - w w^T,    w = u sqrt((1 - 1 / sqrt(1 + |u|^2)) / |u|^2).

As in observations, the error counts as independent for each tag of a picture. The derivative is that of the start, so
that the weights do not depend on the state.
"""

from dataclasses import replace
from typing import Final

import numpy as np

from groundsbot.calib.foundation import FloatArray
from groundsbot.offline.corners.factors import CornerFactors, SpatialColumns, SpatialState

_HEADING: Final = 2  # column of a detection


def with_heading_jitter(
    factors: CornerFactors, state: SpatialState, columns: SpatialColumns, sigma_rad: FloatArray
) -> CornerFactors:
    """Return factors without jitter with one of these sigmas (M,); unchanged where all are zero, as without a gyro."""
    if not sigma_rad.any():
        return factors
    linearised, _ = factors.linearise(state, columns)
    ((_, jacobian),) = linearised.blocks
    moved = np.nan_to_num(sigma_rad[:, None] * jacobian[..., _HEADING])  # NaN where a lens has no image
    square = (moved**2).sum(axis=1, keepdims=True)
    length = np.sqrt((1.0 - 1.0 / np.sqrt(1.0 + square)) / np.where(square > 0.0, square, 1.0))
    return replace(factors, observations=factors.observations._replace(jitter=length * moved))
