"""Table of calibration parameters: robot file, estimate of the map, and a verdict on the difference."""

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Final

import numpy as np

from groundsbot.calib.robot import (
    EDGE_SHIFT,
    FOCAL_SCALE,
    IMPORTED_BATCH,
    RANGE_OFFSET,
    TAG_SCALE,
    TIME_OFFSET,
    WHEEL_PARAMETERS,
    Robot,
    split_camera_parameter,
    without_camera,
)
from groundsbot.offline.importing import placeholder_parameters
from groundsbot.offline.maps import CalibrationChoice, CalibrationResult, RobotNumber
from groundsbot.offline.measurements import Run
from groundsbot.offline.self_calibration.robot import OwnedParameter
from groundsbot.offline.self_calibration.selection import GROSS_ERROR_ELSEWHERE, LESS_CERTAIN
from groundsbot.offline.self_calibration.words import CALIBRATION_DRIVES, is_observed

ESTIMATED: Final = "found from the drives"
WRONG: Final = "robot.yaml is wrong"
REQUESTED: Final = "estimated as requested"
AGREES: Final = "agrees"
NOT_OBSERVABLE: Final = "not observable in these drives"
DISTRUSTED: Final = "estimated, since another number is grossly wrong"
CONTRADICTED: Final = "contradicts robot.yaml, which was kept as prior"

_WRITE: Final = "write the estimate into robot.yaml, as groundsbot-offline calibrate does"
_FORM: Final = "-> estimate, sigma; the report lists all):"
_MOST_SIGMAS: Final = 3.0
_SCALES: Final = frozenset({*WHEEL_PARAMETERS, TAG_SCALE, FOCAL_SCALE})
# Value of each parameter in a robot's file.
_OF_ROBOT: Final[Mapping[str, Callable[[Robot], float]]] = MappingProxyType(
    {
        WHEEL_PARAMETERS[0]: lambda r: 0.5 * (r.wheels.radius_left_m + r.wheels.radius_right_m),
        WHEEL_PARAMETERS[1]: lambda r: r.wheels.radius_right_m / r.wheels.radius_left_m,
        WHEEL_PARAMETERS[2]: lambda r: r.wheels.track_m,
        TIME_OFFSET: lambda r: r.time_offset_s,
        EDGE_SHIFT: lambda r: r.edge_shift_px,
        RANGE_OFFSET: lambda r: r.range_offset_m,
        FOCAL_SCALE: lambda _: 1.0,
        **{
            f"mount_{name}": lambda r, name=name: float(getattr(r.mount, name))  # type: ignore[misc]
            for name in ("x_m", "y_m", "z_m", "roll_rad", "pitch_rad", "yaw_rad")
        },
    }
)
# Description of each parameter, and the unit of its value.
_LABELS: Final[Mapping[str, tuple[str, str]]] = MappingProxyType(
    {
        WHEEL_PARAMETERS[0]: ("mean wheel radius (m)", "m"),
        WHEEL_PARAMETERS[1]: ("wheel radius, right / left", ""),
        WHEEL_PARAMETERS[2]: ("track_m", "m"),
        TAG_SCALE: ("tag size (m)", "m"),
        TIME_OFFSET: ("time_offset_s", "s"),
        EDGE_SHIFT: ("edge_shift_px", "px"),
        RANGE_OFFSET: ("range_offset_m", "m"),
        FOCAL_SCALE: ("focal length, relative", ""),
        **{f"mount_{name}_m": (f"mount.{name}_m", "m") for name in ("x", "y", "z")},
        **{f"mount_{name}_rad": (f"mount.{name}_rad", "rad") for name in ("roll", "pitch", "yaw")},
    }
)
_PLACEHOLDER_LABELS: Final[Mapping[str, tuple[str, str]]] = MappingProxyType(
    {
        WHEEL_PARAMETERS[0]: ("wheel radius (multiplies distances), relative", ""),
        WHEEL_PARAMETERS[2]: ("track (divides turns), relative", ""),
    }
)


def compare_with_files(
    runs: Sequence[Run], calibration: Sequence[CalibrationResult], choices: Sequence[CalibrationChoice]
) -> tuple[RobotNumber, ...]:
    """Return a row for each parameter that the map estimated, owner by owner, time offsets first.

    Args:
        runs: runs with the robots' files as they were given.
        calibration: corrections to these files.
        choices: choices of self-calibration, and start values of parameters that files leave open.
    """
    robots = {run.robot_id: run.robot for run in runs}
    chosen = {OwnedParameter(each.owner, each.name): each for each in choices}
    rows = []
    for each in calibration:
        in_file = _in_file(robots, each)
        if in_file is None:
            continue
        robot = robots.get(each.owner)
        is_open = each.owner.startswith(IMPORTED_BATCH) or (robot is not None and robot.is_left_open)
        is_placeholder = robot is not None and is_open and each.name in placeholder_parameters(robot)
        if is_placeholder:
            in_file = 1.0
        scale = in_file if without_camera(each.name) in _SCALES else 1.0
        what, unit = _PLACEHOLDER_LABELS[each.name] if is_placeholder else _label(each, in_file)
        verdict = _verdict(each, chosen.get(OwnedParameter(each.owner, each.name)), is_open=is_open)
        rows.append(
            RobotNumber(
                owner=each.owner,
                name=each.name,
                component=each.component,
                what=what,
                in_file=in_file,
                found=in_file + scale * each.value,
                sigma=abs(scale) * each.sigma,
                verdict=verdict,
                to_do=_to_do(each, verdict),
                unit=unit,
            )
        )
    owners = [row.owner for row in rows]
    return tuple(sorted(rows, key=lambda row: (owners.index(row.owner), without_camera(row.name) != TIME_OFFSET)))


def is_different(number: RobotNumber) -> bool:
    """Return whether the estimate differs from the file."""
    return number.verdict in (ESTIMATED, WRONG, REQUESTED, DISTRUSTED, CONTRADICTED)


def verdict_lines(numbers: Sequence[RobotNumber], most: int = 12) -> list[str]:
    """Return terminal tables of parameters found where no value was given, and of those that differ from robot.yaml.

    Args:
        numbers: rows of all parameters.
        most: rows of each table.
    """
    if not any(is_different(each) for each in numbers):
        return ["robot parameters: these drives agree with robot.yaml in all of them"] if numbers else []
    found = [each for each in numbers if each.verdict == ESTIMATED]
    others = [each for each in numbers if is_different(each) and each.verdict != ESTIMATED]
    return [
        *_rows(f"robot parameters found from the drives (assumed {_FORM}", found, most),
        *_rows(f"robot parameters that differ (robot.yaml {_FORM}", others, most, with_verdict=True),
    ]


def _rows(head: str, numbers: Sequence[RobotNumber], most: int, *, with_verdict: bool = False) -> list[str]:
    """Return the first numbers below a head; nothing without numbers."""
    if not numbers:
        return []
    shown = numbers[:most]
    owner, what = (max(len(getattr(each, name)) for each in shown) for name in ("owner", "what"))
    rows = [
        f"  {each.owner:<{owner}}  {each.what:<{what}}  {each.in_file:8.4f} -> {each.found:8.4f}  {each.sigma:.4f}"
        f"{f'  {each.verdict}' if with_verdict else ''}"
        for each in shown
    ]
    return [head, *rows, *([f"  and {len(numbers) - most} more"] if len(numbers) > most else [])]


def _in_file(robots: Mapping[str, Robot], entry: CalibrationResult) -> float | None:
    """Return the value in the file; 1 for scales of tags of several sizes, None if no file has the parameter."""
    if entry.name != TAG_SCALE:
        name, camera = split_camera_parameter(entry.name)
        value, robot = _OF_ROBOT.get(name), robots.get(entry.owner)
        if value is None or robot is None:
            return None
        return float(value(robot.with_camera(camera) if camera else robot))
    for robot in robots.values():
        for batch in robot.tags:
            if f"{batch.batch} {batch.family}" == entry.owner:
                sizes = {*batch.sizes_m.values(), *([batch.default_size_m] if batch.default_size_m else [])}
                return sizes.pop() if len(sizes) == 1 else 1.0
    return 1.0


def _label(entry: CalibrationResult, in_file: float) -> tuple[str, str]:
    """Return the description of a parameter and the unit of its value."""
    if entry.owner.startswith(IMPORTED_BATCH):
        return "ranges, relative", ""
    if entry.name == TAG_SCALE and in_file == 1.0:
        return "tag size, relative", ""
    name, camera = split_camera_parameter(entry.name)
    label, unit = _LABELS[name]
    return (f"{camera}: {label}" if camera else label), unit


def _verdict(entry: CalibrationResult, choice: CalibrationChoice | None, *, is_open: bool) -> str:
    if is_open:
        return ESTIMATED if is_observed(entry) else NOT_OBSERVABLE
    if choice is not None and choice.is_freed:
        is_off = abs(entry.value) > _MOST_SIGMAS * float(np.hypot(entry.sigma, choice.prior_sigma))
        if choice.is_asked:
            return REQUESTED
        return DISTRUSTED if choice.reason == GROSS_ERROR_ELSEWHERE and not is_off else WRONG
    if abs(entry.value) > _MOST_SIGMAS * entry.prior_sigma:
        return CONTRADICTED
    return NOT_OBSERVABLE if choice is not None and choice.reason == LESS_CERTAIN else AGREES


def _to_do(entry: CalibrationResult, verdict: str) -> str:
    if verdict == NOT_OBSERVABLE and entry.owner.startswith(IMPORTED_BATCH):
        return "give a measured --distance: odometry and ranges can be scaled together"
    if verdict == NOT_OBSERVABLE:
        return CALIBRATION_DRIVES.get(without_camera(entry.name), "")
    return "" if verdict in (AGREES, ESTIMATED) else _WRITE
