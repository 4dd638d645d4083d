"""The CSV forms of observations and yaw rates that `import` reads, and the choice of a form by its columns.

Observations of tags are converted to y to the LEFT. docs/formats.md describes the forms for users.
"""

from dataclasses import dataclass
from math import hypot, pi
from pathlib import Path
from typing import Final, Literal

from groundsbot.offline.errors import OfflineError
from groundsbot.offline.foundation import CsvTable, read_table
from groundsbot.offline.measurements import MAX_RANGE_M

MAX_YAW_RATE_RAD_S: Final = 50.0  # no robot turns faster; degrees taken for radians would
_NS_PER_S: Final = 1_000_000_000
_TIMES: Final = ("t_s", "t_ns")
_POSITIONS: Final = (("x_m", "y_m"), ("range_m", "bearing_rad"))
_SIGMAS: Final = (("sigma_x_m", "sigma_y_m"), ("sigma_range_m", "sigma_bearing_rad"))
_MAX_SIGMA: Final = MAX_RANGE_M  # a map ignores a position that is less certain than the range itself


@dataclass(frozen=True)
class CsvObservation:
    """One tag: `first`, `second` are (x_m, y_m), y to the left, or (range_m, bearing_rad), positive to the left."""

    stamp_ns: int
    tag_id: int
    kind: Literal["cartesian", "polar"]
    first: float
    second: float
    sigmas: tuple[float, float] | None = None


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


def read_observations(path: Path, max_tag_id: int) -> list[CsvObservation]:
    """Read `observations.csv`; an empty list if it has a header only.

    Raises:
        OfflineError: a wrong column or value, or time running backwards.
    """
    table = read_table(path)
    form = choose_columns(table, _POSITIONS, required=("tag_id",), optional=_SIGMAS)
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


def choose_columns(
    table: CsvTable,
    alternatives: tuple[tuple[str, ...], ...],
    required: tuple[str, ...] = (),
    optional: tuple[tuple[str, str], ...] = (),
) -> tuple[str, ...]:
    """Return the alternative that the header names; refuse missing, duplicate or unknown columns.

    Args:
        table: the file.
        alternatives: of which exactly one must be there.
        required: needed with each of them.
        optional: pairs that may be there in addition, each with the alternative at its index.
    """
    choice = " or ".join(",".join(names) for names in alternatives)
    wanted = ",".join(("t_s", *required))
    known = {*_TIMES, *required, *(name for names in (*alternatives, *optional) for name in names)}
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
    present = {name for names in alternatives for name in names if name in table}
    complete = [names for names in alternatives if set(names) == present]
    if not complete:
        raise _no_form(table, alternatives, present, choice)
    (form,) = complete
    for pair, of in zip(optional, alternatives, strict=False):
        named = [name for name in pair if name in table]
        if named and of != form:
            raise OfflineError(
                f"{table.path} line 1: column {named[0]!r} does not go with {','.join(form)}; leave it out"
            )
        if len(named) == 1:
            missing = pair[1] if named[0] == pair[0] else pair[0]
            raise OfflineError(f"{table.path} line 1: column {missing!r} is missing beside {named[0]!r}; add it")
    return form


def _no_form(
    table: CsvTable, alternatives: tuple[tuple[str, ...], ...], present: set[str], choice: str
) -> OfflineError:
    """The error of a header whose columns are none of the alternatives."""
    larger = [names for names in alternatives if present and present < set(names)]
    if len(larger) == 1:
        missing = next(name for name in larger[0] if name not in present)
        beside = next(name for name in larger[0] if name in present)
        return OfflineError(f"{table.path} line 1: column {missing!r} is missing beside {beside!r}; add it")
    return OfflineError(f"{table.path} line 1: needs exactly one of these sets of columns: {choice}")


def _check_positions(table: CsvTable, polar: bool, first: list[float], second: list[float]) -> None:
    columns = table.columns
    for row, (a, b) in enumerate(zip(first, second, strict=True)):
        if polar and abs(b) > 2 * pi:
            table.fail(row, "bearing_rad", "is more than a whole turn in radians; are these degrees?")
        if not polar and hypot(a, b) == 0.0:
            column = "x_m" if "x_m" in columns else "forward_m"
            table.fail(row, column, "puts the tag at the robot's origin; leave the row out")
