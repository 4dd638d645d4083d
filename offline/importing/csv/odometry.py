"""The CSV forms of odometry that `import` reads, converted to cumulative wheel distances or poses.

docs/formats.md describes them for users.
"""

from dataclasses import dataclass, field, replace
from itertools import pairwise
from math import dist, hypot, tan
from pathlib import Path
from typing import Final

import numpy as np

from groundsbot.calib.geometry import chain_motions, se2
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.foundation import CsvTable, read_table
from groundsbot.offline.importing.csv.forms import choose_columns, state_stamp_ns
from groundsbot.offline.importing.robot import (
    ENCODER_SCALE_SIGMA,
    NOMINAL_TRACK_M,
    SPEED_SCALE_SIGMA,
    WheelScale,
)
from groundsbot.offline.measurements import wheel_distances

MAX_WHEEL_SPEED_M_S: Final = 20.0  # above it a unit or time is wrong, or a counter was reset
_NS_PER_S: Final = 1_000_000_000
_TICKS: Final = ("left_ticks", "right_ticks")
_WHEEL_SPEEDS: Final = ("left_m_s", "right_m_s")
_FORWARD: Final = ("v_m_s", "omega_rad_s")
_PLANAR: Final = ("vx_m_s", "vy_m_s", "omega_rad_s")
_STEERED: Final = ("v_m_s", "steering_rad")
_POSES: Final = ("x_m", "y_m", "theta_rad")
_ODOMETRY: Final = (_WHEEL_SPEEDS, _TICKS, _FORWARD, _PLANAR, _STEERED, _POSES)
_MAX_STEERING_RAD: Final = 1.4  # beyond it the turn's centre would be within the robot


@dataclass(frozen=True)
class OdometryPath:
    """Cumulative distances of both wheels: the first entry is the run's start, at zero. Or poses, where there are some.

    Attributes:
        needs_track: whether headings depend on the distance between the wheels; the file may contain them itself.
        poses: (x_m, y_m, theta_rad) in a frame of the odometry's own; empty where the path is computed from the wheels.
        scale_sigma: relative sigma of its lengths.
    """

    stamps_ns: list[int]
    left_m: list[float]
    right_m: list[float]
    needs_track: bool = True
    poses: list[tuple[float, float, float]] = field(default_factory=list)
    scale_sigma: float = ENCODER_SCALE_SIGMA

    @property
    def distance_m(self) -> float:
        """Path length of the point midway between the wheels."""
        if self.poses:
            return sum(hypot(b[0] - a[0], b[1] - a[1]) for a, b in pairwise(self.poses))
        middle = [(left + right) / 2 for left, right in zip(self.left_m, self.right_m, strict=True)]
        return sum(abs(after - before) for before, after in pairwise(middle))


def read_odometry(path: Path, scale: WheelScale, wheelbase_m: float | None = None) -> tuple[OdometryPath, str]:
    """Read `odometry.csv`. Return the path, and a description of the file's form.

    A speed is the mean since the row before, so the first row's speed is not used. Turning speeds are converted to
    wheel distances exactly, as a constant speed between two rows gives an arc. A steered robot turns by v tan(steering)
    / wheelbase about its rear axle (Siegwart and Nourbakhsh, "Introduction to Autonomous Mobile Robots", 2011, 3.3).

    Raises:
        OfflineError: a wrong column or value, time not advancing, an unknown scale that the form needs, or options that
            the form does not use.
    """
    table = read_table(path)
    form = choose_columns(table, _ODOMETRY)
    if wheelbase_m is not None and form != _STEERED:
        raise OfflineError(f"{path}: holds no steering_rad, so --wheelbase-m would have no effect; leave it out")
    if len(table) == 0:
        raise OfflineError(f"{path}: has a header but no rows; a run needs wheel readings, export it again")
    stamps = table.stamps_ns(strictly=True)
    if form != _TICKS:
        refuse_tick_options(path, scale.tick_flags)
    if form == _TICKS:
        return _check_wheel_speeds(table, form, _from_ticks(table, stamps, scale)), "cumulative wheel ticks"
    if form == _POSES:
        poses = list(zip(*(table.numbers(column) for column in _POSES), strict=True))
        return _check_wheel_speeds(
            table, form, _from_poses(stamps, poses, scale)
        ), "poses in a frame of the odometry's own"
    mean = "each the mean since the row before"
    if form == _WHEEL_SPEEDS:
        wheels = _from_speeds(stamps, table.numbers("left_m_s"), table.numbers("right_m_s"))
        return _check_wheel_speeds(table, form, wheels), f"wheel speeds, {mean}"
    turning = _turning_speeds(table, form, wheelbase_m)
    if form == _PLANAR:
        path_ = _from_velocities(stamps, table.numbers("vx_m_s"), table.numbers("vy_m_s"), turning, scale)
        said = f"speeds forward, to the left and of turning, {mean}"
    else:
        path_ = _from_speeds(stamps, *_wheel_speeds(table.numbers("v_m_s"), turning, scale))
        said = f"forward and turning speeds, {mean}"
    if form == _STEERED:
        said = f"forward speed and steering angle, {mean}"
    return replace(_check_wheel_speeds(table, form, path_), needs_track=False, scale_sigma=SPEED_SCALE_SIGMA), said


def _turning_speeds(table: CsvTable, form: tuple[str, ...], wheelbase_m: float | None) -> list[float]:
    if form != _STEERED:
        return table.numbers("omega_rad_s")
    if wheelbase_m is None:
        raise OfflineError(
            f"{table.path}: holds steering angles; give --wheelbase-m, from the rear axle to the front one"
        )
    angles = table.numbers("steering_rad")
    for row, angle in enumerate(angles):
        if abs(angle) > _MAX_STEERING_RAD:
            table.fail(row, "steering_rad", f"must be within {_MAX_STEERING_RAD:g} rad; was it in degrees?")
    return [v * tan(angle) / wheelbase_m for v, angle in zip(table.numbers("v_m_s"), angles, strict=True)]


def refuse_tick_options(path: Path, flags: tuple[str, ...]) -> None:
    """Refuse options about ticks where there are none.

    Raises:
        OfflineError: `flags` names some.
    """
    if flags:
        raise OfflineError(f"{path}: holds no ticks, so {' and '.join(flags)} would have no effect; leave it out")


def read_paper_odometry(path: Path, state_rate_hz: float) -> OdometryPath:
    """Read the paper's `odom.csv`: rows `state, v_left, v_right`, m/s; state k ends k steps after the start.

    Raises:
        OfflineError: a wrong value, or a missing state, since states are the only times.
    """
    table = read_table(path, ("state", "v_left_m_s", "v_right_m_s"))
    for row, state in enumerate(table.integers("state", 0)):
        if state != row + 1:
            table.fail(row, "state", f"comes where {row + 1} belongs; states count 1, 2, 3 without a gap")
    stamps = [state_stamp_ns(state, state_rate_hz) for state in range(len(table) + 1)]
    left, right = table.numbers("v_left_m_s"), table.numbers("v_right_m_s")
    return _check_wheel_speeds(table, ("v_left_m_s",), _from_speeds(stamps, [0.0, *left], [0.0, *right]))


def _from_ticks(table: CsvTable, stamps_ns: list[int], scale: WheelScale) -> OdometryPath:
    if scale.metres_per_tick_left is None or scale.metres_per_tick_right is None:
        raise OfflineError(
            f"{table.path}: the length of a tick is unknown; give --wheel-radius-m and --ticks-per-turn, or --robot"
        )
    left, right = scale.wiring.order(table.integers("left_ticks"), table.integers("right_ticks"))
    sign_left, sign_right = scale.wiring.signs
    return OdometryPath(
        stamps_ns,
        [sign_left * (ticks - left[0]) * scale.metres_per_tick_left for ticks in left],
        [sign_right * (ticks - right[0]) * scale.metres_per_tick_right for ticks in right],
    )


def _wheel_speeds(forward: list[float], turning: list[float], scale: WheelScale) -> tuple[list[float], list[float]]:
    half_m = (scale.track_m or NOMINAL_TRACK_M) / 2
    left = [v - omega * half_m for v, omega in zip(forward, turning, strict=True)]
    right = [v + omega * half_m for v, omega in zip(forward, turning, strict=True)]
    return left, right


def _from_speeds(stamps_ns: list[int], left_m_s: list[float], right_m_s: list[float]) -> OdometryPath:
    left, right = [0.0], [0.0]
    for row in range(1, len(stamps_ns)):
        dt_s = (stamps_ns[row] - stamps_ns[row - 1]) / _NS_PER_S
        left.append(left[-1] + left_m_s[row] * dt_s)
        right.append(right[-1] + right_m_s[row] * dt_s)
    return OdometryPath(stamps_ns, left, right)


def _from_velocities(
    stamps_ns: list[int], vx_m_s: list[float], vy_m_s: list[float], omega_rad_s: list[float], scale: WheelScale
) -> OdometryPath:
    """Poses by a constant twist between rows."""
    seconds = np.diff(np.array(stamps_ns, dtype=np.int64)) * 1e-9
    twists = np.column_stack([vx_m_s, vy_m_s, omega_rad_s])[1:] * seconds[:, None]
    poses = chain_motions(se2.exp(twists), np.zeros(3))
    return _from_poses(stamps_ns, [(x, y, theta) for x, y, theta in poses.tolist()], scale)


def _from_poses(stamps_ns: list[int], poses: list[tuple[float, float, float]], scale: WheelScale) -> OdometryPath:
    left_m, right_m, _ = wheel_distances(np.array(poses), scale.track_m or NOMINAL_TRACK_M)
    return OdometryPath(stamps_ns, left_m.tolist(), right_m.tolist(), needs_track=False, poses=poses)


def _check_wheel_speeds(table: CsvTable, form: tuple[str, ...], wheels: OdometryPath) -> OdometryPath:
    """Return the path, none of whose wheels is impossibly fast.

    Raises:
        OfflineError: one is.
    """
    # The paper's path has one entry more than the table, its start; row r then ends at entry r + 1.
    extra = len(wheels.stamps_ns) - len(table)
    column, places = form[0], [pose[:2] for pose in wheels.poses]
    for entry in range(1, len(wheels.stamps_ns)):
        dt_s = (wheels.stamps_ns[entry] - wheels.stamps_ns[entry - 1]) / _NS_PER_S
        moved_m = [abs(side[entry] - side[entry - 1]) for side in (wheels.left_m, wheels.right_m)]
        for each_m in (*moved_m, dist(places[entry - 1], places[entry]) if places else 0.0):
            speed_m_s = each_m / dt_s
            if speed_m_s > MAX_WHEEL_SPEED_M_S:
                table.fail(
                    entry - extra,
                    column,
                    f"means a wheel at {speed_m_s:.3g} m/s, above {MAX_WHEEL_SPEED_M_S:g} m/s; check its unit, "
                    "and whether the counter was reset or the clock stepped",
                )
    return wheels
