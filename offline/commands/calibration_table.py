"""Table of the `calibrate` command: each parameter as robot.yaml has it and as found, in mm, degrees and per cent."""

from collections.abc import Mapping, Sequence
from math import degrees
from types import MappingProxyType
from typing import Final

from groundsbot.calib.robot import FOCAL_SCALE, TAG_SCALE, WHEEL_PARAMETERS, without_camera
from groundsbot.offline.commands.terminal import table_lines
from groundsbot.offline.maps import CalibrationResult, RobotNumber
from groundsbot.offline.self_calibration import NOT_OBSERVABLE

# Unit of each kind of number, with its size and decimals.
_UNITS: Final[Mapping[str, tuple[float, int]]] = MappingProxyType(
    {"mm": (1000.0, 2), "deg": (degrees(1.0), 3), "%": (100.0, 3), "ms": (1000.0, 2), "px": (1.0, 3)}
)
_UNIT_OF_SUFFIX: Final = {"_m": "mm", "_rad": "deg", "_s": "ms", "_px": "px"}


def calibration_lines(estimates: Sequence[CalibrationResult], numbers: Sequence[RobotNumber]) -> list[str]:
    """Return a row for each estimate, and below them which drives would determine the others.

    Args:
        estimates: one of each parameter.
        numbers: comparisons of the map's estimates with the robots' files.
    """
    chosen = {(each.owner, each.name, each.component) for each in estimates}
    shown = [each for each in numbers if (each.owner, each.name, each.component) in chosen]
    head = ("of", "parameter", "robot.yaml", "found", "sigma", "unit", "")
    rows = [_row(each) for each in shown]
    return [*(table_lines(head, rows, n_text=2) if rows else []), *_drive_lines(shown)]


def _row(number: RobotNumber) -> tuple[str, ...]:
    unit = _unit(number)
    factor, decimals = _UNITS[unit]
    values = (f"{factor * value:.{decimals}f}" for value in (number.in_file, number.found, number.sigma))
    what = number.what.removesuffix(" (m)").removesuffix(", relative")
    for suffix in _UNIT_OF_SUFFIX:
        what = what.removesuffix(suffix)
    return (number.owner, what, *values, unit, number.verdict.removesuffix(" in these drives"))


def _unit(number: RobotNumber) -> str:
    name = without_camera(number.name)
    if name in (*WHEEL_PARAMETERS, TAG_SCALE, FOCAL_SCALE):
        return "mm" if number.what.endswith(("(m)", "_m")) else "%"
    return next(unit for suffix, unit in _UNIT_OF_SUFFIX.items() if name.endswith(suffix))


def _drive_lines(numbers: Sequence[RobotNumber]) -> list[str]:
    """Return each drive that would determine parameters, once, with these parameters."""
    of_drive: dict[str, dict[str, list[str]]] = {}
    for each in numbers:
        if each.verdict == NOT_OBSERVABLE and each.to_do:
            of_drive.setdefault(each.to_do, {}).setdefault(_row(each)[1], []).append(each.owner)
    lines = []
    for drive, owners_of in of_drive.items():
        names = [f"{what} ({', '.join(owners)})" for what, owners in owners_of.items()]
        lines.append(f"to determine {', '.join(names)}: {drive}")
    return lines
