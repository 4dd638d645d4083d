"""The Cramer-Rao bound of a simulated world and seed, from what `fixtures` drew."""

from typing import Final

import numpy as np

from groundsbot.calib.errors import CalibError
from groundsbot.calib.foundation.arrays import FloatArray, IntArray
from groundsbot.calib.robot.robot_yaml import Robot
from groundsbot.fixtures.drives.calibration import nominal_robot, true_tag_sizes_m
from groundsbot.fixtures.pictures.visibility import tracks
from groundsbot.fixtures.recording.session import Options, Session, prepare
from groundsbot.fixtures.worlds.scene import Tags, tags_of
from groundsbot.fixtures.worlds.world import World
from tests.benchmarks.accuracy.cramer_rao import Bound, cramer_rao
from tests.benchmarks.accuracy.cramer_rao_gyro import GyroNoise, TrueGyro
from tests.benchmarks.accuracy.cramer_rao_measured import CALIBRATION, Noise, TrueRun, TrueTags

_STANDS_M: Final = 1e-4  # two pictures between which no wheel turned as far are taken from one pose
_GAP_S: Final = 2.0
_ANY_TURN: Final = 1.0  # rad per root metre and per root radian: a turn by the wheels says nothing


def bound_of(
    world: World,
    seed: int,
    *,
    exact_calibration: bool,
    sigma_focal_length: float = 0.0,
    gyro: GyroNoise | None = None,
    gyro_gaps: FloatArray | None = None,
    wheels_turn: bool = True,
) -> Bound:
    """The bound of the drives that `simulate(world, seed, render=False)` makes of its robots.

    Args:
        world: with its noise and robots; their priors are the unknowns.
        seed: as for `simulate`.
        exact_calibration: nothing of the calibration is unknown.
        sigma_focal_length: prior of the focal length as a share, for each robot; 0: known.
        gyro: that each robot has; None: none has one.
        gyro_gaps: [G] as shares of the drive's duration, when 2 s begin in which it measures nothing.
        wheels_turn: the wheels measure turns as the world's noise has it; else distances alone.
    """
    tags = tags_of(world.tags, true_tag_sizes_m(world, seed, exact_calibration))
    runs = [
        _true_run(prepare(world, robot, tags, Options(seed, exact_calibration)), sigma_focal_length, gyro, gyro_gaps)
        for robot in world.robots
        if robot.camera is not None
    ]
    each = world.noise
    noise = Noise(
        each.sigma_distance_m_per_sqrt_m, each.sigma_lateral_m_per_sqrt_m,
        each.sigma_heading_rad_per_sqrt_m if wheels_turn else _ANY_TURN,
        each.sigma_heading_rad_per_sqrt_rad if wheels_turn else _ANY_TURN,
        each.sigma_corner_px, each.sigma_tilt_rad, each.sigma_height_m,
    )  # fmt: skip
    return cramer_rao(runs, _true_tags(world, tags, exact_calibration), noise)


def _true_run(
    session: Session, sigma_focal_length: float, gyro: GyroNoise | None, gyro_gaps: FloatArray | None
) -> TrueRun:
    eye, drive, stamps_ns = session.eye, session.drive, np.array([each.middle_ns for each in session.pictures()])
    assert eye is not None
    seen = tracks(session.world, session.tags, session.faces, eye, drive, stamps_ns, session.stream("detections"))
    pictures, picture = np.unique(seen.picture, return_inverse=True)
    stamps_ns = stamps_ns[pictures]
    moments_ns = np.union1d(drive.stamps_ns, stamps_ns)
    wheels_m = np.stack([np.interp(moments_ns, drive.stamps_ns, each) for each in (drive.left_m, drive.right_m)], -1)
    poses, T_world_base = _poses(np.searchsorted(moments_ns, stamps_ns), wheels_m), drive.at(moments_ns)
    wheels, robot = session.true.wheels, session.true
    return TrueRun(
        place=T_world_base[:, 0] + 1j * T_world_base[:, 1],
        heading_rad=T_world_base[:, 2],
        rolled_m=np.diff(wheels_m, axis=0),
        pose=poses[0],
        picture_pose=poses[1],
        twist=_twist(session, stamps_ns),
        picture=picture,
        tag=seen.tag,
        row_s=robot.readout_s * (seen.corners_px[..., 1] / (eye.model.height_px - 1) - 0.5),
        camera=eye.model,
        track_m=wheels.track_m,
        mount=np.array(
            [getattr(robot.mount, name) for name in ("x_m", "y_m", "z_m", "roll_rad", "pitch_rad", "yaw_rad")]
        ),
        sigma=np.zeros(len(CALIBRATION))
        if session.options.exact_calibration
        else _priors(session.nominal, sigma_focal_length),
        gyro=None if gyro is None else _true_gyro(gyro, 1e-9 * moments_ns, 1e-9 * drive.stamps_ns[-1], gyro_gaps),
    )


def _true_gyro(noise: GyroNoise, time_s: FloatArray, duration_s: float, gaps: FloatArray | None) -> TrueGyro:
    is_known = np.ones(len(time_s) - 1, dtype=np.bool_)
    for share in [] if gaps is None else gaps:
        begin_s = share * duration_s
        is_known &= (time_s[1:] <= begin_s) | (time_s[:-1] >= begin_s + _GAP_S)
    return TrueGyro(noise, time_s, is_known)


def _poses(at: IntArray, wheels_m: FloatArray) -> tuple[IntArray, IntArray]:
    """The moments whose poses are unknowns: the start, and one for each of the pictures `at` that the robot moved to.

    With them the pose of each picture.
    """
    chosen, pose_of = [0], []
    for moment in at.tolist():
        if np.abs(wheels_m[moment] - wheels_m[chosen[-1]]).max() > _STANDS_M:
            chosen.append(moment)
        pose_of.append(len(chosen) - 1)
    return np.array(chosen), np.array(pose_of, dtype=np.int64)


def _twist(session: Session, stamps_ns: IntArray) -> FloatArray:
    """[F, 2] m/s and rad/s of the arcs that pictures are taken on."""
    drive = session.drive
    after = np.clip(np.searchsorted(drive.stamps_ns, stamps_ns, side="right"), 1, len(drive.stamps_ns) - 1)
    seconds = 1e-9 * (drive.stamps_ns[after] - drive.stamps_ns[after - 1])
    left_m, right_m = (each[after] - each[after - 1] for each in (drive.left_m, drive.right_m))
    return (
        np.stack([0.5 * (left_m + right_m), (right_m - left_m) / session.true.wheels.track_m], axis=-1)
        / seconds[:, None]
    )


def _priors(robot: Robot, sigma_focal_length: float) -> FloatArray:
    wheels, mount = robot.wheels, robot.mount
    return np.array(
        [
            wheels.radius_left_m_sigma / wheels.radius_left_m, wheels.radius_right_m_sigma / wheels.radius_right_m,
            wheels.track_m_sigma / wheels.track_m, mount.x_m_sigma, mount.y_m_sigma, mount.z_m_sigma,
            mount.roll_rad_sigma, mount.pitch_rad_sigma, mount.yaw_rad_sigma, robot.time_offset_s_sigma,
            sigma_focal_length, robot.edge_shift_px_sigma,
        ]
    )  # fmt: skip


def _true_tags(world: World, tags: Tags, exact_calibration: bool) -> TrueTags:
    """A tag belongs to the batch in the first robot.yaml that has it; one in none has a scale of its own."""
    batches: dict[str, int] = {}
    sigmas: list[float] = []
    batch = []
    for family, tag_id in zip(tags.family, tags.tag_id.tolist(), strict=True):
        name, sigma = _batch(world, family, tag_id)
        if name not in batches:
            batches[name] = len(sigmas)
            sigmas.append(0.0 if exact_calibration else sigma)
        batch.append(batches[name])
    return TrueTags(tags.centre_m, tags.rotation, tags.size_m, np.array(batch), np.array(sigmas))


def _batch(world: World, family: str, tag_id: int) -> tuple[str, float]:
    for each in world.robots:
        try:
            size_m, sigma_m, batch = nominal_robot(world, each).tag_size_m(family, tag_id)
        except CalibError:
            continue
        return batch, sigma_m / size_m
    return "", 0.0
