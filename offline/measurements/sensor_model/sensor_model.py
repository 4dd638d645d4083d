"""Turns the detections of a run into tag observations in metres, each with its covariance."""

from dataclasses import replace
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray
from groundsbot.calib.geometry import se2
from groundsbot.calib.robot import NoiseParameters, Robot
from groundsbot.offline.measurements.covariance_components import CovarianceParts
from groundsbot.offline.measurements.run import Run
from groundsbot.offline.measurements.sensor_model.corner_bias import refined_bias_px
from groundsbot.offline.measurements.sensor_model.floor_tilt import floor_tilt_rad, inflate_by_tilt, observation_by_tilt
from groundsbot.offline.measurements.sensor_model.observations import (
    MIN_RANGE_M,
    Observations,
    concatenate_observations,
    no_observations,
    tag_rates,
    value_rates,
)
from groundsbot.offline.measurements.sensor_model.rolling_shutter import read_at_once
from groundsbot.offline.measurements.sensor_model.stationary_corners import average_corners
from groundsbot.offline.measurements.sensor_model.tag_pose import (
    TagMeasurements,
    general_observations,
    upright_observations,
)
from groundsbot.offline.measurements.sensor_model.tilted_tags import (
    FALSE_ALARM,
    SCALES,
    UPRIGHT_DOF,
    are_tilted,
    common_turn,
    find_tilted,
    level_of,
    smaller_by_tag,
)
from groundsbot.offline.measurements.tags import Detections

# A range with a larger sigma is that of a tag so small that the bias of the range is not far below its sigma.
MAX_RANGE_SIGMA_PER_M: Final = 0.03
# Sizes that differ by no more than rounding are the same.
SAME_SIZE_M: Final = 1e-6
# A rotation of the mount has a linear effect on corners up to here: the rest is a tenth of a pixel.
_LINEAR_RAD: Final = float(np.radians(1.0))
# A warning is given where a larger share of the observations is left out.
MAX_SHARE_LEFT_OUT: Final = 0.05


def read_detections(
    run: Run, detections: Detections, keyframe: IntArray, twist: FloatArray, noise: NoiseParameters
) -> tuple[Observations, list[str]]:
    """Turn corners into observations in the planar frame of their camera.

    Each camera is read on its own: a tag that two see at one moment gives two observations.

    Args:
        run: run with the cameras and the tag sizes.
        detections: (M,) of one segment.
        keyframe: (M,) the keyframe of each.
        twist: (K, 3) velocity of base (m/s forward, m/s to the left, rad/s) at the keyframes.
        noise: noise with the corners' sigma.

    Returns:
        The observations, and warnings about tilted tags and about observations that were left out.
    """
    if not run.robot.cameras:
        return _read_camera(run, detections, keyframe, twist, noise)
    found, warnings = no_observations(), list[str]()
    for number, name in enumerate(run.robot.camera_names):
        own = detections.camera == number
        of_camera, told = _read_camera(run.with_camera(number), detections.where(own), keyframe[own], twist, noise)
        camera = np.full(len(of_camera), number, dtype=np.int64)
        found = concatenate_observations(found, replace(of_camera, camera=camera))
        warnings += [f"camera {name}: {warning}" for warning in told]
    return found, warnings


def _read_camera(
    run: Run, detections: Detections, keyframe: IntArray, twist: FloatArray, noise: NoiseParameters
) -> tuple[Observations, list[str]]:
    """Turn the corners of one camera into observations; see `read_detections`.

    Pictures of one keyframe were taken from one pose while the robot stood, so their corners are averaged. The mean
    keeps the sigma of a single picture, because a detector's errors are nearly the same in all of them. Two tags with
    one id in one picture give two observations.
    """
    camera = run.camera
    if camera is None or not len(detections.tag):
        return no_observations(), []
    # Corners that are not finite are removed before the mean of their keyframe is taken.
    known = np.asarray(np.isfinite(detections.corners_px).all((-1, -2)))
    keyframe, tag, corners_px = average_corners(
        keyframe[known], detections.tag[known], detections.corners_px[known], detections.stamps_ns[known]
    )
    if not len(tag):
        return no_observations(), [
            f"{len(known)} of {len(known)} tag observations left out, because their corners are not finite"
        ]
    sides_m = _sides_m(run, tag)
    at_once_px = read_at_once(run.robot, camera, corners_px, sides_m, twist[keyframe])
    bias_px = refined_bias_px(corners_px) if run.corners_refined else np.zeros((len(tag), 2))
    sigmas_px = np.hypot(noise.sigma_corner_px, bias_px[:, 0])
    found, is_tilted, level, tilt_rad = _upright_or_tilted(run, sides_m, tag, keyframe, at_once_px, sigmas_px)
    good = _are_usable(found, is_tilted, level)
    n, kept = int(good.sum()), found.where(good)
    by_tilt = tilt_rad * observation_by_tilt(kept, run.robot.mount.z_m)
    by_floor = by_tilt @ by_tilt.swapaxes(-1, -2)
    # Bearings are in base's axes; those of the camera's planar frame are relative to the mount's yaw.
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
        face=np.column_stack([kept.face, kept.height_m]),
        turning_rad_s=twist[keyframe[good], 2],
        heading_jitter_rad=np.zeros(n),
        camera=np.zeros(n, dtype=np.int64),
    )
    return observations, _warnings(run, tag[is_tilted], good)


def _are_usable(found: TagMeasurements, is_tilted: BoolArray, level: FloatArray) -> BoolArray:
    """Return (M,) which measurements are of tags large enough for the bias of the range to be far below its sigma.

    Args:
        found: (M,) measurements.
        is_tilted: (M,) those by a general pose, whose sigma covers the bias.
        level: (M,) ratio of the variance of the corners' independent errors to their assumed variance.
    """
    range_m = found.range_bearing[:, 0]
    with np.errstate(invalid="ignore"):
        is_certain = np.minimum(level, 1.0) * found.covariance[:, 0, 0] < (MAX_RANGE_SIGMA_PER_M * range_m) ** 2
        return np.asarray(found.valid & (range_m > MIN_RANGE_M) & (is_certain | is_tilted))


def _warnings(run: Run, tilted_tags: IntArray, good: BoolArray) -> list[str]:
    warnings = [
        f"tag {run.tags[t].tag_id} ({run.tags[t].family}) is not mounted upright; its range gets a sigma of 10 %"
        for t in np.unique(tilted_tags)
    ]
    if (n_bad := int((~good).sum())) > MAX_SHARE_LEFT_OUT * len(good):
        warnings.append(
            f"{n_bad} of {len(good)} tag observations left out, because the tags are too small in the picture or their "
            "corners fit no tag"
        )
    return warnings


def _upright_or_tilted(
    run: Run, sides_m: FloatArray, tag: IntArray, keyframe: IntArray, corners_px: FloatArray, sigmas_px: FloatArray
) -> tuple[TagMeasurements, BoolArray, FloatArray, float]:
    """Measure M tags by the upright model, and those that are not mounted upright by a general pose.

    Returns:
        The measurements; (M,) which are of tilted tags; (M,) the ratio of the variance of the corners' independent
        errors to their assumed variance; and the sigma of base's roll and pitch, rad.
    """
    camera, mount = run.camera, run.robot.mount
    assert camera is not None  # there are detections
    rotation = mount.T_base_camera.rotation.as_matrix()
    upright = upright_observations(corners_px, sides_m, camera, rotation, sigmas_px)
    level, camera_m = max(level_of(upright.chi2), 1.0), np.array([mount.x_m, mount.y_m])
    tilt_rad = floor_tilt_rad(upright, tag, keyframe, camera_m, level)
    if tilt_rad:
        upright = inflate_by_tilt(upright, tilt_rad)
    axes, sigma = mount_axes(run.robot), np.array([mount.roll_rad_sigma, mount.pitch_rad_sigma])
    at, turned, corrected = np.zeros(2), upright, upright.chi2
    for scale in SCALES:
        turn, corrected = common_turn(turned, at, tag, axes, sigma, scale)
        if np.abs((turn - at) * sigma).max() > _LINEAR_RAD:
            at, R_base_camera = turn, Rotation.from_rotvec((turn * sigma) @ axes).as_matrix() @ rotation
            turned = upright_observations(corners_px, sides_m, camera, R_base_camera, sigmas_px)
            turned = inflate_by_tilt(turned, tilt_rad) if tilt_rad else turned
    chi2 = smaller_by_tag(tag, upright.chi2, corrected)
    level = level_of(chi2)
    is_doubted = np.isin(tag, are_tilted(tag, chi2 / min(level, 1.0)))
    general = upright.replace(
        is_doubted,
        general_observations(corners_px[is_doubted], sides_m[is_doubted], camera, rotation, sigmas_px[is_doubted]),
    )
    is_tilted = np.isin(tag, find_tilted(tag, chi2, general.chi2, is_doubted))
    is_outlier = ~is_tilted & ~(chi2 < level_of(chi2[~is_tilted]) * chdtri(UPRIGHT_DOF, FALSE_ALARM))
    found = upright.replace(is_tilted, general.where(is_tilted))
    least_px = sigmas_px.min()
    independent_level = level_of(chi2 * (sigmas_px / least_px) ** 2) * (least_px / sigmas_px) ** 2
    return replace(found, valid=np.asarray(found.valid & ~is_outlier)), is_tilted, independent_level, tilt_rad


def _sides_m(run: Run, tag: IntArray) -> FloatArray:
    """Return (M,) the side of each tag."""
    seen, index = np.unique(tag, return_inverse=True)
    return np.array([run.robot.tag_size_m(run.tags[t].family, run.tags[t].tag_id)[0] for t in seen])[index]


def _by_camera(robot: Robot, found: TagMeasurements, twist: FloatArray) -> FloatArray:
    """Return (M, 2, 5) the derivative of observations from corners with respect to CAMERA_PARAMETERS.

    Args:
        robot: robot with the mount, Rz(yaw) Ry(pitch) Rx(roll).
        found: (M,) measurements.
        twist: (M, 3) velocity of base.
    """
    range_m, bearing_rad = found.range_bearing.T
    from_camera_m = range_m[:, None] * np.stack([np.cos(bearing_rad), np.sin(bearing_rad)], axis=-1)
    rates = tag_rates(np.array([robot.mount.x_m, robot.mount.y_m]) + from_camera_m, twist)
    by_time = value_rates(from_camera_m, np.ones(len(range_m), dtype=np.bool_), rates)
    by_turn = found.by_turn @ mount_axes(robot).T
    by_offset = np.column_stack([np.full(len(range_m), -1.0), np.zeros(len(range_m))])
    return np.concatenate([by_turn, np.stack([by_time, found.by_edge, by_offset], axis=-1)], axis=-1)


def mount_axes(robot: Robot) -> FloatArray:
    """Return (2, 3) the axes in base of the mount's roll and pitch."""
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
    """Return the components of the covariances of observations from corners.

    The corners' sigma is a noise parameter. The tilt of the floor and the corners' common bias are in the rest.
    """
    by_corners = found.covariance - found.rest
    unit = by_corners / sigmas_px[:, None, None] ** 2
    rest = found.rest + by_floor + by_corners - unit * sigma_corner_px**2
    return CovarianceParts(("sigma_corner_px",), unit[None], rest)
