"""How much a floor tilts a robot anew in each picture, and what that does to tag observations.

A tag keeps its height, so that what successive looks at it say of that tells how base rolls and pitches in
between: by a third of a degree, five pixels, where a corner is known to a fifth of one. What tilts base also moves the
camera above it, by a few millimetres. Taken for motion of the robot, they make wheels look several times as noisy as
they are. Slopes that last do not show, nor a mount that is turned: both looks have them.
"""

from dataclasses import replace
from typing import Final

import numpy as np
from scipy.special import chdtri, ndtri

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.measurements.sensor_model.tag_pose import TagMeasurements

_MEDIAN_CHI2: Final = float(chdtri(1, 0.5))
# Looks between which the range changes by more see a turned mount differently.
_SAME_RANGE: Final = 0.05
_LEAST_PAIRS: Final = 30
# A level floor is said to tilt so rarely. A median of n squares is uncertain as a share by 2.3 / sqrt(n), and by a
# fifth more where each look is in two pairs.
_FALSE_ALARM: Final = 1e-4
_MEDIAN_SPREAD: Final = 2.8
_STEPS: Final = 40


def floor_tilt_rad(
    found: TagMeasurements, tag: IntArray, keyframe: IntArray, camera_m: FloatArray, level: float
) -> float:
    """Sigma of roll and of pitch of base, anew in each picture; 0 where successive looks agree within their noise.

    It answers for half of the pairs of looks, so that a few phantoms do not count.

    Args:
        found: by the upright model.
        tag: (M,) an index each.
        keyframe: (M,) likewise, in order of time.
        camera_m: (2,) place of the camera in base.
        level: how many times the variance of corners is what the observations took it for.
    """
    order = np.lexsort((keyframe, tag))
    order = order[found.valid[order]]
    first, second = order[:-1], order[1:]
    range_m, bearing_rad = found.range_bearing.T
    is_pair = (tag[first] == tag[second]) & (keyframe[first] < keyframe[second])
    is_pair &= np.abs(range_m[second] - range_m[first]) < _SAME_RANGE * range_m[first]
    first, second = first[is_pair], second[is_pair]
    if len(first) < _LEAST_PAIRS:
        return 0.0
    square = (found.height_m[second] - found.height_m[first]) ** 2
    noise = level * (found.height_variance[first] + found.height_variance[second])
    ahead_m, aside_m = camera_m[0] + range_m * np.cos(bearing_rad), camera_m[1] + range_m * np.sin(bearing_rad)
    lever_m2 = ahead_m**2 + aside_m**2  # base tips about its own place on the floor
    by_tilt = lever_m2[first] + lever_m2[second]

    def ratio_to_expected(variance: float) -> float:
        return float(np.median(square / (noise + variance * by_tilt))) / _MEDIAN_CHI2

    if ratio_to_expected(0.0) < 1.0 - ndtri(_FALSE_ALARM) * _MEDIAN_SPREAD / np.sqrt(len(first)):
        return 0.0
    low, high = 0.0, float(np.max(square / by_tilt)) / _MEDIAN_CHI2
    for _ in range(_STEPS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if ratio_to_expected(middle) > 1.0 else (low, middle)
    return float(np.sqrt(high))


def inflate_by_tilt(found: TagMeasurements, tilt_rad: float) -> TagMeasurements:
    """Observations by the upright model with residuals whitened by what a floor that tilts adds to their covariance.

    With B = U S V^T their derivative by roll and pitch, I + tilt^2 B B^T has the inverse root
    I - U (1 - 1 / sqrt(1 + tilt^2 S^2)) U^T.
    """
    by_tilt = np.where(np.isfinite(found.misfit_by_turn[..., :2]), found.misfit_by_turn[..., :2], 0.0)
    axes, spread, _ = np.linalg.svd(by_tilt, full_matrices=False)
    taken = axes * (1.0 - 1.0 / np.sqrt(1.0 + (tilt_rad * spread) ** 2))[:, None, :]
    root = np.eye(8) - taken @ axes.swapaxes(-1, -2)
    misfit = (root @ found.misfit[..., None])[..., 0]
    return replace(
        found, misfit=misfit, misfit_by_turn=root @ found.misfit_by_turn, chi2=np.asarray((misfit**2).sum(axis=-1))
    )


def observation_by_tilt(found: TagMeasurements, camera_height_m: float) -> FloatArray:
    """(M, 2, 2) derivative of (range, bearing) by a roll and pitch of base that turn and move the camera unnoticed."""
    range_m, cos, sin = found.range_bearing[:, 0], np.cos(found.range_bearing[:, 1]), np.sin(found.range_bearing[:, 1])
    # Rolling moves the camera to the right, pitching moves it forward; what it sees moves as far the other way.
    by_roll = np.stack([sin, cos / range_m], axis=-1) * camera_height_m
    by_pitch = np.stack([-cos, sin / range_m], axis=-1) * camera_height_m
    by_tilt: FloatArray = np.stack([by_roll, by_pitch], axis=-1) - found.by_turn[..., :2]
    return by_tilt
