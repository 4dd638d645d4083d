"""Estimates the attitude noise of base on an uneven floor, and its effect on tag observations.

A tag's height is constant, so the difference between its heights in successive pictures shows how much base rolled and
pitched in between. A third of a degree shifts a tag by five pixels, while a corner is known to a fifth of one. The tilt
also moves the camera above base by a few millimetres. Left unmodelled, both appear as motion of the robot and make the
wheel noise several times too large. Constant slopes and an error of the mount cancel in the difference.
"""

from dataclasses import replace
from typing import Final

import numpy as np
from scipy.special import chdtri, ndtri

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.measurements.sensor_model.tag_pose import TagMeasurements

_MEDIAN_CHI2: Final = float(chdtri(1, 0.5))
# The effect of a mount error cancels only between observations from nearly the same range.
_SAME_RANGE: Final = 0.05
_LEAST_PAIRS: Final = 30
# Probability of finding tilt on a level floor. The relative sigma of a median of n squared normal variables is
# 2.3 / sqrt(n), and a fifth more where each observation is in two pairs.
_FALSE_ALARM: Final = 1e-4
_MEDIAN_SIGMA: Final = 2.8
_STEPS: Final = 40


def floor_tilt_rad(
    measurements: TagMeasurements, tag: IntArray, keyframe: IntArray, camera_m: FloatArray, level: float
) -> float:
    """Return the sigma of the roll and pitch of base in each picture, rad; 0 where none is significant.

    The estimate is the value for which the median of squared height differences is as expected, so a few false
    detections do not affect it.

    Args:
        measurements: (M,) by the upright model.
        tag: (M,) index of the tag of each.
        keyframe: (M,) index of the keyframe of each, in order of time.
        camera_m: (2,) position of the camera in base.
        level: ratio of the corners' true variance to the one that the measurements assume.
    """
    order = np.lexsort((keyframe, tag))
    order = order[measurements.valid[order]]
    first, second = order[:-1], order[1:]
    range_m, bearing_rad = measurements.range_bearing.T
    is_pair = (tag[first] == tag[second]) & (keyframe[first] < keyframe[second])
    is_pair &= np.abs(range_m[second] - range_m[first]) < _SAME_RANGE * range_m[first]
    first, second = first[is_pair], second[is_pair]
    if len(first) < _LEAST_PAIRS:
        return 0.0
    square = (measurements.height_m[second] - measurements.height_m[first]) ** 2
    noise = level * (measurements.height_variance[first] + measurements.height_variance[second])
    x_m, y_m = camera_m[0] + range_m * np.cos(bearing_rad), camera_m[1] + range_m * np.sin(bearing_rad)
    lever_m2 = x_m**2 + y_m**2  # base rotates about its origin on the floor
    by_tilt = lever_m2[first] + lever_m2[second]

    def ratio_to_expected(variance: float) -> float:
        return float(np.median(square / (noise + variance * by_tilt))) / _MEDIAN_CHI2

    if ratio_to_expected(0.0) < 1.0 - ndtri(_FALSE_ALARM) * _MEDIAN_SIGMA / np.sqrt(len(first)):
        return 0.0
    low, high = 0.0, float(np.max(square / by_tilt)) / _MEDIAN_CHI2
    for _ in range(_STEPS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if ratio_to_expected(middle) > 1.0 else (low, middle)
    return float(np.sqrt(high))


def inflate_by_tilt(measurements: TagMeasurements, tilt_rad: float) -> TagMeasurements:
    """Return measurements by the upright model whose residuals are whitened with the attitude noise included.

    With the derivative B = U S V^T of the whitened residuals by roll and pitch, their covariance is I + tilt^2 B B^T,
    whose inverse square root is I - U (1 - 1 / sqrt(1 + tilt^2 S^2)) U^T.
    """
    by_tilt = measurements.misfit_by_turn[..., :2]
    by_tilt = np.where(np.isfinite(by_tilt), by_tilt, 0.0)
    axes, singular_values, _ = np.linalg.svd(by_tilt, full_matrices=False)
    shrunk = axes * (1.0 - 1.0 / np.sqrt(1.0 + (tilt_rad * singular_values) ** 2))[:, None, :]
    root = np.eye(8) - shrunk @ axes.swapaxes(-1, -2)
    misfit = (root @ measurements.misfit[..., None])[..., 0]
    return replace(
        measurements,
        misfit=misfit,
        misfit_by_turn=root @ measurements.misfit_by_turn,
        chi2=np.asarray((misfit**2).sum(axis=-1)),
    )


def observation_by_tilt(measurements: TagMeasurements, camera_height_m: float) -> FloatArray:
    """Return (M, 2, 2) the derivative of (range, bearing) with respect to an unmodelled roll and pitch of base."""
    range_m, bearing_rad = measurements.range_bearing.T
    cos, sin = np.cos(bearing_rad), np.sin(bearing_rad)
    # Roll moves the camera to the right and pitch moves it forward; observed tags move the opposite way.
    by_roll = np.stack([sin, cos / range_m], axis=-1) * camera_height_m
    by_pitch = np.stack([-cos, sin / range_m], axis=-1) * camera_height_m
    by_tilt: FloatArray = np.stack([by_roll, by_pitch], axis=-1) - measurements.by_turn[..., :2]
    return by_tilt
