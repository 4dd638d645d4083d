"""Splits the wheel readings of a log into segments of unbroken odometry."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from groundsbot.calib.foundation import FloatArray, plural
from groundsbot.calib.geometry import se2
from groundsbot.calib.robot import Robot
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.measurements.motion_model.motion_model import WheelSegment
from groundsbot.offline.measurements.motion_model.odometry_messages import OdometryMessages
from groundsbot.offline.measurements.motion_model.step_covariance import given_covariances
from groundsbot.offline.measurements.plausibility import check_numbers, check_speed, check_stamps, find_repeated

WheelRow = tuple[int, int, int, int]  # stamp_ns, boot id, ticks of the left and of the right wheel

# Each reset begins another segment, which only tags can join to the others. The number of pairs of segments grows with
# its square, so a limit that grows with the square root of a log's size makes time proportional to size: 25 at 1 MiB,
# which is 90 seconds of driving, and 100 in an hour.
_FREE_RESETS = 10
_RESETS_AT_A_MIB = 15
# Less lateral motion than this in a whole drive is rounding of the poses.
_LATERAL_M = 1e-6


def wheel_segments_of(
    wheels: Sequence[WheelRow], odometry: OdometryMessages, robot: Robot, log: Path, log_bytes: int
) -> tuple[list[WheelSegment], list[str]]:
    """Return the wheel segments of one log, and warnings.

    Args:
        wheels: wheels of `/wheels`, in order.
        odometry: messages of `/odometry`; used where `/wheels` is empty.
        robot: robot with the wheels.
        log: named in errors.
        log_bytes: its size.

    Raises:
        OfflineError: there are no wheel readings, a reading is not plausible, or the controller restarted too often for
            a log of this size.
    """
    if wheels:
        return _encoder_segments(wheels, robot, log, log_bytes)
    if len(odometry):
        return _imported_segment(odometry, robot, log)
    raise OfflineError(
        f"{log}: no wheel readings (/wheels or /odometry has 0 messages), which a map needs; "
        "check the encoder port with `groundsbot-onboard check`"
    )


def _encoder_segments(
    readings: Sequence[WheelRow], robot: Robot, log: Path, log_bytes: int
) -> tuple[list[WheelSegment], list[str]]:
    """Split where the controller was reset, because the motion in between is unknown."""
    table = np.array(readings, dtype=np.int64)
    check_stamps(table[:, 0], f"{log}: /wheels")
    cuts = np.flatnonzero(np.diff(table[:, 1])) + 1
    most = _FREE_RESETS + int(_RESETS_AT_A_MIB * (log_bytes / 2**20) ** 0.5)
    if len(cuts) > most:
        raise OfflineError(
            f"{log}: /wheels: the controller restarted {len(cuts)} times, limit {most} for a log of {log_bytes} bytes; "
            "check its power supply"
        )
    m_per_tick_left, m_per_tick_right = robot.wheels.metres_per_tick
    table[:, 2:] = table[:, robot.wheels.wiring.order(2, 3)]
    sign_left, sign_right = robot.wheels.wiring.signs
    wheel_segments: list[WheelSegment] = []
    warnings: list[str] = []
    for part in np.split(table, cuts):
        keep, repeated = find_repeated(part[:, 0], "wheel reading")
        warnings += repeated
        ordered = part[keep]
        # Converted to floats, because differences of damaged counts could overflow as integers.
        ticks = np.asarray(ordered[:, 2:], dtype=np.float64)
        check_speed(ordered[:, 0], ticks * [m_per_tick_left, m_per_tick_right], f"{log}: /wheels")
        left, right = sign_left * (ordered[:, 2] - ordered[0, 2]), sign_right * (ordered[:, 3] - ordered[0, 3])
        quantum_m = max(m_per_tick_left, m_per_tick_right)
        stamps_ns = ordered[:, 0].copy()  # a view would keep the whole table
        wheel_segments.append(WheelSegment(stamps_ns, left * m_per_tick_left, right * m_per_tick_right, quantum_m))
    warnings += _gap_warnings(wheel_segments)
    if len(wheel_segments) > 1:
        warnings.append(
            f"the wheel controller restarted {plural(len(wheel_segments) - 1, 'time')}; the motion in between is "
            f"unknown, so the run has {len(wheel_segments)} segments that only tags can join"
        )
    return wheel_segments, warnings


def _gap_warnings(wheel_segments: Sequence[WheelSegment]) -> list[str]:
    """Return a warning about gaps between readings while the robot moved."""
    gaps = [(gap, each) for each in wheel_segments for gap in each.gaps_ns]
    if not gaps:
        return []
    gap_ns, segment = max(gaps, key=lambda each: int(each[0][1] - each[0][0]))
    begin_s, longest_s = (gap_ns[0] - segment.stamps_ns[0]) * 1e-9, (gap_ns[1] - gap_ns[0]) * 1e-9
    left_m, right_m = (float(np.diff(each)[0]) for each in segment.at(gap_ns))
    warning = (
        f"wheel readings are missing {plural(len(gaps), 'time')} while the robot drove, at the longest {longest_s:.1f} "
        f"s and {0.5 * (left_m + right_m):.2f} m from {begin_s:.1f} s after the start of its segment; the path in "
        "between is not known and pictures of that time are not used: check port and cable of the wheel controller"
    )
    return [warning]


def _imported_segment(readings: OdometryMessages, robot: Robot, log: Path) -> tuple[list[WheelSegment], list[str]]:
    where = f"{log}: /odometry"
    stamps_ns = readings.stamps_ns
    check_stamps(stamps_ns, where)
    lateral_m = None
    left_m, right_m = readings.wheels_m.T
    check_numbers({"wheels.left_m": left_m, "wheels.right_m": right_m}, where)
    if readings.has_poses:
        poses = readings.poses
        check_numbers(dict(zip(("pose.x_m", "pose.y_m", "pose.theta_rad"), poses.T, strict=True)), where)
        left_m, right_m, lateral_m = wheel_distances(poses, robot.wheels.track_m)
        if np.ptp(lateral_m) < _LATERAL_M:
            lateral_m = None
    keep, warnings = find_repeated(stamps_ns, "odometry reading")
    distances_m = [left_m, right_m] if lateral_m is None else [left_m, right_m, lateral_m]
    check_speed(stamps_ns[keep], np.column_stack(distances_m)[keep], where)
    covariance, n_bad = given_covariances(readings.covariances)
    if n_bad:
        warnings.append(f"{plural(n_bad, 'covariance')} of odometry steps invalid; the noise model is used instead")
    given = covariance[keep] if covariance is not None else None
    lateral = lateral_m[keep] if lateral_m is not None else None
    return [WheelSegment(stamps_ns[keep], left_m[keep], right_m[keep], covariance=given, lateral_m=lateral)], warnings


def wheel_distances(poses: FloatArray, track_m: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return cumulative (left_m, right_m, lateral_m), each (N,), of the twists between odometry poses (N, 3)."""
    twists = se2.log(se2.between(poses[:-1], poses[1:]))
    half_turn_m = 0.5 * track_m * twists[:, 2]
    left_m = np.concatenate([[0.0], np.cumsum(twists[:, 0] - half_turn_m)])
    right_m = np.concatenate([[0.0], np.cumsum(twists[:, 0] + half_turn_m)])
    return left_m, right_m, np.concatenate([[0.0], np.cumsum(twists[:, 1])])
