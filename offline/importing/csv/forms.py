"""The CSV forms that `import` reads, converted to wheel distances and tag positions.

Every form is converted to cumulative distances of both wheels, and to observations of tags with y to the LEFT.
docs/formats.md describes the forms for users.
"""

from dataclasses import dataclass, replace
from itertools import pairwise
from math import hypot, pi
from pathlib import Path
from typing import Final, Literal

from groundsbot.offline.errors import OfflineError
from groundsbot.offline.foundation import CsvTable, read_table
from groundsbot.offline.importing.robot import NOMINAL_TRACK_M, WheelScale
from groundsbot.offline.measurements import MAX_RANGE_M

MAX_WHEEL_SPEED_M_S: Final = 20.0  # above it a unit or time is wrong, or a counter was reset
MAX_YAW_RATE_RAD_S: Final = 50.0  # no robot turns faster; degrees taken for radians would
_NS_PER_S: Final = 1_000_000_000
_TIMES: Final = ("t_s", "t_ns")
_ODOMETRY: Final = (("left_m_s", "right_m_s"), ("left_ticks", "right_ticks"), ("v_m_s", "omega_rad_s"))
_POSITIONS: Final = (("x_m", "y_m"), ("range_m", "bearing_rad"))
_SIGMAS: Final = (("sigma_x_m", "sigma_y_m"), ("sigma_range_m", "sigma_bearing_rad"))
_MAX_SIGMA: Final = MAX_RANGE_M  # a map ignores a position that is less certain than the range itself


@dataclass(frozen=True)
class WheelPath:
    """Cumulative distances of both wheels: the first entry is the run's start, at zero.

    Attributes:
        needs_track: whether headings depend on the distance between the wheels; the file may contain them itself.
    """

    stamps_ns: list[int]
    left_m: list[float]
    right_m: list[float]
    needs_track: bool = True

    @property
    def distance_m(self) -> float:
        """Path length of the point midway between the wheels."""
        middle = [(left + right) / 2 for left, right in zip(self.left_m, self.right_m, strict=True)]
        return sum(abs(after - before) for before, after in pairwise(middle))


@dataclass(frozen=True)
class CsvObservation:
    """One tag: `first`, `second` are (x_m, y_m), y to the left, or (range_m, bearing_rad), positive to the left."""

    stamp_ns: int
    tag_id: int
    kind: Literal["cartesian", "polar"]
    first: float
    second: float
    sigmas: tuple[float, float] | None = None


def read_odometry(path: Path, scale: WheelScale) -> tuple[WheelPath, str]:
    """Read `odometry.csv`. Return the wheels' path, and a description of the file's form.

    A speed is the mean since the row before, so the first row's speed is not used. Turning speeds are converted to
    wheel distances exactly, as a constant speed between two rows gives an arc.

    Raises:
        OfflineError: a wrong column or value, time not advancing, an unknown scale that the form needs, or options that
            the form does not use.
    """
    table = read_table(path)
    form = _choose_columns(table, _ODOMETRY)
    if len(table) == 0:
        raise OfflineError(f"{path}: has a header but no rows; a run needs wheel readings, export it again")
    stamps = table.stamps_ns(strictly=True)
    if form != ("left_ticks", "right_ticks"):
        refuse_tick_options(path, scale.tick_flags)
    if form == ("left_ticks", "right_ticks"):
        wheels = _from_ticks(table, stamps, scale)
        said = "cumulative wheel ticks"
    elif form == ("left_m_s", "right_m_s"):
        wheels = _from_speeds(stamps, table.numbers("left_m_s"), table.numbers("right_m_s"))
        said = "wheel speeds, each the mean since the row before"
    else:
        left, right = _wheel_speeds(table, scale)
        wheels = replace(_from_speeds(stamps, left, right), needs_track=False)
        said = "forward and turning speeds, each the mean since the row before"
    _check_speeds(table, form[0], wheels)
    return wheels, said


def read_gyro(path: Path) -> list[tuple[int, float]]:
    """Read `gyro.csv`: columns t_s (or t_ns) and omega_rad_s, the yaw rate to the left; (stamp in ns, rad/s) by row.

    Raises:
        OfflineError: a wrong column or value, or time not advancing.
    """
    table = read_table(path)
    unknown = [name for name in table.columns if name not in (*_TIMES, "omega_rad_s")]
    if unknown or "omega_rad_s" not in table or sum(name in table for name in _TIMES) != 1:
        raise OfflineError(f"{path} line 1: has the columns {','.join(table.columns)}; use t_s,omega_rad_s (or t_ns)")
    rates = table.numbers("omega_rad_s")
    for row, rate in enumerate(rates):
        if abs(rate) >= MAX_YAW_RATE_RAD_S:
            table.fail(row, "omega_rad_s", f"must be below {MAX_YAW_RATE_RAD_S:g} rad/s; was it in degrees?")
    return list(zip(table.stamps_ns(strictly=True), rates, strict=True))


def refuse_tick_options(path: Path, flags: tuple[str, ...]) -> None:
    """Refuse options about ticks where there are none.

    Raises:
        OfflineError: `flags` names some.
    """
    if flags:
        raise OfflineError(f"{path}: holds no ticks, so {' and '.join(flags)} would not be used; leave that out")


def read_observations(path: Path, max_tag_id: int) -> list[CsvObservation]:
    """Read `observations.csv`; an empty list if it has a header only.

    Raises:
        OfflineError: a wrong column or value, or time running backwards.
    """
    table = read_table(path)
    form = _choose_columns(table, _POSITIONS, required=("tag_id",), optional=_SIGMAS)
    polar = form == ("range_m", "bearing_rad")
    stamps = table.stamps_ns(strictly=False)
    tag_ids = table.integers("tag_id", 0, max_tag_id)
    first = table.positive_numbers("range_m") if polar else table.numbers("x_m")
    second = table.numbers(form[1])
    _check_positions(table, polar, first, second)
    sigma_columns = _SIGMAS[1] if polar else _SIGMAS[0]
    if sigma_columns[0] in table:
        sigmas: list[tuple[float, float] | None] = list(
            zip(*(table.positive_numbers(column, _MAX_SIGMA) for column in sigma_columns), strict=True)
        )
    else:
        sigmas = [None] * len(table)
    kind: Literal["cartesian", "polar"] = "polar" if polar else "cartesian"
    return [
        CsvObservation(t, tag, kind, a, b, s)
        for t, tag, a, b, s in zip(stamps, tag_ids, first, second, sigmas, strict=True)
    ]


def read_paper_odometry(path: Path, state_rate_hz: float) -> WheelPath:
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
    wheels = _from_speeds(stamps, [0.0, *left], [0.0, *right])
    _check_speeds(table, "v_left_m_s", wheels)
    return wheels


def read_paper_landmarks(path: Path, n_states: int, state_rate_hz: float, max_tag_id: int) -> list[CsvObservation]:
    """Read the paper's `landmarks.csv`: rows `state, tag_id, forward_m, RIGHT_m, 0`, converted to y LEFT.

    The state is the number of odometry readings before the observation.

    Raises:
        OfflineError: a wrong value, a state that `odom.csv` does not have, or states running backwards.
    """
    table = read_table(path, ("state", "tag_id", "forward_m", "right_m", "zero"))
    states = table.integers("state", 0)
    for row, state in enumerate(states):
        if state > n_states:
            table.fail(
                row, "state", f"is beyond the last state in odom.csv, {n_states}; do the two files belong together?"
            )
        if row and state < states[row - 1]:
            table.fail(row, "state", f"runs backwards after {states[row - 1]}; sort the rows by state")
    table.numbers("zero")
    tag_ids = table.integers("tag_id", 0, max_tag_id)
    forward, right = table.numbers("forward_m"), table.numbers("right_m")
    _check_positions(table, False, forward, right)
    return [
        CsvObservation(state_stamp_ns(state, state_rate_hz), tag, "cartesian", x, -y)
        for state, tag, x, y in zip(states, tag_ids, forward, right, strict=True)
    ]


def state_stamp_ns(state: int, state_rate_hz: float) -> int:
    """Return the time at which a state ends, from the start of the run."""
    return round(state * _NS_PER_S / state_rate_hz)


def _choose_columns(
    table: CsvTable,
    alternatives: tuple[tuple[str, str], ...],
    required: tuple[str, ...] = (),
    optional: tuple[tuple[str, str], ...] = (),
) -> tuple[str, str]:
    """Return the alternative that the header names; refuse missing, duplicate or unknown columns."""
    choice = " or ".join(",".join(pair) for pair in alternatives)
    wanted = ",".join(("t_s", *required))
    known = {*_TIMES, *required, *(name for pair in (*alternatives, *optional) for name in pair)}
    for name in table.columns:
        if name not in known:
            raise OfflineError(f"{table.path} line 1: column {name!r} is unknown; use {wanted} (or t_ns) and {choice}")
    for name in required:
        if name not in table:
            raise OfflineError(f"{table.path} line 1: column {name!r} is missing; use {wanted} (or t_ns) and {choice}")
    if sum(name in table for name in _TIMES) != 1:
        raise OfflineError(
            f"{table.path} line 1: needs exactly one of the columns t_s and t_ns; add it, or leave one out"
        )
    named = [pair for pair in alternatives if any(name in table for name in pair)]
    if len(named) != 1:
        raise OfflineError(f"{table.path} line 1: needs exactly one of these pairs of columns: {choice}")
    form = named[0]
    allowed = (form, *(pair for pair, of in zip(optional, alternatives, strict=False) if of == form))
    for pair in (*allowed, *optional):
        present = [name for name in pair if name in table]
        if present and pair not in allowed:
            raise OfflineError(
                f"{table.path} line 1: column {present[0]!r} does not go with {','.join(form)}; leave it out"
            )
        if len(present) == 1:
            missing = pair[1] if present[0] == pair[0] else pair[0]
            raise OfflineError(f"{table.path} line 1: column {missing!r} is missing beside {present[0]!r}; add it")
    return form


def _from_ticks(table: CsvTable, stamps_ns: list[int], scale: WheelScale) -> WheelPath:
    if scale.metres_per_tick_left is None or scale.metres_per_tick_right is None:
        raise OfflineError(
            f"{table.path}: the length of a tick is unknown; give --wheel-radius-m and --ticks-per-turn, or --robot"
        )
    left, right = table.integers("left_ticks"), table.integers("right_ticks")
    return WheelPath(
        stamps_ns,
        [(ticks - left[0]) * scale.metres_per_tick_left for ticks in left],
        [(ticks - right[0]) * scale.metres_per_tick_right for ticks in right],
    )


def _wheel_speeds(table: CsvTable, scale: WheelScale) -> tuple[list[float], list[float]]:
    forward, turning = table.numbers("v_m_s"), table.numbers("omega_rad_s")
    half_m = (scale.track_m or NOMINAL_TRACK_M) / 2
    left = [v - omega * half_m for v, omega in zip(forward, turning, strict=True)]
    right = [v + omega * half_m for v, omega in zip(forward, turning, strict=True)]
    return left, right


def _from_speeds(stamps_ns: list[int], left_m_s: list[float], right_m_s: list[float]) -> WheelPath:
    left, right = [0.0], [0.0]
    for row in range(1, len(stamps_ns)):
        dt_s = (stamps_ns[row] - stamps_ns[row - 1]) / _NS_PER_S
        left.append(left[-1] + left_m_s[row] * dt_s)
        right.append(right[-1] + right_m_s[row] * dt_s)
    return WheelPath(stamps_ns, left, right)


def _check_speeds(table: CsvTable, column: str, wheels: WheelPath) -> None:
    # The paper's path has one entry more than the table, its start; row r then ends at entry r + 1.
    extra = len(wheels.stamps_ns) - len(table)
    for entry in range(1, len(wheels.stamps_ns)):
        dt_s = (wheels.stamps_ns[entry] - wheels.stamps_ns[entry - 1]) / _NS_PER_S
        for side in (wheels.left_m, wheels.right_m):
            speed_m_s = abs(side[entry] - side[entry - 1]) / dt_s
            if speed_m_s > MAX_WHEEL_SPEED_M_S:
                table.fail(
                    entry - extra,
                    column,
                    f"means a wheel at {speed_m_s:.3g} m/s, above {MAX_WHEEL_SPEED_M_S:g} m/s; check its unit, "
                    "and whether the counter was reset or the clock stepped",
                )


def _check_positions(table: CsvTable, polar: bool, first: list[float], second: list[float]) -> None:
    columns = table.columns
    for row, (a, b) in enumerate(zip(first, second, strict=True)):
        if polar and abs(b) > 2 * pi:
            table.fail(row, "bearing_rad", "is more than a whole turn in radians; are these degrees?")
        if not polar and hypot(a, b) == 0.0:
            column = "x_m" if "x_m" in columns else "forward_m"
            table.fail(row, column, "puts the tag at the robot's origin; leave the row out")
