"""How accurate any estimate of harsh drives can be on the floor plane: the Cramer-Rao bound, from the truth.

Independent of the estimate: from the true poses and the model of `fixtures.drives.harsh`, on range and bearing. Unknown
are a pose wherever a tag is read, each tag's place, and the robots' numbers, of which only the wide priors are known
that the simulator draws them from. Errors of observations are what the switches say; those of pixels besides. Outliers
and the way in which `speeds` spoils the wheels are taken for known, so the bound lies below what can be reached.

Of Student's t with nu degrees of freedom and scale s the information is that of a normal distribution with a variance
of s^2 (nu + 3) / (nu + 1) (Lange, Little and Taylor, "Robust statistical modeling using the t distribution", 1989).
"""

import json
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from groundsbot.calib.foundation.arrays import FloatArray, IntArray
from groundsbot.calib.geometry import se2
from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.fixtures.drives.harsh import (
    MOUNT_M,
    MOUNT_YAW_RAD,
    RANGE_OFFSET_M,
    TAG_SCALE,
    TIME_OFFSET_S,
    TURNS,
    Harsh,
)
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
_N_ROBOT: Final = 8


@dataclass(frozen=True)
class _Drive:
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


def shape_bound_m(runs: Sequence[Run], truth: Path, harsh: Collection[Harsh]) -> float:
    """The least RMSE in metres of the tags that the runs saw, moved and turned onto the truth.

    Args:
        runs: of one seed.
        truth: truth.json of the same.
        harsh: the switches that are on.
    """
    told: dict[str, Any] = json.loads(truth.read_text(encoding="utf-8"))
    places = {(tag["family"], tag["tag_id"]): np.array(tag["position_m"][:2]) for tag in told["tags"]}
    seen = sorted({key for run in runs for key in _tags_seen(run, told)})
    index = {key: i for i, key in enumerate(seen)}
    tags_m = np.array([places[key] for key in seen])
    return _rmse_of_shape(_tag_covariance(runs, told, harsh, [index] * len(runs), tags_m), tags_m)


def shift_sigmas(runs: Sequence[Run], truth: Path, harsh: Collection[Harsh]) -> dict[int, float]:
    """By how many sigmas of what can be known at most each changed tag was moved, all other tags where they were.

    Args:
        runs: of one seed, driven one after the other; tags were changed after the first.
        truth: truth.json of the same, where a changed tag has two places, instances a and b.
        harsh: the switches that are on.

    Returns:
        By id; of tags that only one side of the change read, nothing is known: they are left out.
    """
    told: dict[str, Any] = json.loads(truth.read_text(encoding="utf-8"))
    first = min(runs, key=lambda run: int(told["runs"][run.name]["poses"][0][0]))
    places = {
        (tag["family"], tag["tag_id"], tag.get("instance") or ""): np.array(tag["position_m"][:2])
        for tag in told["tags"]
    }

    def named(run: Run, key: tuple[str, int]) -> tuple[str, int, str]:
        return (*key, ("a" if run is first else "b") if (*key, "b") in places else "")

    seen = sorted({named(run, key) for run in runs for key in _tags_seen(run, told)})
    index = {name: i for i, name in enumerate(seen)}
    of_runs = [{key: index[named(run, key)] for key in _tags_seen(run, told)} for run in runs]
    tags_m = np.array([places[name] for name in seen])
    covariance = _tag_covariance(runs, told, harsh, of_runs, tags_m)
    found = {}
    for family, tag_id, instance in seen:
        if instance == "a" and (family, tag_id, "b") in index:
            i, j = index[family, tag_id, "a"], index[family, tag_id, "b"]
            rows = [2 * i, 2 * i + 1, 2 * j, 2 * j + 1]
            difference = np.hstack([-np.eye(2), np.eye(2)])
            off_m = tags_m[j] - tags_m[i]
            shift = difference @ covariance[np.ix_(rows, rows)] @ difference.T
            found[tag_id] = float(np.sqrt(off_m @ np.linalg.solve(shift, off_m)))
    return found


def _tags_seen(run: Run, told: dict[str, Any]) -> set[tuple[str, int]]:
    """Family and id of the tags that a run read rightly."""
    return {
        (run.tags[t].family, run.tags[t].tag_id) for t in _true_observations(run, told["runs"][run.name])[1].tolist()
    }


def _tag_covariance(
    runs: Sequence[Run],
    told: dict[str, Any],
    harsh: Collection[Harsh],
    indices: Sequence[dict[tuple[str, int], int]],
    tags_m: FloatArray,
) -> FloatArray:
    """(2T, 2T) the bound of the tags (T, 2), which each run's observations are of by its index; first pose held."""
    drives = [_drive(run, told["runs"][run.name], index) for run, index in zip(runs, indices, strict=True)]
    n_poses = sum(len(each.poses) for each in drives)
    tags_at, robots_at = 3 * n_poses, 3 * n_poses + 2 * len(tags_m)
    n = robots_at + _N_ROBOT * len(drives) + 1
    information = sparse.lil_matrix((n, n))
    information.setdiag(
        np.append(np.zeros(robots_at), np.append(_prior_sigmas(runs, harsh), _tag_sigma(harsh)) ** -2.0)
    )
    total = sparse.csc_matrix(information)
    first = 0
    for i, drive in enumerate(drives):
        robot = robots_at + _N_ROBOT * i
        observations = _of_observations(drive, tags_m, first, tags_at, robot, n, harsh)
        total = sparse.csc_matrix(total + _of_wheels(drive, first, robot, n) + observations)
        first += 3 * len(drive.poses)
    # A frame, to have a covariance at all: what the shape is does not depend on it.
    held = sparse.csc_matrix((np.full(3, 1e6), (np.arange(3), np.arange(3))), shape=(n, n))
    columns = np.arange(tags_at, robots_at)
    units = np.zeros((n, len(columns)))
    units[columns, np.arange(len(columns))] = 1.0
    return np.asarray(splu(sparse.csc_matrix(total + held)).solve(units)[columns])


def _rmse_of_shape(covariance: FloatArray, tags_m: FloatArray) -> float:
    """Of tags (T, 2) with covariance (2T, 2T), what moves and turns all of them alike taken out."""
    about = tags_m - tags_m.mean(axis=0)
    ones, none = np.ones(len(about)), np.zeros(len(about))
    together = np.stack([ones, none, none, ones, -about[:, 1], about[:, 0]], axis=-1)
    basis, _ = np.linalg.qr(np.stack([together[:, :2], together[:, 2:4], together[:, 4:]], axis=-1).reshape(-1, 3))
    rest = np.eye(len(covariance)) - basis @ basis.T
    return float(np.sqrt(np.trace(rest @ covariance @ rest) / len(about)))


def _prior_sigmas(runs: Sequence[Run], harsh: Collection[Harsh]) -> FloatArray:
    """(8R,) of the robots' numbers: robot.yaml's, or the deviation of the distribution that a switch draws from."""
    found = []
    for run in runs:
        wheels, mount = run.robot.wheels, run.robot.mount
        left, right = (
            wheels.radius_left_m_sigma / wheels.radius_left_m,
            wheels.radius_right_m_sigma / wheels.radius_right_m,
        )
        sigmas = [
            0.5 * np.hypot(left, right), np.hypot(left, right), wheels.track_m_sigma / wheels.track_m,
            mount.x_m_sigma, mount.y_m_sigma, mount.yaw_rad_sigma, run.robot.time_offset_s_sigma, 1e-6,
        ]  # fmt: skip
        if Harsh.TURNS in harsh:
            sigmas[2] = (TURNS[1] - TURNS[0]) / 12**0.5
        if Harsh.MOUNT in harsh:
            sigmas[3:6] = [MOUNT_M / 6**0.5, MOUNT_M / 6**0.5, 2 * MOUNT_YAW_RAD / 12**0.5]
        if Harsh.TIME in harsh:
            sigmas[6] = (TIME_OFFSET_S[1] - TIME_OFFSET_S[0]) / 12**0.5
        if Harsh.RANGES in harsh:
            sigmas[7] = 2 * RANGE_OFFSET_M / 12**0.5
        found += sigmas
    return np.array(found)


def _tag_sigma(harsh: Collection[Harsh]) -> float:
    return 2 * TAG_SCALE / 12**0.5 if Harsh.SCALE in harsh else 0.005


def _tags_of(run: Run) -> tuple[IntArray, IntArray]:
    """(M,) stamps and tags of a run's observations, rising."""
    observations = run.detections if len(run.detections.tag) else run.positions
    order = np.argsort(observations.stamps_ns, kind="stable")
    return observations.stamps_ns[order], observations.tag[order]


def _true_observations(run: Run, true: dict[str, Any]) -> tuple[IntArray, IntArray]:
    """The same without those that are of another tag or another place than they say."""
    stamps_ns, tag = _tags_of(run)
    right = np.ones(len(tag), dtype=np.bool_)
    late_ns = round(1e9 * run.robot.time_offset_s)
    for each in true.get("outliers", ()):
        same_id = np.array([run.tags[t].tag_id == each["tag_id"] for t in tag.tolist()])
        right &= ~(same_id & (np.abs(stamps_ns + late_ns - int(each["stamp_ns"])) <= _ROUNDING_NS))
    return stamps_ns[right], tag[right]


def _drive(run: Run, true: dict[str, Any], index: dict[tuple[str, int], int]) -> _Drive:
    stamped = np.array(true["poses"])
    true_ns, true_poses = np.array([int(each[0]) for each in true["poses"]]), stamped[:, 1:]
    stamps_ns, tag = _true_observations(run, true)
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
    return _Drive(
        poses=poses,
        twist=np.stack([moved[:, 0], moved[:, 2]], axis=-1) / _STEP_S,
        seconds=seconds,
        way_m=np.interp(seconds, driven_s, way_m),
        turned_rad=np.interp(seconds, driven_s, turned_rad),
        look=look,
        tag=np.array([index[run.tags[t].family, run.tags[t].tag_id] for t in tag.tolist()]),
        mount=np.array([parameters[f"mount_{name}"] for name in ("x_m", "y_m", "yaw_rad")]),
    )


def _of_wheels(drive: _Drive, first: int, robot: int, n: int) -> sparse.csc_matrix:
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
    by_robot = np.zeros((len(k), 3, _N_ROBOT))
    by_robot[:, 0, 0], by_robot[:, 2, 2] = -motion[:, 0], motion[:, 2]
    by_robot[:, 2, 1] = -motion[:, 0] / 0.5
    J = np.concatenate([by_first, by_last, by_robot], axis=-1) / np.sqrt(variance)[:, :, None]
    columns = np.concatenate(
        [first + 3 * k[:, None] + np.arange(6), np.broadcast_to(robot + np.arange(_N_ROBOT), (len(k), _N_ROBOT))],
        axis=1,
    )
    return _gram(J.reshape(-1, J.shape[-1]), np.repeat(columns, 3, axis=0), n)


def _of_observations(
    drive: _Drive, tags_m: FloatArray, first: int, tags_at: int, robot: int, n: int, harsh: Collection[Harsh]
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
    by_robot = np.zeros((len(pose), 2, _N_ROBOT))
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
            np.broadcast_to(robot + np.arange(_N_ROBOT), (len(pose), _N_ROBOT)),
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


def _correlation(drive: _Drive, own: IntArray) -> FloatArray:
    """(m, m) of errors of some observations of a tag, the sum of both parts."""
    look = drive.look[own]
    seconds, way_m = drive.seconds[look], drive.way_m[look]
    of_time = np.exp(-np.abs(seconds[:, None] - seconds) / LASTING_S)
    return np.asarray(of_time + np.exp(-np.abs(way_m[:, None] - way_m) / LASTING_M))


def _passes(drive: _Drive) -> list[IntArray]:
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
