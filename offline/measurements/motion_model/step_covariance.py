"""Covariances that a log or a bag gives for the steps of its odometry, checked before they are believed."""

from collections.abc import Sequence
from typing import Final

import numpy as np

from groundsbot.calib.foundation import BoolArray, FloatArray
from groundsbot.onboard.log import PlanarOdometry

# By how much of the largest entry rounding may spoil symmetry, or make the smallest eigenvalue negative.
_ROUNDING: Final = 1e-9
# No step of odometry is known worse than to a metre and a radian.
_LARGEST: Final = 1.0


def given_covariances(readings: Sequence[PlanarOdometry]) -> tuple[FloatArray | None, int]:
    """(N, 3, 3) as a log has them, NaN where it has none; None if it has none at all. And how many are no covariances.

    Args:
        readings: N of `/odometry`.
    """
    if not any(reading.covariance for reading in readings):
        return None, 0
    given = [list(r.covariance) if len(r.covariance) == 9 else [np.nan] * 9 for r in readings]
    covariance = np.array(given).reshape(-1, 3, 3)
    bad = ~_are_covariances(covariance)
    n_bad = sum(bool(reading.covariance) for reading, is_bad in zip(readings, bad, strict=True) if is_bad)
    covariance[bad] = np.nan
    return covariance, n_bad


def growth(poses: FloatArray, covariances: FloatArray) -> tuple[FloatArray | None, str]:
    """Covariances of the steps by which those of a pose grow; None where they do not grow as those of a path do.

    An error e of a pose (x, y, theta, added in odom) becomes F e at the next, with F's column of theta the step turned
    by a right angle; so a step adds C' - F C F^T, which R of the new heading turns into base: its right tangent.

    Args:
        poses: (N, 3) in odom.
        covariances: (N, 3, 3) of them, in odom.

    Returns:
        (N, 3, 3) of the step to each reading, zero for the first; and what to tell a person.
    """
    if not covariances.any():
        return None, "are zeros"
    if not np.isfinite(covariances).all() or not _are_symmetric(covariances).all():
        return None, "are none (not finite, or not symmetric)"
    step = np.diff(poses[:, :2], axis=0)
    carry = np.tile(np.eye(3), (len(step), 1, 1))
    carry[:, 0, 2], carry[:, 1, 2] = -step[:, 1], step[:, 0]
    added = covariances[1:] - carry @ covariances[:-1] @ carry.swapaxes(-1, -2)
    cos, sin = np.cos(poses[1:, 2]), np.sin(poses[1:, 2])
    to_base = np.tile(np.eye(3), (len(step), 1, 1))
    to_base[:, 0, 0], to_base[:, 0, 1], to_base[:, 1, 0], to_base[:, 1, 1] = cos, sin, -sin, cos
    values, vectors = np.linalg.eigh(to_base @ added @ to_base.swapaxes(-1, -2))
    size = np.abs(covariances[1:]).max((-1, -2))
    total = values.sum(axis=0)
    if (values[:, 0] < -_ROUNDING * size).any() or total[0] <= _ROUNDING * size.max(initial=0.0):
        return None, "do not grow along the path"
    steps = (vectors * np.maximum(values, 0.0)[:, None, :]) @ vectors.swapaxes(-1, -2)
    sigmas = np.sqrt(np.diagonal(steps.sum(axis=0)))
    driven_m = float(np.hypot(*step.T).sum())
    if np.hypot(*sigmas[:2]) > driven_m or sigmas[2] > 2.0 * np.pi or np.abs(steps).max() > _LARGEST:
        return None, f"are too large ({sigmas[2]:.3g} rad over {driven_m:.3g} m)"
    return np.concatenate([np.zeros((1, 3, 3)), steps]), "are used: by how much each step adds to those of the pose"


def _are_symmetric(matrices: FloatArray) -> BoolArray:
    """(M,) which of (M, 3, 3) are."""
    apart = np.abs(matrices - matrices.swapaxes(-1, -2)).max((-1, -2))
    return np.asarray(apart <= _ROUNDING * np.abs(matrices).max((-1, -2)))


def _are_covariances(matrices: FloatArray) -> BoolArray:
    """(M,) which of (M, 3, 3) are symmetric, not negative, and of a step's size."""
    with np.errstate(invalid="ignore"):
        sane = np.asarray((np.abs(matrices) <= _LARGEST).all((-1, -2))) & _are_symmetric(matrices)
    smallest = np.linalg.eigvalsh(np.where(sane[:, None, None], matrices, 0.0))[:, 0]
    return np.asarray(sane & (smallest >= -_ROUNDING * np.abs(np.nan_to_num(matrices)).max((-1, -2))))
