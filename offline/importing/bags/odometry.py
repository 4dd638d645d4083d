"""Odometry of ROS, or the angles of its wheel joints -> the odometry readings of an imported log."""

from collections.abc import Sequence
from math import pi
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.spatial.transform import Rotation

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.importing.bags.topics import BagOptions
from groundsbot.offline.importing.csv.odometry import MAX_WHEEL_SPEED_M_S
from groundsbot.offline.importing.robot import WheelScale
from groundsbot.offline.measurements import growth, wheel_distances
from groundsbot.onboard.log import PlanarOdometry

# Allowance for bunched stamps, so that they do not look like a jump of the path.
_BUNCHED_STAMPS_M: Final = 0.5
_PLANAR_INDICES: Final = np.ix_([0, 1, 5], [0, 1, 5])  # x, y and yaw of ROS's six


def odometry_readings(
    where: str, stamps_ns: IntArray, messages: Sequence[Any], track_m: float
) -> tuple[list[PlanarOdometry], float, str]:
    """Return readings from nav_msgs/Odometry, the driven distance in metres, and a remark for the user.

    Args:
        where: names bag and topic in errors.
        stamps_ns: (N,) ascending.
        messages: N of them.
        track_m: distance between the wheels, to check their speed.

    Raises:
        OfflineError: a pose is invalid, or a wheel would be impossibly fast.
    """
    poses = np.array([_planar_pose(message.pose.pose) for message in messages])
    wrong = np.flatnonzero(~np.isfinite(poses).all(axis=1))
    if len(wrong):
        raise OfflineError(
            f"{where}: the pose of message {wrong[0] + 1} is invalid (NaN, or a quaternion of length 0); "
            "correct what published it"
        )
    left_m, right_m, lateral_m = wheel_distances(poses, track_m)
    check_wheel_speed(where, stamps_ns, left_m, right_m)
    check_wheel_speed(where, stamps_ns, lateral_m, lateral_m)
    readings = [
        PlanarOdometry(stamp_ns=stamp_ns, pose=PlanarOdometry.PoseInOdom(x_m=x, y_m=y, theta_rad=theta))
        for stamp_ns, (x, y, theta) in zip(stamps_ns.tolist(), poses.tolist(), strict=True)
    ]
    covariances = np.array([np.reshape(message.pose.covariance, (6, 6))[_PLANAR_INDICES] for message in messages])
    steps, outcome = growth(poses, covariances)
    if steps is not None:
        for reading, step in zip(readings, steps, strict=True):
            reading.covariance.extend(step.ravel().tolist())
    said = f"covariances of the odometry {outcome}{'' if steps is not None else '; the noise model is used instead'}"
    return readings, _distance_m(left_m, right_m, lateral_m), said


def joint_readings(
    where: str, stamps_ns: IntArray, messages: Sequence[Any], joints: tuple[str, str], scale: WheelScale
) -> tuple[list[PlanarOdometry], float]:
    """Return readings from the positions of two joints, and the driven distance in metres.

    Args:
        where: names bag and topic in errors.
        stamps_ns: (N,) not descending.
        messages: N of sensor_msgs/JointState that name both joints, one of them, or none.
        joints: joints of the left and the right wheel; positive positions roll forward.
        scale: a tick is here a radian.

    Raises:
        OfflineError: the wheels' radius is unknown, a position is missing or not finite, the joints were not published
            at the same time, or a wheel would be impossibly fast.
    """
    if scale.metres_per_tick_left is None or scale.metres_per_tick_right is None:
        raise OfflineError(f"{where}: the wheels' radius is unknown; give --wheel-radius-m, or --robot")
    stamps_ns, angles = _synchronise(
        where, joints, [_joint_angles(where, stamps_ns, messages, joint) for joint in joints]
    )
    left_m, right_m = (angles - angles[:, :1]) * [[scale.metres_per_tick_left], [scale.metres_per_tick_right]]
    check_wheel_speed(where, stamps_ns, left_m, right_m)
    readings = [
        PlanarOdometry(stamp_ns=stamp_ns, wheels=PlanarOdometry.WheelDistances(left_m=left, right_m=right))
        for stamp_ns, left, right in zip(stamps_ns.tolist(), left_m.tolist(), right_m.tolist(), strict=True)
    ]
    return readings, _distance_m(left_m, right_m)


def _joint_angles(where: str, stamps_ns: IntArray, messages: Sequence[Any], joint: str) -> tuple[IntArray, FloatArray]:
    """Return stamps (K,), ascending, and unwrapped angles (K,) of one joint."""
    named = [
        (stamp, message) for stamp, message in zip(stamps_ns.tolist(), messages, strict=True) if joint in message.name
    ]
    stamps, first = np.unique(np.array([stamp for stamp, _ in named], dtype=np.int64), return_index=True)
    angles = np.array([_position(where, named[i][1], joint) for i in first.tolist()])
    if not np.isfinite(angles).all():
        raise OfflineError(f"{where}: a position of {joint} is not finite; correct what published it")
    return stamps, np.unwrap(angles) if np.ptp(angles) <= 2.0 * pi else angles  # some publish it within one turn


def _synchronise(
    where: str, joints: tuple[str, str], wheels: Sequence[tuple[IntArray, FloatArray]]
) -> tuple[IntArray, FloatArray]:
    """Return the left wheel's stamps (K,), and both angles (2, K) at them; each joint may have messages of its own."""
    (stamps_ns, left), (right_ns, right) = wheels
    inside = (stamps_ns >= right_ns[0]) & (stamps_ns <= right_ns[-1])
    if inside.sum() < 2:
        raise OfflineError(
            f"{where}: {joints[0]} and {joints[1]} were not published at the same time, so they give no path; "
            "name other joints with --left-joint and --right-joint"
        )
    stamps_ns = stamps_ns[inside]
    # Relative to the first stamp, as a float cannot hold nanoseconds since 1970.
    there = np.interp((stamps_ns - right_ns[0]).astype(np.float64), (right_ns - right_ns[0]).astype(np.float64), right)
    return stamps_ns, np.stack([left[inside], there])


def wheel_joints(path: Path, topic: str, messages: Sequence[Any], options: BagOptions) -> tuple[str, str]:
    """Return the joints of the left and of the right wheel: those of the options, else those recognised by their names.

    Raises:
        OfflineError: they cannot be determined.
    """
    names = sorted({name for message in messages for name in message.name})
    if options.left_joint is not None and options.right_joint is not None:
        missing = [each for each in (options.left_joint, options.right_joint) if each not in names]
        if missing:
            raise OfflineError(f"{path}: {topic} has no joint {missing[0]!r}, it has {', '.join(names)}; name another")
        return options.left_joint, options.right_joint
    left, right = ([name for name in names if "wheel" in name.lower() and side in name.lower()] for side in _SIDES)
    if len(left) != 1 or len(right) != 1:
        raise OfflineError(
            f"{path}: {topic}: the wheels' joints cannot be recognised among {', '.join(names) or 'no names'}; "
            "give --left-joint and --right-joint"
        )
    return left[0], right[0]


_SIDES: Final = ("left", "right")


def check_wheel_speed(where: str, stamps_ns: IntArray, left_m: FloatArray, right_m: FloatArray) -> None:
    """Check for steps that are too long for a wheel.

    Raises:
        OfflineError: naming the first.
    """
    steps_m = np.abs(np.diff(np.stack([left_m, right_m]), axis=1)).max(axis=0, initial=0.0)
    seconds = np.diff(stamps_ns) * 1e-9
    wrong = np.flatnonzero(steps_m > MAX_WHEEL_SPEED_M_S * seconds + _BUNCHED_STAMPS_M)
    if len(wrong):
        at = int(wrong[0])
        raise OfflineError(
            f"{where}: a wheel rolls {steps_m[at]:.3g} m in the {seconds[at]:.3g} s before message {at + 2}, faster "
            f"than {MAX_WHEEL_SPEED_M_S:g} m/s; was the odometry reset, or did its clock step? cut the bag there"
        )


def _planar_pose(pose: Any) -> tuple[float, float, float]:  # noqa: ANN401 - made by rosbags
    q = pose.orientation
    quaternion = np.array([q.x, q.y, q.z, q.w])
    if not 0.5 < np.linalg.norm(quaternion) < 2.0:
        return np.nan, np.nan, np.nan
    yaw_rad, _, _ = Rotation.from_quat(quaternion).as_euler("ZYX").tolist()
    return pose.position.x, pose.position.y, yaw_rad


def _position(where: str, message: Any, joint: str) -> float:  # noqa: ANN401 - made by rosbags
    index = list(message.name).index(joint)
    if index >= len(message.position):
        raise OfflineError(
            f"{where}: joint {joint!r} has no position, and speeds alone are not read; publish positions"
        )
    return float(message.position[index])


def _distance_m(left_m: FloatArray, right_m: FloatArray, lateral_m: FloatArray | float = 0.0) -> float:
    forward_m, lateral_m = np.broadcast_arrays(0.5 * (left_m + right_m), lateral_m)
    return float(np.hypot(np.diff(forward_m), np.diff(lateral_m)).sum())
