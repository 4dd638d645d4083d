"""Robot of an imported run: from the command line, from a robot.yaml, or with unknown parameters left open."""

import dataclasses
import re
from collections.abc import Mapping
from dataclasses import dataclass
from math import degrees, isfinite, pi, radians
from pathlib import Path
from typing import Any, Final

import yaml

from groundsbot.calib.foundation import StrPath
from groundsbot.calib.robot import WHEEL_PARAMETERS, Mount, Robot, Wiring, parse_robot_yaml, read_robot_yaml
from groundsbot.offline.errors import OfflineError


@dataclass(frozen=True)
class WheelScale:
    """Scale from ticks or speeds to wheel distances; None if the command line does not give it."""

    track_m: float | None
    metres_per_tick_left: float | None
    metres_per_tick_right: float | None
    tick_flags: tuple[str, ...] = ()  # options of the command line about ticks
    wiring: Wiring = dataclasses.field(default_factory=Wiring)


# Prior sigmas of unmeasured parameters of a robot without robot.yaml: wide enough for what foreign recordings show
# (docs/formats.md). Mapping estimates these parameters.
UNKNOWN_MOUNT_SIGMA_M: Final = 0.5
UNKNOWN_MOUNT_SIGMA_YAW_RAD: Final = radians(8.0)
UNKNOWN_TIME_OFFSET_SIGMA_S: Final = 0.3
UNKNOWN_RANGE_OFFSET_SIGMA_M: Final = 0.1
# Relative uncertainty of the scale. Encoders measure the rotation of wheels of known radius; a robot's speed may be the
# commanded one. A range sensor was calibrated; a tag detector was configured with a tag size, often a wrong one.
ENCODER_SCALE_SIGMA: Final = 0.01
SPEED_SCALE_SIGMA: Final = 0.05
RANGE_SCALE_SIGMA: Final = 0.02
DETECTOR_SCALE_SIGMA: Final = 0.15
UNKNOWN_WHEEL_RATIO_SIGMA: Final = 0.02
UNKNOWN_TRACK_SIGMA: Final = 0.3  # relative: wheels skid, and turning speeds may be uncalibrated
# The log holds metres, so radius and ticks are not used, but robot.yaml requires them.
_NOMINAL_RADIUS_M: Final = 0.1
_NOMINAL_TICKS_PER_TURN: Final = 1000
# Placeholder in robot.yaml where odometry holds poses or turning speeds, which do not depend on it.
NOMINAL_TRACK_M: Final = 0.5
# A lower rate gives no path, a higher one is implausible; and stamps must fit into 63 bits of nanoseconds.
_STATE_RATES_HZ: Final = (0.1, 1000.0)
_OUT_OF_PLANE: Final = ("camera_z_m", "camera_roll_deg", "camera_pitch_deg")
_SAFE_NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")


@dataclass(frozen=True)
class ImportOptions:
    """Options of the command line for the run; None if not given."""

    run_id: str | None = None
    robot_id: str | None = None
    robot: StrPath | None = None
    track_width_m: float | None = None
    wheelbase_m: float | None = None
    state_rate_hz: float | None = None
    wheel_radius_m: float | None = None
    ticks_per_turn: float | None = None
    camera_x_m: float | None = None
    camera_y_m: float | None = None
    camera_yaw_deg: float | None = None
    camera_z_m: float | None = None
    camera_roll_deg: float | None = None
    camera_pitch_deg: float | None = None
    tag_family: str = "tag36h11"

    def __post_init__(self) -> None:
        for option in ("track_width_m", "wheelbase_m", "state_rate_hz", "wheel_radius_m", "ticks_per_turn"):
            self._check_number(option, positive=True)
        least_hz, most_hz = _STATE_RATES_HZ
        if self.state_rate_hz is not None and not least_hz <= self.state_rate_hz <= most_hz:
            raise OfflineError(
                f"--state-rate-hz is {self.state_rate_hz}, must be {least_hz:g} to {most_hz:g} states a second"
            )
        for option in ("camera_x_m", "camera_y_m", "camera_yaw_deg", *_OUT_OF_PLANE):
            self._check_number(option, positive=False)
        for option in ("run_id", "robot_id"):
            value = getattr(self, option)
            if value is not None and not _SAFE_NAME.fullmatch(value):
                raise OfflineError(
                    f"{_flag(option)} is {value!r}; use at most 64 letters, digits, dots, dashes and "
                    "underscores, the first a letter or digit"
                )

    def _check_number(self, option: str, *, positive: bool) -> None:
        value = getattr(self, option)
        if value is None:
            return
        if not isfinite(value) or (positive and value <= 0):
            raise OfflineError(f"{_flag(option)} is {value}, must be {'above 0' if positive else 'finite'}; correct it")

    @property
    def robot_path(self) -> Path | None:
        """Path of the robot's file."""
        return None if self.robot is None else Path(self.robot)

    @property
    def has_mount(self) -> bool:
        """Whether any part of the camera's pose is given."""
        return any(value is not None for value in (self.camera_x_m, self.camera_y_m, self.camera_yaw_deg))

    @property
    def out_of_plane_flags(self) -> tuple[str, ...]:
        """Given options of the camera's height, roll and pitch."""
        return tuple(_flag(option) for option in _OUT_OF_PLANE if getattr(self, option) is not None)

    @property
    def tick_flags(self) -> tuple[str, ...]:
        """Given options that define the length of a tick."""
        return tuple(_flag(o) for o in ("wheel_radius_m", "ticks_per_turn") if getattr(self, o) is not None)


@dataclass(frozen=True)
class RobotDefaults:
    """Parameters of the robot that the recording itself implies.

    Attributes:
        mount: mount of its camera.
        family: family of its tags.
        tag_size_m: size of its tags.
        needs_track: whether the distance between the wheels matters.
        wheel_scale_sigma: relative sigma of the odometry's scale.
        range_scale_sigma: relative sigma of the scale of its tag positions.
        mount_fields: fields of the mount, with their sigmas, where the recording implies some and not others.
    """

    mount: Mount | None = None
    family: str = "tag36h11"
    tag_size_m: float | None = None
    needs_track: bool = True
    wheel_scale_sigma: float = ENCODER_SCALE_SIGMA
    range_scale_sigma: float = RANGE_SCALE_SIGMA
    mount_fields: Mapping[str, float] = dataclasses.field(default_factory=dict)


def placeholder_parameters(robot: Robot) -> frozenset[str]:
    """Return the wheel parameters of an imported robot whose lengths are placeholders, so only factors have a meaning.

    Args:
        robot: robot of an import without robot.yaml.
    """
    wheels, (radius, _, track) = robot.wheels, WHEEL_PARAMETERS
    lengths = (wheels.radius_left_m, wheels.radius_right_m, wheels.ticks_per_turn)
    has_radius = lengths == (_NOMINAL_RADIUS_M, _NOMINAL_RADIUS_M, _NOMINAL_TICKS_PER_TURN)
    return frozenset([radius] * has_radius + [track] * (wheels.track_m == NOMINAL_TRACK_M))


def safe_name(recording: Path) -> str:
    """Return a folder's name or file's stem, with all but letters, digits, dots and underscores replaced by dashes."""
    path = recording.resolve()
    name = re.sub(r"[^A-Za-z0-9._-]+", "-", path.stem if path.is_file() else path.name).lstrip("._-")[:64]
    if not name:
        raise OfflineError(f"{recording}: a run cannot be named after this; give --run-id and --robot-id")
    return name


def _read_robot(path: Path) -> Robot:
    """Read robot.yaml.

    Raises:
        GroundsbotError: it cannot be read, or has several cameras, of which an imported recording has one.
    """
    robot = read_robot_yaml(path)
    if robot.cameras:
        raise OfflineError(
            f"{path}: cameras: {', '.join(robot.cameras)}; recordings are imported with one camera, so give a "
            "robot.yaml with the fields of that one at its top level"
        )
    return robot


def wheel_scale(options: ImportOptions) -> WheelScale:
    """Return lengths of ticks and track; an option overrides robot.yaml."""
    robot = _read_robot(options.robot_path) if options.robot_path else None
    if robot is None:
        if options.wheel_radius_m is None or options.ticks_per_turn is None:
            return WheelScale(options.track_width_m, None, None, options.tick_flags)
        tick_m = 2 * pi * options.wheel_radius_m / options.ticks_per_turn
        return WheelScale(options.track_width_m, tick_m, tick_m, options.tick_flags)
    wheels = robot.wheels.model_copy(update=_wheels_from_options(options))
    return WheelScale(wheels.track_m, *wheels.metres_per_tick, options.tick_flags, wheels.wiring)


def describe_robot(
    recording: Path, options: ImportOptions, in_camera: bool, known: RobotDefaults | None = None
) -> tuple[Robot, str, list[str]]:
    """Return the run's robot, its robot.yaml as text for the log, and remarks for the user.

    Args:
        recording: names the robot if the options do not.
        options: options of the command line.
        in_camera: whether observations are in the camera's frame, so that its mount matters.
        known: properties known from the recording; robot.yaml and options override it.

    Raises:
        OfflineError: the track width is given nowhere.
        CalibError: robot.yaml cannot be used.
    """
    known = known or RobotDefaults()
    if options.robot is not None:
        data = _read_robot(Path(options.robot)).model_dump()
        said = f"wheels and mount as in {options.robot}, where no option says otherwise"
    else:
        data = _bare_robot(recording, options, known)
        said = (
            "robot.yaml made from the options; other parameters (clock, mount, track, ratio of the wheels, size "
            "of tags, offset of ranges) have wide sigmas, and map estimates them"
        )
    if options.robot_id is not None:
        data["robot_id"] = options.robot_id
    if options.robot is not None:
        _apply_wheels(data["wheels"], options)
    else:
        data["wheels"] |= _wheels_from_options(options)
    remarks = [said]
    if options.robot is None and options.robot_id is None:
        remarks.append(
            "the robot is named after the recording; with one --robot-id the drives of one robot share a calibration"
        )
    if in_camera:
        remarks.append(_apply_mount(data["mount"], options))
    text = yaml.safe_dump(data, sort_keys=False)
    return parse_robot_yaml(text, f"{recording}: robot.yaml for the log"), text, remarks


def _bare_robot(recording: Path, options: ImportOptions, known: RobotDefaults) -> dict[str, Any]:
    if options.track_width_m is None and known.needs_track:
        raise OfflineError(
            f"{recording}: the distance between the wheels is unknown; give --track-width-m (roughly: map "
            "estimates it) or --robot"
        )
    bare: dict[str, Any] = {
        "robot_id": options.robot_id or safe_name(recording),
        "wheels": {
            "radius_left_m": _NOMINAL_RADIUS_M,
            "radius_right_m": _NOMINAL_RADIUS_M,
            "track_m": options.track_width_m or NOMINAL_TRACK_M,
            "ticks_per_turn": _NOMINAL_TICKS_PER_TURN,
            "radii_scale_sigma": known.wheel_scale_sigma,
            "radii_ratio_sigma": UNKNOWN_WHEEL_RATIO_SIGMA,
        },
        "mount": known.mount.model_dump() if known.mount is not None else dict(known.mount_fields),
        "time_offset_s_sigma": UNKNOWN_TIME_OFFSET_SIGMA_S,
        "range_offset_m_sigma": UNKNOWN_RANGE_OFFSET_SIGMA_M,
        "imported_tag_scale_sigma": known.range_scale_sigma,
    }
    bare["wheels"]["track_m_sigma"] = UNKNOWN_TRACK_SIGMA * bare["wheels"]["track_m"]
    if known.tag_size_m is not None:
        bare["tags"] = [{"family": known.family, "default_size_m": known.tag_size_m}]
        bare["recorder"] = {"families": [known.family]}
    return bare


def _apply_wheels(wheels: dict[str, Any], options: ImportOptions) -> None:
    for field, value in _wheels_from_options(options).items():
        wheels[field] = value
        wheels.pop(f"{field}_sigma", None)  # that of another value


def _wheels_from_options(options: ImportOptions) -> dict[str, float]:
    given = {
        "radius_left_m": options.wheel_radius_m,
        "radius_right_m": options.wheel_radius_m,
        "track_m": options.track_width_m,
        "ticks_per_turn": options.ticks_per_turn,
    }
    return {field: value for field, value in given.items() if value is not None}


def _apply_mount(mount: dict[str, Any], options: ImportOptions) -> str:
    """Set the mount that the options give; unknown coordinates become 0 with a wide sigma. Return a remark."""
    yaw_rad = None if options.camera_yaw_deg is None else radians(options.camera_yaw_deg)
    for option in _OUT_OF_PLANE:
        value = getattr(options, option)
        if value is not None:
            name = option.removeprefix("camera_").replace("_deg", "_rad")
            mount[name] = radians(value) if option.endswith("_deg") else value
            mount.pop(f"{name}_sigma", None)  # that of another value
    assumed = []
    for field, given, sigma, said in (
        ("x_m", options.camera_x_m, UNKNOWN_MOUNT_SIGMA_M, f"x (sigma {UNKNOWN_MOUNT_SIGMA_M:g} m)"),
        ("y_m", options.camera_y_m, UNKNOWN_MOUNT_SIGMA_M, f"y (sigma {UNKNOWN_MOUNT_SIGMA_M:g} m)"),
        (
            "yaw_rad",
            yaw_rad,
            UNKNOWN_MOUNT_SIGMA_YAW_RAD,
            f"yaw (sigma {degrees(UNKNOWN_MOUNT_SIGMA_YAW_RAD):g} deg)",
        ),
    ):
        if given is not None:
            mount[field] = given
            mount.pop(f"{field}_sigma", None)  # that of another value
        elif field not in mount:
            mount[field], mount[f"{field}_sigma"] = 0.0, sigma
            assumed.append(said)
    place = f"camera at x {mount['x_m']:g} m, y {mount['y_m']:g} m, yaw {degrees(mount['yaw_rad']):g} deg of the base"
    return f"{place}; not given, so assumed to be 0 with a wide sigma: {', '.join(assumed)}" if assumed else place


def _flag(option: str) -> str:
    return f"--{option.replace('_', '-')}"
