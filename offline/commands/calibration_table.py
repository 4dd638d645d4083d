"""Table of the `calibrate` command: each parameter as robot.yaml has it and as found, in mm, degrees and per cent."""

from collections.abc import Mapping, Sequence
from math import degrees
from types import MappingProxyType
from typing import Final

from groundsbot.offline.commands.terminal import table_lines
from groundsbot.offline.maps import CalibrationResult, RobotNumber
from groundsbot.offline.self_calibration import NOT_OBSERVABLE

# For each unit of a value the unit that is shown, the factor to it, and decimals.
_SHOWN: Final[Mapping[str, tuple[str, float, int]]] = MappingProxyType(
    {
        "m": ("mm", 1000.0, 2),
        "rad": ("deg", degrees(1.0), 3),
        "s": ("ms", 1000.0, 2),
        "px": ("px", 1.0, 3),
        "": ("%", 100.0, 3),
    }
)


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
    unit, factor, decimals = _SHOWN[number.unit]
    values = (f"{factor * value:.{decimals}f}" for value in (number.in_file, number.found, number.sigma))
    what = number.what.removesuffix(", relative")
    what = what.removesuffix(f" ({number.unit})").removesuffix(f"_{number.unit}")
    return (number.owner, what, *values, unit, number.verdict.removesuffix(" in these drives"))


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
