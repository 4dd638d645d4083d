"""Covariances of odometry steps from a log or a bag, checked before they are used."""

from collections.abc import Sequence
from typing import Final

import numpy as np

from groundsbot.calib.foundation import BoolArray, FloatArray
from groundsbot.offline.measurements.covariance_components import propagate

# Tolerance for asymmetry and negative eigenvalues, relative to the largest entry.
_ROUNDING: Final = 1e-9
# No step of odometry has a larger variance, in m^2 or rad^2.
_LARGEST: Final = 1.0


def given_covariances(readings: Sequence[Sequence[float]]) -> tuple[FloatArray | None, int]:
    """Return the covariances of odometry steps in a log.

    Args:
        readings: N, of each message of `/odometry`, row-major; may be empty.

    Returns:
        (N, 3, 3) covariances, NaN where a reading has none or an invalid one; None where no reading has one. And the
        number of invalid ones.
    """
    if not any(readings):
        return None, 0
    given = [each if len(each) == 9 else (np.nan,) * 9 for each in readings]
    covariance = np.array(given).reshape(-1, 3, 3)
    bad = ~_are_covariances(covariance)
    n_bad = sum(bool(reading) for reading, is_bad in zip(readings, bad, strict=True) if is_bad)
    covariance[bad] = np.nan
    return covariance, n_bad


def growth(poses: FloatArray, covariances: FloatArray) -> tuple[FloatArray | None, str]:
    """Return the covariances of odometry steps from those of the poses, which accumulate them.

    An error e of a pose (x, y, theta, additive in odom) becomes F e at the next pose, where the theta column of F is
    the step rotated by 90 degrees. A step therefore adds C' - F C F^T, which the rotation into base at the new heading
    turns into the covariance of the right tangent.

    Args:
        poses: (N, 3) in odom.
        covariances: (N, 3, 3) of the poses, in odom.

    Returns:
        (N, 3, 3) covariances of the step to each reading, zero for the first; None where the given ones cannot be those
        of accumulated steps. And the end of a sentence on them, for the user.
    """
    if not covariances.any():
        return None, "are zeros"
    if not np.isfinite(covariances).all() or not _are_symmetric(covariances).all():
        return None, "are invalid (not finite, or not symmetric)"
    step = np.diff(poses[:, :2], axis=0)
    F = np.tile(np.eye(3), (len(step), 1, 1))
    F[:, 0, 2], F[:, 1, 2] = -step[:, 1], step[:, 0]
    added = covariances[1:] - propagate(F, covariances[:-1])
    cos, sin = np.cos(poses[1:, 2]), np.sin(poses[1:, 2])
    to_base = np.tile(np.eye(3), (len(step), 1, 1))
    to_base[:, 0, 0], to_base[:, 0, 1], to_base[:, 1, 0], to_base[:, 1, 1] = cos, sin, -sin, cos
    values, vectors = np.linalg.eigh(propagate(to_base, added))
    size = np.abs(covariances[1:]).max((-1, -2))
    total = values.sum(axis=0)
    if (values[:, 0] < -_ROUNDING * size).any() or total[0] <= _ROUNDING * size.max(initial=0.0):
        return None, "do not grow along the path"
    steps = (vectors * np.maximum(values, 0.0)[:, None, :]) @ vectors.swapaxes(-1, -2)
    sigmas = np.sqrt(np.diagonal(steps.sum(axis=0)))
    driven_m = float(np.hypot(*step.T).sum())
    if np.hypot(*sigmas[:2]) > driven_m or sigmas[2] > 2.0 * np.pi or np.abs(steps).max() > _LARGEST:
        return None, f"are too large ({sigmas[2]:.3g} rad over {driven_m:.3g} m)"
    return np.concatenate([np.zeros((1, 3, 3)), steps]), "are used: that of a step is what it adds to the pose's"


def _are_symmetric(matrices: FloatArray) -> BoolArray:
    """Return (M,) which of (M, 3, 3) are symmetric."""
    asymmetry = np.abs(matrices - matrices.swapaxes(-1, -2)).max((-1, -2))
    return np.asarray(asymmetry <= _ROUNDING * np.abs(matrices).max((-1, -2)))


def _are_covariances(matrices: FloatArray) -> BoolArray:
    """Return (M,) which of (M, 3, 3) are symmetric, positive semidefinite, and small enough for a step."""
    with np.errstate(invalid="ignore"):
        bounded = np.asarray((np.abs(matrices) <= _LARGEST).all((-1, -2))) & _are_symmetric(matrices)
    smallest = np.linalg.eigvalsh(np.where(bounded[:, None, None], matrices, 0.0))[:, 0]
    return np.asarray(bounded & (smallest >= -_ROUNDING * np.abs(np.nan_to_num(matrices)).max((-1, -2))))
