"""Factors that measure a known state, each under a covariance of its own."""

from collections.abc import Callable

import numpy as np

from groundsbot.calib.foundation.arrays import BoolArray, FloatArray, IntArray
from groundsbot.calib.geometry import se2
from groundsbot.calib.robot.parameters import CAMERA_PARAMETERS
from groundsbot.offline.sam.factors.odometry_and_observations import (
    ObservationFactors,
    OdometryFactors,
    State,
    whitening,
)


def odometry_of(
    truth: State,
    first: IntArray,
    parameters: IntArray,
    rng: np.random.Generator,
    *,
    by_wheels: float,
    noise: float = 1.0,
) -> OdometryFactors:
    """Motions from poses to the next ones.

    Args:
        truth: what is measured.
        first: (M,) the poses.
        parameters: (M, 3) of wheels, indices into the calibration.
        rng: draws covariances, derivatives and errors.
        by_wheels: size of the derivatives by these.
        noise: measurements are off by this many of their sigmas.
    """
    n = len(first)
    root = 0.03 * (np.eye(3) + 0.4 * rng.standard_normal((n, 3, 3)))
    jacobian = by_wheels * rng.standard_normal((n, 3, 3))
    moved = se2.between(truth.poses[first], truth.poses[first + 1])
    error = noise * np.einsum("nij,nj->ni", root, rng.standard_normal((n, 3)))
    by_calibration = np.einsum("nij,nj->ni", jacobian, truth.calibration[parameters])
    motion = se2.compose(se2.compose(moved, se2.exp(error)), se2.inverse(se2.exp(by_calibration)))
    return OdometryFactors(first, motion, whitening(root @ root.swapaxes(-1, -2)), jacobian, parameters)


def observations_of(
    truth: State,
    pose: IntArray,
    tag: IntArray,
    polar: BoolArray,
    mounted: BoolArray,
    parameters: tuple[IntArray, IntArray, IntArray],
    spoil: Callable[[FloatArray], None],
    rng: np.random.Generator,
    noise: float = 1.0,
) -> ObservationFactors:
    """Tags read from poses.

    Args:
        truth: what is measured.
        pose: (N,) from where.
        tag: (N,) which.
        polar: (N,) as range and bearing.
        mounted: (N,) about a camera that stands off base.
        parameters: (N, 3) of the mount, (N,) of the tag's scale, (N, C) of CAMERA_PARAMETERS, of a mounted camera:
            indices into the calibration.
        spoil: makes some of the values (N, 2) wrong.
        rng: draws covariances, derivatives and errors.
        noise: as of `odometry_of`.
    """
    n = len(pose)
    mount_parameters = np.where(mounted[:, None], parameters[0], 0)
    mount = np.where(mounted[:, None], [0.2, -0.1, 0.3], 0.0)
    root = 0.05 * (np.eye(2) + 0.3 * rng.standard_normal((n, 2, 2)))
    sensor = se2.compose(truth.poses[pose], mount + truth.calibration[mount_parameters])
    place = se2.apply(se2.inverse(sensor), truth.tags[tag]) / (1.0 + truth.calibration[parameters[1]])[:, None]
    as_polar = np.column_stack([np.hypot(*place.T), np.arctan2(place[:, 1], place[:, 0])])
    value = np.where(polar[:, None], as_polar, place)
    value += noise * np.einsum("nij,nj->ni", root, rng.standard_normal((n, 2)))
    spoil(value)
    # All but three columns by a generator of their own: another parameter leaves all other draws as they were.
    more = rng.spawn(1)[0].standard_normal((len(CAMERA_PARAMETERS) - 3, n, 2))
    drawn = np.concatenate([rng.standard_normal((n, 2, 3)), np.moveaxis(more, 0, -1)], axis=-1)
    by_camera = 0.5 * mounted[:, None, None] * drawn
    camera_parameters = np.where(mounted[:, None], parameters[2], 0)
    value -= np.einsum("nij,nj->ni", by_camera, truth.calibration[camera_parameters])
    covariance = root @ root.swapaxes(-1, -2)
    return ObservationFactors(
        pose, tag, value, polar, whitening(covariance), mount, mount_parameters, parameters[1], by_camera,
        camera_parameters, rng.spawn(1)[0].standard_normal(n),
    )  # fmt: skip
