"""Information of wheels and observations of a harsh drive about its true poses, tags and robot (`harsh_bound`)."""

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from scipy import sparse

from groundsbot.calib.foundation.arrays import FloatArray, IntArray
from groundsbot.calib.geometry import se2
from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.fixtures.drives.harsh import Harsh
from groundsbot.fixtures.pictures.observation_errors import (
    DEGREES_OF_FREEDOM,
    LASTING_BEARING_RAD,
    LASTING_M,
    LASTING_RANGE_PER_M,
    LASTING_S,
    WHITE_BEARING_RAD,
    WHITE_RANGE_M,
    WHITE_RANGE_PER_M,
)
from groundsbot.offline.measurements.run import Run

JITTER_S: Final = 0.01
_GAP_S: Final = 10.0  # what is farther apart shares nothing
_STEP_S: Final = 0.05  # over which speeds are taken
_ROUNDING_NS: Final = 2000
# A robot's numbers: scale and ratio of its wheels, turns, mount x, y and yaw, time offset, range offset.
N_ROBOT: Final = 8


@dataclass(frozen=True)
class DrivenPictures:
    """What one run did in truth: L looks and M observations of them.

    Attributes:
        poses: (L, 3); twist: (L, 2) m/s and rad/s; way_m, turned_rad: (L,) rolled so far.
        look, tag: (M,) of the observations.
    """

    poses: FloatArray
    twist: FloatArray
    seconds: FloatArray
    way_m: FloatArray
    turned_rad: FloatArray
    look: IntArray
    tag: IntArray
    mount: FloatArray


def _tags_of(run: Run) -> tuple[IntArray, IntArray]:
    """(M,) stamps and tags of a run's observations, rising."""
    observations = run.detections if len(run.detections.tag) else run.positions
    order = np.argsort(observations.stamps_ns, kind="stable")
    return observations.stamps_ns[order], observations.tag[order]


def true_observations(run: Run, true: dict[str, Any]) -> tuple[IntArray, IntArray]:
    """The same without those that are of another tag or another place than they say."""
    stamps_ns, tag = _tags_of(run)
    right = np.ones(len(tag), dtype=np.bool_)
    late_ns = round(1e9 * run.robot.time_offset_s)
    for each in true.get("outliers", ()):
        same_id = np.array([run.tags[t].tag_id == each["tag_id"] for t in tag.tolist()])
        right &= ~(same_id & (np.abs(stamps_ns + late_ns - int(each["stamp_ns"])) <= _ROUNDING_NS))
    return stamps_ns[right], tag[right]


def drive_of(run: Run, true: dict[str, Any], index: dict[tuple[str, int], int]) -> DrivenPictures:
    stamped = np.array(true["poses"])
    true_ns, true_poses = np.array([int(each[0]) for each in true["poses"]]), stamped[:, 1:]
    stamps_ns, tag = true_observations(run, true)
    looks_ns, look = np.unique(stamps_ns, return_inverse=True)
    start_ns = int(true_ns[0])
    driven_s = 1e-9 * (true_ns - start_ns)
    parameters = true["parameters"]
    # The run's stamps are already by robot.yaml's offset earlier.
    seconds = 1e-9 * (looks_ns - start_ns) - (parameters["time_offset_s"] - run.robot.time_offset_s)
    theta = np.unwrap(true_poses[:, 2])

    def at(t: FloatArray) -> FloatArray:
        return np.stack([np.interp(t, driven_s, each) for each in (true_poses[:, 0], true_poses[:, 1], theta)], axis=-1)

    poses, before, after = at(seconds), at(seconds - _STEP_S / 2), at(seconds + _STEP_S / 2)
    moved = se2.compose(se2.inverse(before), after)
    steps = np.diff(true_poses[:, :2], axis=0)
    way_m = np.append(0.0, np.cumsum(np.hypot(*steps.T)))
    turned_rad = np.append(0.0, np.cumsum(np.abs(np.diff(theta))))
    return DrivenPictures(
        poses=poses,
        twist=np.stack([moved[:, 0], moved[:, 2]], axis=-1) / _STEP_S,
        seconds=seconds,
        way_m=np.interp(seconds, driven_s, way_m),
        turned_rad=np.interp(seconds, driven_s, turned_rad),
        look=look,
        tag=np.array([index[run.tags[t].family, run.tags[t].tag_id] for t in tag.tolist()]),
        mount=np.array([parameters[f"mount_{name}"] for name in ("x_m", "y_m", "yaw_rad")]),
    )


def information_of_wheels(drive: DrivenPictures, first: int, robot: int, n: int) -> sparse.csc_matrix:
    """Information of the motions between looks."""
    noise = NoiseParameters()
    motion = se2.compose(se2.inverse(drive.poses[:-1]), drive.poses[1:])
    way_m, turned_rad = np.diff(drive.way_m), np.diff(drive.turned_rad)
    variance = (
        np.stack(
            [
                noise.sigma_distance_m_per_sqrt_m**2 * way_m,
                noise.sigma_lateral_m_per_sqrt_m**2 * way_m,
                noise.sigma_heading_rad_per_sqrt_m**2 * way_m + noise.sigma_heading_rad_per_sqrt_rad**2 * turned_rad,
            ],
            axis=-1,
        )
        + np.array([1e-5, 1e-5, 1e-5]) ** 2
    )
    k = np.arange(len(motion))
    cos, sin = np.cos(motion[:, 2]), np.sin(motion[:, 2])
    zero, one = np.zeros(len(k)), np.ones(len(k))
    # Right tangent of the motion, by the right tangents of both poses: minus the inverse motion's adjoint, and one.
    by_first = -np.stack(
        [
            np.stack([cos, sin, cos * -motion[:, 1] + sin * motion[:, 0]], -1),
            np.stack([-sin, cos, sin * motion[:, 1] + cos * motion[:, 0]], -1),
            np.stack([zero, zero, one], -1),
        ],
        axis=1,
    )
    by_last = np.broadcast_to(np.eye(3), by_first.shape)
    by_robot = np.zeros((len(k), 3, N_ROBOT))
    by_robot[:, 0, 0], by_robot[:, 2, 2] = -motion[:, 0], motion[:, 2]
    by_robot[:, 2, 1] = -motion[:, 0] / 0.5
    J = np.concatenate([by_first, by_last, by_robot], axis=-1) / np.sqrt(variance)[:, :, None]
    columns = np.concatenate(
        [first + 3 * k[:, None] + np.arange(6), np.broadcast_to(robot + np.arange(N_ROBOT), (len(k), N_ROBOT))],
        axis=1,
    )
    return _gram(J.reshape(-1, J.shape[-1]), np.repeat(columns, 3, axis=0), n)


def information_of_observations(
    drive: DrivenPictures, tags_m: FloatArray, first: int, tags_at: int, robot: int, n: int, harsh: Collection[Harsh]
) -> sparse.csc_matrix:
    """Information of the observations, whose errors last while a tag passes by."""
    pose, twist = drive.poses[drive.look], drive.twist[drive.look]
    camera = np.broadcast_to(drive.mount, pose.shape)
    in_base = se2.apply(se2.inverse(pose), tags_m[drive.tag])
    in_camera = se2.apply(se2.inverse(camera), in_base)
    range_m = np.hypot(*in_camera.T)
    along = in_camera / range_m[:, None]
    across = np.stack([-along[:, 1], along[:, 0]], axis=-1) / range_m[:, None]
    polar = np.stack([along, across], axis=1)  # (M, 2, 2) of range and bearing by the place in camera
    cos, sin = np.cos(drive.mount[2]), np.sin(drive.mount[2])
    by_place = polar @ np.array([[cos, sin], [-sin, cos]])  # in base
    turned = np.stack([-in_base[:, 1], in_base[:, 0]], axis=-1)
    by_pose = -np.concatenate([by_place, (by_place @ turned[..., None])], axis=-1)
    heading = np.stack([np.cos(pose[:, 2]), np.sin(pose[:, 2])], axis=-1)
    to_base = np.stack([heading, np.stack([-heading[:, 1], heading[:, 0]], axis=-1)], axis=1)
    by_robot = np.zeros((len(pose), 2, N_ROBOT))
    by_robot[:, :, 3:5] = -by_place
    by_robot[:, 1, 5] = -1.0
    # A stamp that is late by dt says the picture of a pose dt before the one that it names.
    rate = np.stack([-twist[:, 0] + twist[:, 1] * in_base[:, 1], -twist[:, 1] * in_base[:, 0]], axis=-1)
    by_time = (by_place @ rate[..., None])[..., 0]
    by_robot[:, :, 6], by_robot[:, 0, 7] = -by_time, 1.0
    by_scale = np.stack([-range_m, np.zeros(len(range_m))], axis=-1)[..., None]
    J = np.concatenate([by_pose, by_place @ to_base, by_robot, by_scale], axis=-1)
    columns = np.concatenate(
        [
            first + 3 * drive.look[:, None] + np.arange(3),
            tags_at + 2 * drive.tag[:, None] + np.arange(2),
            np.broadcast_to(robot + np.arange(N_ROBOT), (len(pose), N_ROBOT)),
            np.full((len(pose), 1), n - 1),
        ],
        axis=1,
    )
    rows, at = [], []
    for own in _passes(drive):
        white = _white_variance(range_m[own], by_time[own], harsh)
        for axis, lasting in ((0, LASTING_RANGE_PER_M * range_m[own]), (1, np.full(len(own), LASTING_BEARING_RAD))):
            covariance = np.diag(white[:, axis])
            if Harsh.LASTING in harsh:
                covariance += lasting[:, None] * _correlation(drive, own) * lasting
            rows.append((np.linalg.inv(np.linalg.cholesky(covariance)), J[own, axis]))
            at.append(columns[own])
    # Whitening mixes the rows of a pass: each becomes one row over the columns of all of them.
    blocks = [
        sparse.csr_matrix(whitening) @ _rows(part, own_columns, n)
        for (whitening, part), own_columns in zip(rows, at, strict=True)
    ]
    whole = sparse.vstack(blocks).tocsc()
    return sparse.csc_matrix(whole.T @ whole)


def _white_variance(range_m: FloatArray, by_time: FloatArray, harsh: Collection[Harsh]) -> FloatArray:
    """(m, 2) of range and bearing: of pixels, of stamps, and of the tails."""
    # Of corners at 0.2 px, a tag of 0.15 m and a focal length of 500 px, four corners to a tag.
    variance = np.stack([(0.2 * range_m**2 / (500.0 * 0.15)) ** 2, np.full(len(range_m), (0.1 / 500.0) ** 2)], axis=-1)
    if Harsh.RANGES in harsh:
        nu = DEGREES_OF_FREEDOM
        scale = np.stack(
            [WHITE_RANGE_M + WHITE_RANGE_PER_M * range_m, np.full(len(range_m), WHITE_BEARING_RAD)], axis=-1
        )
        variance = variance + scale**2 * (nu + 3) / (nu + 1)
    if Harsh.TIME in harsh:
        variance = variance + (JITTER_S * by_time) ** 2
    return np.asarray(variance)


def _correlation(drive: DrivenPictures, own: IntArray) -> FloatArray:
    """(m, m) of errors of some observations of a tag, the sum of both parts."""
    look = drive.look[own]
    seconds, way_m = drive.seconds[look], drive.way_m[look]
    of_time = np.exp(-np.abs(seconds[:, None] - seconds) / LASTING_S)
    return np.asarray(of_time + np.exp(-np.abs(way_m[:, None] - way_m) / LASTING_M))


def _passes(drive: DrivenPictures) -> list[IntArray]:
    """Observations of a tag that follow each other."""
    found = []
    for tag in np.unique(drive.tag):
        own = np.flatnonzero(drive.tag == tag)
        gaps = np.flatnonzero(np.diff(drive.seconds[drive.look[own]]) > _GAP_S)
        found += np.split(own, gaps + 1)
    return found


def _gram(J: FloatArray, columns: IntArray, n: int) -> sparse.csc_matrix:
    """J^T J of rows (m, k) that stand in columns (m, k) of n."""
    whole = _rows(J, columns, n)
    return sparse.csc_matrix(whole.T @ whole)


def _rows(J: FloatArray, columns: IntArray, n: int) -> sparse.csr_matrix:
    """Rows (m, k) that stand in columns (m, k) of n."""
    row = np.repeat(np.arange(len(J)), J.shape[1])
    return sparse.csr_matrix((J.ravel(), (row, columns.ravel())), shape=(len(J), n))
