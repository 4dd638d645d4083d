"""Detections and imported positions of one run -> tag observations in metres, each with its covariance."""

from dataclasses import replace
from typing import Final

import numpy as np
from scipy.special import chdtri

from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray
from groundsbot.calib.geometry import se2
from groundsbot.calib.robot import CAMERA_PARAMETERS, RANGE_OFFSET, TIME_OFFSET, NoiseParameters, Robot
from groundsbot.offline.measurements.covariance_components import CovarianceParts
from groundsbot.offline.measurements.run import Run
from groundsbot.offline.measurements.sensor_model.corner_bias import refined_bias_px
from groundsbot.offline.measurements.sensor_model.floor_tilt import floor_tilt_rad, inflate_by_tilt, observation_by_tilt
from groundsbot.offline.measurements.sensor_model.observations import Observations, no_observations
from groundsbot.offline.measurements.sensor_model.rolling_shutter import read_at_once
from groundsbot.offline.measurements.sensor_model.stationary_corners import average_corners
from groundsbot.offline.measurements.sensor_model.tag_pose import (
    TagMeasurements,
    general_observations,
    upright_observations,
)
from groundsbot.offline.measurements.sensor_model.tilted_tags import (
    FALSE_ALARM,
    UPRIGHT_DOF,
    are_tilted,
    find_tilted,
    level_of,
    with_common_turn,
)
from groundsbot.offline.measurements.tags import Detections, Positions

# What the covariance of an imported position without one is made of.
STAMP_NOISE: Final = "sigma_stamp_s"  # an error of it is common to all that a picture shows
POSITION_NOISE: Final = ("sigma_range_m", "sigma_range_per_m", "sigma_bearing_rad", STAMP_NOISE)
_BY_TIME: Final = CAMERA_PARAMETERS.index(TIME_OFFSET)

# A range less certain than this comes from a tag so small that the observation's bias is no longer far below its sigma.
MAX_RANGE_SIGMA_PER_M: Final = 0.03
# Nearer than this an observation is a false detection, and its covariance would wreck the condition of the solve.
MIN_RANGE_M: Final = 0.1
# Farther than this no tag is read; numbers beyond come from broken files.
MAX_RANGE_M: Final = 1000.0
_LEAST_VARIANCE: Final = 1e-12
# One printed size, but for rounding.
SAME_SIZE_M: Final = 1e-6
# More than this share of observations left out is worth a sentence.
MAX_SHARE_LEFT_OUT: Final = 0.05


def read_detections(
    run: Run, detections: Detections, keyframe: IntArray, twist: FloatArray, noise: NoiseParameters
) -> tuple[Observations, list[str]]:
    """Turns corners into observations about the camera.

    Pictures that share a keyframe were taken from one standing pose: their corners are averaged, and the average keeps
    the sigma of one picture, since what a detector gets wrong it gets wrong in each of them. Two tags with one id in
    one picture are two observations.

    Args:
        run: whose camera and tag sizes apply.
        detections: (M,) of one segment.
        keyframe: (M,) the keyframe of each.
        twist: (K, 3) velocity of base (m/s forward, m/s to the left, rad/s) at the keyframes.
        noise: for the corners' sigma.

    Returns:
        The observations, and sentences about those that were left out.
    """
    camera = run.camera
    if camera is None or not len(detections.tag):
        return no_observations(), []
    # A corner that is no number would spoil the mean of its standing pose.
    known = np.asarray(np.isfinite(detections.corners_px).all((-1, -2)))
    keyframe, tag, corners_px = average_corners(
        keyframe[known], detections.tag[known], detections.corners_px[known], detections.stamps_ns[known]
    )
    if not len(tag):
        return no_observations(), [
            f"{len(known)} of {len(known)} tag observations left out: their corners are no numbers"
        ]
    sides_m = _sides_m(run, tag)
    at_once_px = read_at_once(run.robot, camera, corners_px, sides_m, twist[keyframe])
    bias_px = refined_bias_px(corners_px) if run.corners_refined else np.zeros((len(tag), 2))
    sigmas_px = np.hypot(noise.sigma_corner_px, bias_px[:, 0])
    found, is_askew, level, tilt_rad = _upright_or_tilted(run, sides_m, tag, keyframe, at_once_px, sigmas_px)
    good = _good(found, is_askew, level)
    n, kept = int(good.sum()), found.where(good)
    by_tilt = tilt_rad * observation_by_tilt(kept, run.robot.mount.z_m)
    by_floor = by_tilt @ by_tilt.swapaxes(-1, -2)
    # From base's axes to the camera's yaw, about which all observations in_camera are.
    bearing_rad = se2.wrap_angle(kept.range_bearing[:, 1] - run.robot.mount.yaw_rad)
    observations = Observations(
        keyframe=keyframe[good],
        tag=tag[good],
        value=np.stack([kept.range_bearing[:, 0] - run.robot.range_offset_m, bearing_rad], axis=-1),
        covariance=kept.covariance + by_floor,
        parts=_corner_parts(kept, noise.sigma_corner_px, sigmas_px[good], by_floor),
        by_camera=_by_camera(run.robot, kept, twist[keyframe[good]]),
        polar=np.ones(n, dtype=np.bool_),
        in_camera=np.ones(n, dtype=np.bool_),
        corners_px=corners_px[good],
        corner_bias_px=bias_px[good],
        corner_sigmas=np.ones(n),
    )
    return observations, _warnings(run, tag[is_askew], good)


def _good(found: TagMeasurements, is_askew: BoolArray, level: FloatArray) -> BoolArray:
    """(M,) observations of tags that are near and large enough for their range to have no bias beside its sigma.

    Args:
        found: the observations.
        is_askew: (M,) whose range is trusted to little as it is.
        level: (M,) how many times random errors of corners have the variance that is told.
    """
    range_m = found.range_bearing[:, 0]
    with np.errstate(invalid="ignore"):
        sure = np.minimum(level, 1.0) * found.covariance[:, 0, 0] < (MAX_RANGE_SIGMA_PER_M * range_m) ** 2
        return np.asarray(found.valid & (range_m > MIN_RANGE_M) & (sure | is_askew))


def _warnings(run: Run, askew_tags: IntArray, good: BoolArray) -> list[str]:
    """Sentences about tags that hang askew, and about observations that are not good."""
    told = [
        f"tag {run.tags[t].tag_id} ({run.tags[t].family}) does not hang upright; its range is trusted to 10 % only"
        for t in np.unique(askew_tags)
    ]
    if (n_bad := int((~good).sum())) > MAX_SHARE_LEFT_OUT * len(good):
        told.append(
            f"{n_bad} of {len(good)} tag observations left out: too small in the picture, or corners no tag has"
        )
    return told


def _upright_or_tilted(
    run: Run, sides_m: FloatArray, tag: IntArray, keyframe: IntArray, corners_px: FloatArray, sigmas_px: FloatArray
) -> tuple[TagMeasurements, BoolArray, FloatArray, float]:
    """Observations (M,) by the upright model, or by the general pose for tags that hang askew; (M,) which those are.

    Besides (M,) how many times the corners' random errors have the variance that is told of all their errors, and the
    sigma by which the floor tilts base.
    """
    camera, mount = run.camera, run.robot.mount
    assert camera is not None  # it saw them
    rotation = mount.T_base_camera.rotation.as_matrix()
    upright = upright_observations(corners_px, sides_m, camera, rotation, sigmas_px)
    level, camera_m = max(level_of(upright.chi2), 1.0), np.array([mount.x_m, mount.y_m])
    tilt_rad = floor_tilt_rad(upright, tag, keyframe, camera_m, level)
    if tilt_rad:
        upright = inflate_by_tilt(upright, tilt_rad)
    sigma = np.array([mount.roll_rad_sigma, mount.pitch_rad_sigma])
    chi2 = with_common_turn(upright, tag, _mount_axes(run.robot), sigma)
    level = level_of(chi2)
    is_doubted = np.isin(tag, are_tilted(tag, chi2 / min(level, 1.0)))
    general = upright.replace(
        is_doubted,
        general_observations(corners_px[is_doubted], sides_m[is_doubted], camera, rotation, sigmas_px[is_doubted]),
    )
    is_askew = np.isin(tag, find_tilted(tag, chi2, general.chi2, is_doubted))
    spoilt = ~is_askew & ~(chi2 < level_of(chi2[~is_askew]) * chdtri(UPRIGHT_DOF, FALSE_ALARM))
    found = upright.replace(is_askew, general.where(is_askew))
    least_px = sigmas_px.min()
    random = level_of(chi2 * (sigmas_px / least_px) ** 2) * (least_px / sigmas_px) ** 2
    return replace(found, valid=np.asarray(found.valid & ~spoilt)), is_askew, random, tilt_rad


def _sides_m(run: Run, tag: IntArray) -> FloatArray:
    """(M,) of each tag."""
    seen, index = np.unique(tag, return_inverse=True)
    return np.array([run.robot.tag_size_m(run.tags[t].family, run.tags[t].tag_id)[0] for t in seen])[index]


def read_positions(
    robot: Robot, positions: Positions, keyframe: IntArray, twist: FloatArray, noise: NoiseParameters
) -> tuple[Observations, list[str]]:
    """Imported positions as observations; where the log gives no covariance, range and bearing get the noise model's.

    Args:
        robot: whose sensor it is: its mount, and by how much it reads ranges too long.
        positions: (M,) of one segment.
        keyframe: (M,) the keyframe of each.
        twist: (K, 3) velocity of base (m/s forward, m/s to the left, rad/s) at the keyframes.
        noise: for the sigmas of range and bearing.

    Returns:
        The observations, and a sentence if some were left out.
    """
    positions = _with_right_ranges(robot, positions)
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
    usable = np.where(good[:, None], value, 1.0)  # others may be no numbers, and are left out below
    by_camera = _by_sensor(robot, usable, polar, positions.in_camera, twist[keyframe])
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
    )
    if good.all():
        return observations, []
    left_out = (
        f"{int((~good).sum())} of {len(good)} tag positions left out: nearer than {MIN_RANGE_M} m, farther than "
        f"{MAX_RANGE_M:.0f} m, or with a covariance that is none"
    )
    return observations.where(good), [left_out]


def with_position_noise(observations: Observations, names: tuple[str, ...] = POSITION_NOISE) -> Observations:
    """Observations of corners that besides err as positions do of which no covariance is given, by the default noise.

    Where a drive shows that corners err by far more than pixels explain, as when stamps jitter or a tag's range is read
    wrong by a share of it, nothing is known of how they err but what is known of any sensor.
    """
    which = observations.from_corners & observations.polar
    if not which.any():
        return observations
    unknown = np.full_like(observations.covariance, 0.0)
    more = _position_parts(observations.value[:, 0], which, unknown, observations.by_camera[..., _BY_TIME])
    more = CovarianceParts(names, more.of(names), more.rest)
    both = tuple(dict.fromkeys(observations.parts.names + names))
    parts = CovarianceParts(both, observations.parts.of(both) + more.of(both), observations.parts.rest)
    return replace(observations, covariance=observations.covariance + more.under(NoiseParameters()), parts=parts)


def _are_covariances(matrices: FloatArray) -> BoolArray:
    """(M,) which of (M, 2, 2) are positive definite, and of a size to compute with."""
    sane = np.asarray((np.abs(matrices) < MAX_RANGE_M**2).all((-1, -2)))
    smallest = np.linalg.eigvalsh(np.where(sane[:, None, None], matrices, 0.0))[:, 0]
    return np.asarray(smallest > _LEAST_VARIANCE)


def _by_camera(robot: Robot, found: TagMeasurements, twist: FloatArray) -> FloatArray:
    """(M, 2, 5) derivative of observations of corners by CAMERA_PARAMETERS.

    Args:
        robot: its mount is Rz(yaw) Ry(pitch) Rx(roll).
        found: (M,) the observations.
        twist: (M, 3) velocity of base.
    """
    range_m, bearing_rad = found.range_bearing.T
    apart_m = range_m[:, None] * np.stack([np.cos(bearing_rad), np.sin(bearing_rad)], axis=-1)
    rates = _rates(np.array([robot.mount.x_m, robot.mount.y_m]) + apart_m, twist)
    by_time = _by_place(apart_m, np.ones(len(range_m), dtype=np.bool_), rates)
    by_turn = found.by_turn @ _mount_axes(robot).T
    by_offset = np.column_stack([np.full(len(range_m), -1.0), np.zeros(len(range_m))])
    return np.concatenate([by_turn, np.stack([by_time, found.by_edge, by_offset], axis=-1)], axis=-1)


def _by_sensor(
    robot: Robot, value: FloatArray, polar: BoolArray, in_camera: BoolArray, twist: FloatArray
) -> FloatArray:
    """(M, 2, 5) derivative of imported positions by CAMERA_PARAMETERS: by time offset and range offset only.

    Args:
        robot: whose mount holds for those that are in_camera.
        value: (M, 2) in either form.
        polar: (M,) which.
        in_camera: (M,) about the camera's place and yaw, else about base.
        twist: (M, 3) velocity of base.
    """
    mount = np.where(in_camera[:, None], [robot.mount.x_m, robot.mount.y_m, robot.mount.yaw_rad], 0.0)
    cos, sin = np.cos(value[:, 1]), np.sin(value[:, 1])
    in_sensor = np.where(polar[:, None], value[:, :1] * np.stack([cos, sin], axis=-1), value)
    to_sensor = np.column_stack([np.zeros((len(value), 2)), -mount[:, 2]])
    rates = se2.apply(to_sensor, _rates(se2.apply(mount, in_sensor), twist))
    found = np.zeros((len(value), 2, len(CAMERA_PARAMETERS)))
    found[..., _BY_TIME] = _by_place(in_sensor, polar, rates)
    range_m = np.maximum(np.hypot(in_sensor[:, 0], in_sensor[:, 1]), 1e-6)
    outwards = np.where(polar[:, None], [1.0, 0.0], in_sensor / range_m[:, None])
    found[..., CAMERA_PARAMETERS.index(RANGE_OFFSET)] = -outwards
    return found


def _rates(in_base_m: FloatArray, twist: FloatArray) -> FloatArray:
    """(M, 2) m/s by which tags (M, 2) move in base: a picture that was taken later shows them there."""
    forward, left, turning = twist.T
    return np.stack([turning * in_base_m[:, 1] - forward, -turning * in_base_m[:, 0] - left], axis=-1)


def _by_place(in_sensor_m: FloatArray, polar: BoolArray, moved: FloatArray) -> FloatArray:
    """(M, 2) change of observations where tags (M, 2) move by (M, 2) in the sensor's axes."""
    x, y = in_sensor_m.T
    range_m = np.maximum(np.hypot(x, y), 1e-6)
    along, across = (x * moved[:, 0] + y * moved[:, 1]) / range_m, (x * moved[:, 1] - y * moved[:, 0]) / range_m
    return np.where(polar[:, None], np.stack([along, across / range_m], axis=-1), moved)


def _with_right_ranges(robot: Robot, positions: Positions) -> Positions:
    """Positions with ranges as they are, where robot.yaml says how the sensor reads them."""
    if not robot.range_offset_m:
        return positions
    range_m = np.where(positions.polar, positions.value[:, 0], np.hypot(*positions.value.T))
    shorter = 1.0 - robot.range_offset_m / np.maximum(range_m, 1e-6)
    times = np.where(positions.polar[:, None], np.stack([shorter, np.ones_like(shorter)], axis=-1), shorter[:, None])
    return replace(positions, value=positions.value * times)


def _mount_axes(robot: Robot) -> FloatArray:
    """(2, 3) the axes in base about which roll and pitch turn the mount."""
    yaw, pitch = robot.mount.yaw_rad, robot.mount.pitch_rad
    return np.array(
        [
            [np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), -np.sin(pitch)],
            [-np.sin(yaw), np.cos(yaw), 0.0],
        ]
    )


def _corner_parts(
    found: TagMeasurements, sigma_corner_px: float, sigmas_px: FloatArray, by_floor: FloatArray
) -> CovarianceParts:
    """By the noise model's sigma, which is fitted; the rest is by the floor, and by what (M,) corners err by alike."""
    by_corners = found.covariance - found.rest
    unit = by_corners / sigmas_px[:, None, None] ** 2
    rest = found.rest + by_floor + by_corners - unit * sigma_corner_px**2
    return CovarianceParts(("sigma_corner_px",), unit[None], rest)


def _position_parts(
    range_m: FloatArray, modelled: BoolArray, covariance: FloatArray, by_stamp: FloatArray
) -> CovarianceParts:
    """Of imported positions: by the noise model, or as the log says; (M, 2) is their change in a second."""
    unit = np.zeros((len(POSITION_NOISE), len(range_m), 2, 2))
    unit[0, modelled, 0, 0] = 1.0
    unit[1, modelled, 0, 0] = range_m[modelled] ** 2
    unit[2, modelled, 1, 1] = 1.0
    unit[3, modelled] = (by_stamp[:, :, None] * by_stamp[:, None, :])[modelled]
    return CovarianceParts(POSITION_NOISE, unit, np.where(modelled[:, None, None], 0.0, covariance))
