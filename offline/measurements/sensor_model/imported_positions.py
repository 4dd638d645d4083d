"""Turns imported positions into tag observations, with the covariance of a noise model where they have none."""

from dataclasses import replace
from typing import Final

import numpy as np

from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray
from groundsbot.calib.geometry import se2
from groundsbot.calib.robot import CAMERA_PARAMETERS, RANGE_OFFSET, TIME_OFFSET, NoiseParameters, Robot
from groundsbot.offline.measurements.covariance_components import CovarianceParts
from groundsbot.offline.measurements.sensor_model.observations import (
    MIN_RANGE_M,
    Observations,
    tag_rates,
    value_rates,
)
from groundsbot.offline.measurements.tags import Positions

# Noise parameters of imported positions that have no covariance of their own.
STAMP_NOISE: Final = "sigma_stamp_s"  # its error is common to all tags of a picture
POSITION_NOISE: Final = ("sigma_range_m", "sigma_range_per_m", "sigma_bearing_rad", STAMP_NOISE)
_BY_TIME: Final = CAMERA_PARAMETERS.index(TIME_OFFSET)
# No tag is observed from farther away; larger values come from damaged files.
MAX_RANGE_M: Final = 1000.0
_LEAST_VARIANCE: Final = 1e-12


def read_positions(
    robot: Robot, positions: Positions, keyframe: IntArray, twist: FloatArray, noise: NoiseParameters
) -> tuple[Observations, list[str]]:
    """Turn imported positions into observations.

    Positions without a covariance become ranges and bearings with the covariance of the noise model.

    Args:
        robot: robot with the sensor's mount and range offset.
        positions: (M,) of one segment.
        keyframe: (M,) the keyframe of each.
        twist: (K, 3) velocity of base (m/s forward, m/s to the left, rad/s) at the keyframes.
        noise: noise with the sigmas of range and bearing.

    Returns:
        The observations, and a warning if some were left out.
    """
    positions = _correct_ranges(robot, positions)
    first, second = positions.value[:, 0], positions.value[:, 1]
    range_m = np.where(positions.polar, first, np.hypot(first, second))
    with np.errstate(invalid="ignore"):
        good = np.isfinite(second) & (range_m > MIN_RANGE_M) & (range_m < MAX_RANGE_M)
    unknown = np.isnan(positions.covariance).all((-1, -2))
    convert = unknown & ~positions.polar
    value = positions.value.copy()
    value[convert] = np.stack([range_m, np.arctan2(second, first)], axis=-1)[convert]
    covariance = positions.covariance.copy()
    modelled = unknown & good
    polar = positions.polar | unknown
    finite = np.where(good[:, None], value, 1.0)  # placeholders for those that are left out below
    by_camera = _by_sensor(robot, finite, polar, positions.in_camera, twist[keyframe])
    parts = _position_parts(range_m, modelled, covariance, by_camera[..., _BY_TIME])
    covariance[modelled] = parts.under(noise)[modelled]
    good &= _are_covariances(covariance)
    observations = Observations(
        keyframe,
        positions.tag,
        value,
        covariance,
        parts,
        by_camera,
        polar,
        positions.in_camera,
        corners_px=np.full((len(value), 4, 2), np.nan),
        corner_bias_px=np.zeros((len(value), 2)),
        corner_sigmas=np.ones(len(value)),
        face=np.full((len(value), 4), np.nan),
        turning_rad_s=twist[keyframe, 2],
        heading_jitter_rad=np.zeros(len(value)),
        camera=np.zeros(len(value), dtype=np.int64),
    )
    if good.all():
        return observations, []
    warning = (
        f"{int((~good).sum())} of {len(good)} tag positions left out: nearer than {MIN_RANGE_M} m, farther than "
        f"{MAX_RANGE_M:.0f} m, or with a covariance that is not positive definite"
    )
    return observations.where(good), [warning]


def with_position_noise(observations: Observations, names: tuple[str, ...] = POSITION_NOISE) -> Observations:
    """Return the observations with the noise of imported positions added to those from corners, at default sigmas.

    This is for drives whose corner residuals are far larger than corner noise, as when stamps jitter or ranges have a
    relative error. The errors then have the form that the noise model assumes for any sensor.
    """
    which = observations.from_corners & observations.polar
    if not which.any():
        return observations
    zeros = np.zeros_like(observations.covariance)
    added = _position_parts(observations.value[:, 0], which, zeros, observations.by_camera[..., _BY_TIME])
    added = CovarianceParts(names, added.of(names), added.rest)
    both = tuple(dict.fromkeys(observations.parts.names + names))
    parts = CovarianceParts(both, observations.parts.of(both) + added.of(both), observations.parts.rest)
    return replace(observations, covariance=observations.covariance + added.under(NoiseParameters()), parts=parts)


def _are_covariances(matrices: FloatArray) -> BoolArray:
    """Return (M,) which of (M, 2, 2) are positive definite and within numerical limits."""
    bounded = np.asarray((np.abs(matrices) < MAX_RANGE_M**2).all((-1, -2)))
    smallest = np.linalg.eigvalsh(np.where(bounded[:, None, None], matrices, 0.0))[:, 0]
    return np.asarray(smallest > _LEAST_VARIANCE)


def _by_sensor(
    robot: Robot, value: FloatArray, polar: BoolArray, in_camera: BoolArray, twist: FloatArray
) -> FloatArray:
    """Return (M, 2, 5) the derivative of imported positions with respect to CAMERA_PARAMETERS.

    Only the time offset and the range offset have an effect.

    Args:
        robot: robot with the mount of the camera.
        value: (M, 2) in either form.
        polar: (M,) whether the value is (range, bearing).
        in_camera: (M,) whether the value is in the camera's planar frame, not in base.
        twist: (M, 3) velocity of base.
    """
    mount = np.where(in_camera[:, None], [robot.mount.x_m, robot.mount.y_m, robot.mount.yaw_rad], 0.0)
    cos, sin = np.cos(value[:, 1]), np.sin(value[:, 1])
    in_sensor = np.where(polar[:, None], value[:, :1] * np.stack([cos, sin], axis=-1), value)
    to_sensor = np.column_stack([np.zeros((len(value), 2)), -mount[:, 2]])
    rates = se2.apply(to_sensor, tag_rates(se2.apply(mount, in_sensor), twist))
    found = np.zeros((len(value), 2, len(CAMERA_PARAMETERS)))
    found[..., _BY_TIME] = value_rates(in_sensor, polar, rates)
    range_m = np.maximum(np.hypot(in_sensor[:, 0], in_sensor[:, 1]), 1e-6)
    outwards = np.where(polar[:, None], [1.0, 0.0], in_sensor / range_m[:, None])
    found[..., CAMERA_PARAMETERS.index(RANGE_OFFSET)] = -outwards
    return found


def _correct_ranges(robot: Robot, positions: Positions) -> Positions:
    """Return positions with ranges corrected by the range offset of robot.yaml."""
    if not robot.range_offset_m:
        return positions
    range_m = np.where(positions.polar, positions.value[:, 0], np.hypot(*positions.value.T))
    scale = 1.0 - robot.range_offset_m / np.maximum(range_m, 1e-6)
    scales = np.where(positions.polar[:, None], np.stack([scale, np.ones_like(scale)], axis=-1), scale[:, None])
    return replace(positions, value=positions.value * scales)


def _position_parts(
    range_m: FloatArray, modelled: BoolArray, covariance: FloatArray, by_stamp: FloatArray
) -> CovarianceParts:
    """Return the components of the covariances of imported positions.

    Args:
        range_m: (M,)
        modelled: (M,) those that have the noise model's covariance.
        covariance: (M, 2, 2) of the others.
        by_stamp: (M, 2) derivative of the positions with respect to time.
    """
    unit = np.zeros((len(POSITION_NOISE), len(range_m), 2, 2))
    unit[0, modelled, 0, 0] = 1.0
    unit[1, modelled, 0, 0] = range_m[modelled] ** 2
    unit[2, modelled, 1, 1] = 1.0
    unit[3, modelled] = (by_stamp[:, :, None] * by_stamp[:, None, :])[modelled]
    return CovarianceParts(POSITION_NOISE, unit, np.where(modelled[:, None, None], 0.0, covariance))
