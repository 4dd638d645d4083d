"""Odometry of WPILib's structs, or of the number arrays before them -> poses, as an imported log holds them."""

from dataclasses import dataclass
from itertools import pairwise
from math import hypot
from typing import Final

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.calib.geometry import chain_motions, se2
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.importing.csv.odometry import MAX_WHEEL_SPEED_M_S
from groundsbot.offline.importing.robot import ENCODER_SCALE_SIGMA, SPEED_SCALE_SIGMA
from groundsbot.offline.importing.wpilog.held import hold_between
from groundsbot.offline.importing.wpilog.reader import WpiLog, WpiTopic
from groundsbot.offline.importing.wpilog.structs import read_numbers, struct_name
from groundsbot.offline.importing.wpilog.topics import CHASSIS, NUMBERS, POSE, POSITIONS, STATES
from groundsbot.onboard.log import PlanarOdometry

_MAX_TURN_RAD_S: Final = 50.0  # no robot turns faster
_STEERED_RAD: Final = np.pi / 2  # a wheel that turns further between two records was reversed, not steered
_STANDING: Final = 0.01  # m/s and rad/s
# Loops and stamps jitter: a step may be longer than its stamps allow.
_JITTER_M: Final = 0.5
_LEGACY_POSE: Final = 3  # x, y, heading
_NS: Final = 1e-9
_Places = tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class WpiOdometry:
    """Poses in a frame of the odometry's own.

    Attributes:
        stamps_ns: (N,) ascending.
        poses: (N, 3) x_m, y_m, theta_rad.
        scale_sigma: relative sigma of their lengths.
        uses_modules: whether the places of the swerve modules were needed.
        remark: line for the user.
    """

    stamps_ns: IntArray
    poses: FloatArray
    scale_sigma: float
    uses_modules: bool
    remark: str

    @property
    def readings(self) -> list[PlanarOdometry]:
        """Messages of our log."""
        return [
            PlanarOdometry(stamp_ns=stamp_ns, pose=PlanarOdometry.PoseInOdom(x_m=x, y_m=y, theta_rad=theta))
            for stamp_ns, (x, y, theta) in zip(self.stamps_ns.tolist(), self.poses.tolist(), strict=True)
        ]

    @property
    def distance_m(self) -> float:
        """Length of the path."""
        return sum(hypot(b[0] - a[0], b[1] - a[1]) for a, b in pairwise(self.poses.tolist()))


def read_odometry(log: WpiLog, topic: WpiTopic, places: _Places) -> WpiOdometry:
    """Read the odometry of a WPILib log as poses, whether the topic holds speeds, swerve modules or poses.

    Speeds are integrated; displacements of swerve modules become motions of the robot by least squares.

    Args:
        log: the log.
        topic: one of its topics, see `choose_odometry`.
        places: positions (x_m, y_m) of the swerve modules in base, in the order of the topic; empty if unknown.

    Returns:
        The poses in the frame of the odometry.

    Raises:
        OfflineError: a record is damaged, the modules' positions are missing or fewer than the topic has, or a speed
            exceeds what a robot can drive.
    """
    stamps_ns, values = read_numbers(log, topic)
    name, where = struct_name(topic), f"{log.path}: {topic.name}"
    if topic.type == NUMBERS:
        name, values = _legacy_form(log, topic, values)
    stamps_ns, values = hold_between(stamps_ns, values)
    uses_modules = name in (POSITIONS, STATES)
    matrix = _module_matrix(where, places, values.shape[1] // 2) if uses_modules else np.eye(3)
    if name == CHASSIS:
        twists, said = _mean_steps(stamps_ns, values), "speeds of the chassis, straight between records"
    elif name == STATES:
        twists = _mean_steps(stamps_ns, _vectors(values[:, 0::2], values[:, 1::2]) @ matrix.T)
        said = "speeds of the swerve modules, straight between records"
    elif name == POSITIONS:
        twists, said = _module_steps(values) @ matrix.T, "displacements of the swerve modules"
    else:
        twists = se2.log(se2.between(values[:-1], values[1:]))
        said = "poses of the robot's own estimate, which may hold jumps towards a field layout"
    _check_speed(where, stamps_ns, twists)
    poses = values if name == POSE else chain_motions(se2.exp(twists), np.zeros(3))
    stamps_ns, poses = _until_end(log, stamps_ns, poses, twists)
    scale_sigma = SPEED_SCALE_SIGMA if name == CHASSIS else ENCODER_SCALE_SIGMA
    return WpiOdometry(stamps_ns, poses, scale_sigma, uses_modules, f"odometry: {topic.name} ({topic.type}): {said}")


def _legacy_form(log: WpiLog, topic: WpiTopic, values: FloatArray) -> tuple[str, FloatArray]:
    """Return the struct that a number array stands for, and its numbers in that struct's order and units."""
    width = values.shape[1]
    if width == _LEGACY_POSE:
        kind = log.find(f"{topic.parent}/.type", "string")
        is_field = kind is not None and any(bytes(each.payload) == b"Field2d" for each in log.records(kind))
        poses = values.copy()
        if is_field:  # Field2d publishes degrees
            poses[:, 2] = np.radians(poses[:, 2])
        elif np.abs(poses[:, 2]).max() > 4.0 * np.pi:
            raise OfflineError(
                f"{log.path}: {topic.name}: headings reach {np.abs(poses[:, 2]).max():.4g}, and it is no Field2d; "
                "headings of arrays must be radians, choose another topic"
            )
        return POSE, poses
    if width >= 4 and width % 2 == 0:  # angle and speed of each module
        return STATES, values.reshape(len(values), -1, 2)[:, :, ::-1].reshape(len(values), width)
    raise OfflineError(
        f"{log.path}: {topic.name}: has {width} numbers in a record, must be 3 (a pose) or 2 for each swerve module; "
        "choose another with --odometry-topic"
    )


def _module_matrix(where: str, places: _Places, n_modules: int) -> FloatArray:
    """Return (3, 2 M): the chassis' motion of least squares from the motions (x, y) of M modules."""
    if not places:
        raise OfflineError(
            f"{where}: needs the places of its {n_modules} swerve modules; give --swerve-modules-m, or --robot with "
            "swerve_modules_m"
        )
    if len(places) != n_modules:
        raise OfflineError(
            f"{where}: holds {n_modules} swerve modules, {len(places)} places were given; give one for each in "
            "--swerve-modules-m or swerve_modules_m"
        )
    rows = [row for x_m, y_m in places for row in ((1.0, 0.0, -y_m), (0.0, 1.0, x_m))]
    design = np.array(rows)
    if np.linalg.matrix_rank(design, tol=1e-3) < design.shape[1]:
        raise OfflineError(
            f"{where}: all swerve modules have the same position, so turns are not observable; correct "
            "--swerve-modules-m or swerve_modules_m"
        )
    return np.linalg.pinv(design)


def _vectors(lengths: FloatArray, angles_rad: FloatArray) -> FloatArray:
    """Return (N, 2 M): x, y of each module."""
    both = np.stack([lengths * np.cos(angles_rad), lengths * np.sin(angles_rad)], axis=-1)
    return both.reshape(len(lengths), -1)


def _module_steps(values: FloatArray) -> FloatArray:
    """Return (N - 1, 2 M): how each module moved, along the middle of its two angles."""
    rolled_m, angles = np.diff(values[:, 0::2], axis=0), values[:, 1::2]
    steered = (np.diff(angles, axis=0) + np.pi) % (2.0 * np.pi) - np.pi
    middle = angles[1:] - np.where(np.abs(steered) < _STEERED_RAD, 0.5 * steered, 0.0)
    return _vectors(rolled_m, middle)


def _mean_steps(stamps_ns: IntArray, speeds: FloatArray) -> FloatArray:
    return 0.5 * (speeds[:-1] + speeds[1:]) * (np.diff(stamps_ns) * _NS)[:, None]


def _check_speed(where: str, stamps_ns: IntArray, twists: FloatArray) -> None:
    seconds = np.diff(stamps_ns) * _NS
    steps_m, turns_rad = np.hypot(twists[:, 0], twists[:, 1]), np.abs(twists[:, 2])
    too_far = ~(steps_m <= MAX_WHEEL_SPEED_M_S * seconds + _JITTER_M)
    wrong = np.flatnonzero(too_far | ~(turns_rad <= _MAX_TURN_RAD_S * seconds + _JITTER_M))
    if len(wrong):
        at = int(wrong[0])
        raise OfflineError(
            f"{where}: the robot moves {steps_m[at]:.3g} m and turns {turns_rad[at]:.3g} rad in {seconds[at]:.3g} s, "
            f"until {stamps_ns[at + 1] * _NS:.3f} s; limits {MAX_WHEEL_SPEED_M_S:g} m/s, {_MAX_TURN_RAD_S:g} rad/s; "
            "was the odometry reset? choose another topic with --odometry-topic"
        )


def _until_end(log: WpiLog, stamps_ns: IntArray, poses: FloatArray, twists: FloatArray) -> tuple[IntArray, FloatArray]:
    """Return stamps and poses with the last pose at the log's end too, where the robot stood when records ended."""
    end_ns = log.last_stamp_us * 1000
    if len(twists) and end_ns > stamps_ns[-1]:
        seconds = (stamps_ns[-1] - stamps_ns[-2]) * _NS
        if np.abs(twists[-1]).max() <= _STANDING * seconds:
            return np.append(stamps_ns, end_ns), np.concatenate([poses, poses[-1:]])
    return stamps_ns, poses
