"""Errors that observations of a tag share: those close to each other, and all of a track.

The bias of a detector depends on the view of the tag, that of a sensor on the range, and that of a clock on the speed.
So errors repeat from picture to picture, and the sigma of the mean of m observations is larger than that of one over
sqrt(m). The model has two such errors: a Gauss-Markov process along the way, and a constant for each track. Their
variances are fitted with all others (`variance_components`). Observations are then treated as independent with
variances so much larger that they have the same information together.
"""

from dataclasses import replace
from typing import Final

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.calib.robot import NoiseParameters
from groundsbot.offline.measurements import Segment, cells_of, least_shared_by_corners, least_shared_variance, passes_of
from groundsbot.offline.noise.lasting_errors import LastingErrors

# Correlation lengths of the Gauss-Markov process, by distance and by rotation. Ranges of the five robots of MRCLAM have
# 0.14 m; longer correlations are modelled by the constant of a track.
_LASTING_M: Final = 0.25
_LASTING_RAD: Final = 1.0


def lasting_errors(segment: Segment) -> tuple[LastingErrors, LastingErrors]:
    """Return the errors of observations along a track, and those that are constant in it."""
    track_of = passes_of(segment)
    order = np.lexsort((segment.observations.keyframe, track_of))
    is_same_track = np.zeros(len(order))
    is_same_track[1:] = np.diff(track_of[order]) == 0
    keyframe = segment.observations.keyframe[order]
    distance = np.zeros(len(order))
    distance[1:] = np.abs(np.diff(_distance_along(segment)[keyframe]))
    return LastingErrors(order, is_same_track * np.exp(-distance)), LastingErrors(order, is_same_track)


def _distance_along(segment: Segment) -> FloatArray:
    """Return the distance and rotation along the segment at its keyframes (K,), in correlation lengths."""
    turned_rad = np.append(0.0, np.cumsum(np.abs(segment.odometry.motion[:, 2])))
    return np.asarray(segment.along_m / _LASTING_M + turned_rad / _LASTING_RAD)


def lasting_root(segment: Segment) -> FloatArray:
    """Return matrices (M, 2, 2) whose columns are the errors of an observation for a shared error of one.

    They are square roots of the covariances under the default noise, or of a multiple of those given by the log.
    """
    return np.asarray(np.linalg.cholesky(segment.observations.parts.under(NoiseParameters())))


def in_cell(segment: Segment) -> IntArray:
    """Return the number of observations (M,) in the cell of each."""
    cell = cells_of(segment)
    return np.asarray(np.bincount(cell)[cell], dtype=np.int64)


def inflation_of_corners(segment: Segment, n_in_cell: IntArray, sigma_corner_px: float) -> FloatArray:
    """Return factors (M,) of the sigmas of corners for the errors that refined corners are known to share.

    Args:
        segment: segment with one observation at least.
        n_in_cell: (M,) result of `in_cell`.
        sigma_corner_px: noise of the corners, in pixels.
    """
    return np.asarray(np.sqrt(1.0 + n_in_cell * least_shared_by_corners(segment.observations, sigma_corner_px)))


def with_shared_errors(segment: Segment, shared: FloatArray, sigma_corner_px: float) -> Segment:
    """Return the segment with the covariances of observations inflated by the errors that they share.

    Args:
        segment: under its noise, with independent observations.
        shared: (2, 2) variances by kind and component, as multiples of the squares of `lasting_root`.
        sigma_corner_px: noise of the corners, in pixels.
    """
    observations = segment.observations
    if not len(observations) or not (shared.any() or observations.corner_bias_px.any()):
        return segment
    whitened_root = np.linalg.inv(np.linalg.cholesky(observations.covariance)) @ lasting_root(segment)
    added = np.zeros((len(observations), 2))  # relative to the variances
    for errors, both in zip(lasting_errors(segment), shared, strict=True):
        added += errors.correlation_sums()[:, None] * np.einsum("mij,j->mi", whitened_root**2, both)
    n_in_cell = in_cell(segment)
    sigmas = np.sqrt(1.0 + np.maximum(added, n_in_cell[:, None] * least_shared_variance(observations)))
    of_corners = np.maximum(np.sqrt(1.0 + added.max(axis=1)), inflation_of_corners(segment, n_in_cell, sigma_corner_px))
    return replace(segment, observations=observations.inflate(sigmas, of_corners))
