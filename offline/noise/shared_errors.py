"""Errors that observations of a tag share: those close to each other, and all of a pass.

A detector's bias depends on how a tag looks, a sensor's on the range, a clock's on the speed: so an error repeats from
picture to picture, and the mean of m observations is less certain than one observation over sqrt(m). Observations are
taken to err by two such parts: one that is forgotten along the way, as a Gauss-Markov process, and one that stays for a
whole pass. Their variances are fitted with all others (`variance_components`); an observation then counts as one of m
independent ones that tell as much together.
"""

from dataclasses import replace
from typing import Final

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.calib.robot import NoiseParameters
from groundsbot.offline.measurements import Segment, cells_of, least_shared_by_corners, least_shared_variance, passes_of
from groundsbot.offline.noise.lasting_errors import LastingErrors

# What observations of a tag err by is forgotten, but for a share of 1/e, after so much of the way, or so much turned.
# On the five robots of MRCLAM ranges do so after 0.14 m; what lasts longer falls to the errors of whole passes.
_LASTING_M: Final = 0.25
_LASTING_RAD: Final = 1.0


def lasting_errors(segment: Segment) -> tuple[LastingErrors, LastingErrors]:
    """Errors of observations of a tag in one pass that last some way, and that last for all of it."""
    pass_of = passes_of(segment)
    order = np.lexsort((segment.observations.keyframe, pass_of))
    goes_on = np.zeros(len(order))
    goes_on[1:] = np.diff(pass_of[order]) == 0
    at = segment.observations.keyframe[order]
    apart = np.zeros(len(order))
    apart[1:] = np.abs(np.diff(_view_changes(segment)[at]))
    return LastingErrors(order, goes_on * np.exp(-apart)), LastingErrors(order, goes_on)


def _view_changes(segment: Segment) -> FloatArray:
    """(K,) how often the view has changed by so much that errors are others, at the keyframes."""
    turned_rad = np.append(0.0, np.cumsum(np.abs(segment.odometry.motion[:, 2])))
    return np.asarray(segment.along_m / _LASTING_M + turned_rad / _LASTING_RAD)


def lasting_root(segment: Segment) -> FloatArray:
    """Return (M, 2, 2) whose columns a shared error of one adds to an observation, in range and bearing.

    Of observations whose log gives their covariance that is a multiple of their own.
    """
    return np.asarray(np.linalg.cholesky(segment.observations.parts.under(NoiseParameters())))


def in_cell(segment: Segment) -> IntArray:
    """(M,) how many observations are in the cell of each."""
    return _n_in_group(cells_of(segment))


def inflation_of_corners(segment: Segment, n_in_cell: IntArray, sigma_corner_px: float) -> FloatArray:
    """(M,) how many times their sigma corners count with, for what refined corners are known to share.

    Args:
        segment: with one observation at least.
        n_in_cell: (M,) as of `in_cell`.
        sigma_corner_px: of the corners' noise.
    """
    return np.asarray(np.sqrt(1.0 + n_in_cell * least_shared_by_corners(segment.observations, sigma_corner_px)))


def with_shared_errors(segment: Segment, shared: FloatArray, sigma_corner_px: float) -> Segment:
    """The segment with observations that count for less by what they share.

    Args:
        segment: under its noise, with its observations as independent.
        shared: (2, 2) variances by kind and component, as multiples of the squares of `lasting_root`.
        sigma_corner_px: of the corners' noise.
    """
    observations = segment.observations
    if not len(observations) or not (shared.any() or observations.corner_bias_px.any()):
        return segment
    back = np.linalg.inv(np.linalg.cholesky(observations.covariance)) @ lasting_root(segment)
    times = np.zeros((len(observations), 2))
    for errors, both in zip(lasting_errors(segment), shared, strict=True):
        times += errors.alike()[:, None] * np.einsum("mij,j->mi", back**2, both)
    n_in_cell = in_cell(segment)
    sigmas = np.sqrt(1.0 + np.maximum(times, n_in_cell[:, None] * least_shared_variance(observations)))
    of_corners = np.maximum(np.sqrt(1.0 + times.max(axis=1)), inflation_of_corners(segment, n_in_cell, sigma_corner_px))
    return replace(segment, observations=observations.inflate(sigmas, of_corners))


def _n_in_group(group: IntArray) -> IntArray:
    """(M,) how many are in the group of each."""
    return np.asarray(np.bincount(group)[group], dtype=np.int64)
