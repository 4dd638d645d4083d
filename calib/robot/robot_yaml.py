"""robot.yaml, the file of one robot: every name has its unit, and every calibrated value its sigma.

docs/robot_yaml.md describes all fields.
"""

import math
import operator
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Final, Self

from pydantic import (
    AliasChoices,
    Field,
    SerializerFunctionWrapHandler,
    field_validator,
    model_serializer,
    model_validator,
)

from groundsbot.calib.errors import CalibError
from groundsbot.calib.foundation import parse_mapping, read_text, validate, write_model
from groundsbot.calib.robot.camera_section import CameraFields, CameraSection
from groundsbot.calib.robot.fields import Finite, Length, ModulePlace, NotNegative, Positive, Section, TagFamily
from groundsbot.calib.robot.recording_options import CameraDevice, Devices, RecorderOptions
from groundsbot.calib.robot.wiring import Wiring

RELATIVE_RADIUS_SIGMA = 0.005
RELATIVE_TRACK_SIGMA = 0.01
RELATIVE_TAG_SIZE_SIGMA = 0.005
_LEFT_OPEN_TRACK_SIGMA: Final = 0.1  # as a share; a measured track has a smaller sigma
MOST_CAMERAS: Final = 4
_OF_CAMERA: Final = tuple(CameraFields.model_fields)
_OF_DEVICE: Final = tuple(CameraDevice.model_fields)
CameraName = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]{0,15}$")]


def _share_of(field: str, share: float) -> Any:  # noqa: ANN401 - as pydantic's Field
    """Return a field whose default is a share of another field's value."""
    return Field(default_factory=lambda data: data[field] * share)


class Wheels(Section):
    """The differential drive.

    By default the errors of the two radii are independent, so their common scale has the sigma of one over sqrt(2).
    `radii_scale_sigma` and `radii_ratio_sigma` override that: relative sigmas of the common scale, and of the right
    radius over the left one. Drives determine the ratio far better than the scale.
    """

    radius_left_m: Length
    radius_left_m_sigma: Positive = _share_of("radius_left_m", RELATIVE_RADIUS_SIGMA)
    radius_right_m: Length
    radius_right_m_sigma: Positive = _share_of("radius_right_m", RELATIVE_RADIUS_SIGMA)
    track_m: Length
    track_m_sigma: Positive = _share_of("track_m", RELATIVE_TRACK_SIGMA)
    ticks_per_turn: Positive
    radii_scale_sigma: Positive | None = None
    radii_ratio_sigma: Positive | None = None
    # Encoders that are wired otherwise than the protocol has it.
    encoders_exchanged: bool = Field(False, exclude_if=operator.not_)
    left_encoder_reversed: bool = Field(False, exclude_if=operator.not_)
    right_encoder_reversed: bool = Field(False, exclude_if=operator.not_)

    @property
    def wiring(self) -> Wiring:
        """How the controller's counts belong to the wheels."""
        return Wiring(self.encoders_exchanged, self.left_encoder_reversed, self.right_encoder_reversed)

    @property
    def metres_per_tick(self) -> tuple[float, float]:
        """Distance that the left and the right wheel roll in one tick."""
        turn = 2.0 * math.pi / self.ticks_per_turn
        return self.radius_left_m * turn, self.radius_right_m * turn

    @property
    def relative_sigmas(self) -> tuple[float, float, float]:
        """Relative sigmas of the radii's common scale, of the right radius over the left one, and of the track."""
        ratio_sigma = math.hypot(
            self.radius_left_m_sigma / self.radius_left_m, self.radius_right_m_sigma / self.radius_right_m
        )
        return (
            self.radii_scale_sigma or 0.5 * ratio_sigma,
            self.radii_ratio_sigma or ratio_sigma,
            self.track_m_sigma / self.track_m,
        )


def _reference_size(batch: dict[str, Any]) -> float:
    """Return the size in m to which the sigma of a batch refers."""
    return float(batch["default_size_m"] or max(batch["sizes_m"].values(), default=1.0))


class TagBatch(Section):
    """Tags printed together, with one common scale error: `sigma_size_m` at the default size, else at the largest."""

    family: TagFamily = "tag36h11"
    default_size_m: Length | None = None
    sizes_m: dict[Annotated[int, Field(ge=0)], Length] = Field({})
    sigma_size_m: Positive = Field(default_factory=lambda data: _reference_size(data) * RELATIVE_TAG_SIZE_SIGMA)
    batch: Annotated[str, Field(min_length=1)] = "default"

    @model_validator(mode="after")
    def _has_a_size(self) -> Self:
        if self.default_size_m is None and not self.sizes_m:
            raise ValueError(
                "default_size_m is missing and sizes_m is empty; give the side of the black border's outer edge in m"
            )
        return self

    @property
    def relative_sigma(self) -> float:
        """The batch's scale error as a share of the size."""
        return self.sigma_size_m / _reference_size(vars(self))


class Gyro(Section):
    """Noise of a gyro's yaw rate (positive to the left), and its calibration with sigmas before a drive.

    The defaults are for an uncalibrated ICM-20948, slightly wider than its data sheet.
    """

    noise_rad_per_sqrt_s: Positive = math.radians(0.015)
    bias_rad_s_sigma: Positive = math.radians(2.0)
    bias_walk_rad_s_per_sqrt_s: Positive = math.radians(10.0 / 3600.0) / 60.0
    scale: Annotated[float, Field(gt=-0.5, lt=1.0)] = 0.0  # the rate is (1 + scale) times what is measured
    scale_sigma: Positive = 0.02
    time_offset_s: Finite = 0.0  # delay of the gyro's stamps against the wheels'
    time_offset_s_sigma: Positive = 0.005


class RobotHead(Section):
    """What robot.yaml begins with."""

    robot_id: str
    wheels: Wheels


class Robot(CameraFields, RobotHead):
    """A robot: wheels, cameras and their mounts, tags that it may meet, devices and recorder options.

    With several cameras, in `cameras` by name, the fields of a single camera are those of the first.
    """

    # Logs contain copies of robot.yaml. Older ones have the names of the time when only imported ranges had an offset.
    range_offset_m: Finite = Field(0.0, validation_alias=AliasChoices("range_offset_m", "imported_range_offset_m"))
    range_offset_m_sigma: NotNegative = Field(
        0.0, validation_alias=AliasChoices("range_offset_m_sigma", "imported_range_offset_m_sigma")
    )
    tags: list[TagBatch] = Field([])
    imported_tag_scale_sigma: Positive = RELATIVE_TAG_SIZE_SIGMA
    # A log with gyro readings whose robot.yaml has no gyro section is read with the defaults of `Gyro`.
    gyro: Gyro | None = Field(None, exclude_if=lambda gyro: gyro is None)
    # Of a swerve drive: x, y of each module in base, in the order in which its program logs them.
    swerve_modules_m: Annotated[list[ModulePlace], Field(max_length=16)] = Field(
        [], exclude_if=lambda places: not places
    )
    devices: Devices = Devices()
    cameras: Annotated[dict[CameraName, CameraSection], Field(min_length=1, max_length=MOST_CAMERAS)] = Field(
        {}, exclude_if=lambda cameras: not cameras
    )
    recorder: RecorderOptions = RecorderOptions()

    @field_validator("robot_id")
    @classmethod
    def _fit_for_file_names(cls, robot_id: str) -> str:
        if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}", robot_id):
            raise ValueError(
                f"{robot_id!r} is not 1 to 64 letters, digits, '.', '_' or '-' beginning with a letter or digit; "
                "rename the robot, file names are made of this"
            )
        return robot_id

    @model_validator(mode="after")
    def _detects_its_tags(self) -> Self:
        for index, batch in enumerate(self.tags):
            if batch.family not in self.recorder.families:
                raise ValueError(
                    f"tags[{index}].family is {batch.family!r} but recorder.families is {self.recorder.families}, "
                    "so its tags would not be detected; add it there"
                )
        return self

    @model_validator(mode="after")
    def _each_tag_once(self) -> Self:
        defaults: set[str] = set()
        listed: set[tuple[str, int]] = set()
        for index, batch in enumerate(self.tags):
            if batch.default_size_m is not None and batch.family in defaults:
                raise ValueError(
                    f"tags[{index}].default_size_m: {batch.family} has a default size already; "
                    "list the ids of all but one batch in sizes_m"
                )
            twice = sorted(tag_id for tag_id in batch.sizes_m if (batch.family, tag_id) in listed)
            if twice:
                raise ValueError(
                    f"tags[{index}].sizes_m: {batch.family} tag {twice[0]} is in an earlier batch too; remove one"
                )
            listed.update((batch.family, tag_id) for tag_id in batch.sizes_m)
            if batch.default_size_m is not None:
                defaults.add(batch.family)
        return self

    @model_validator(mode="after")
    def _take_first_camera(self) -> Self:
        if not self.cameras:
            return self
        given = [name for name in _OF_CAMERA if name in self.model_fields_set]
        given += [f"devices.{name}" for name in _OF_DEVICE if name in self.devices.model_fields_set]
        first = next(iter(self.cameras))
        if given:
            field = "device" + given[0].removeprefix("devices") if given[0].startswith("devices") else given[0]
            raise ValueError(
                f"{given[0]} is given beside cameras, which has it for each; move it to cameras.{first}.{field}"
            )
        owners: dict[str, str] = {}
        for name, section in self.cameras.items():
            device = section.device.camera
            if device is not None and owners.setdefault(device, name) != name:
                raise ValueError(
                    f"cameras.{name}.device.camera is {device!r}, that of {owners[device]}; give each camera its own"
                )
        vars(self).update(_single(self, self.cameras[first]))
        return self

    @model_serializer(mode="wrap")
    def _write_each_camera_once(self, write: SerializerFunctionWrapHandler) -> dict[str, Any]:
        written: dict[str, Any] = write(self)
        if self.cameras:
            for name in _OF_CAMERA:
                written.pop(name, None)
            for name in _OF_DEVICE:
                written.get("devices", {}).pop(name, None)
        return written

    @property
    def camera_names(self) -> tuple[str, ...]:
        """Names of the cameras in their order; one empty name for a robot without `cameras`."""
        return tuple(self.cameras) or ("",)

    def with_camera(self, name: str) -> Self:
        """Return the robot as one whose only camera is the one with this name, of `camera_names`.

        Raises:
            CalibError: it has no such camera.
        """
        if not self.cameras and not name:
            return self
        if name not in self.cameras:
            names = ", ".join(self.cameras) or "none by name"
            raise CalibError(f"robot {self.robot_id} has no camera {name!r}; choose one of its cameras: {names}")
        return self.model_copy(update=_single(self, self.cameras[name]) | {"cameras": {}})

    def with_cameras(self, cameras: Mapping[str, CameraSection]) -> Self:
        """Return a robot with several cameras with other sections for them, by the names that it has."""
        return self.model_copy(update=_single(self, next(iter(cameras.values()))) | {"cameras": dict(cameras)})

    def update_cameras(self, fields_of: Callable[[str, CameraFields], Mapping[str, object]]) -> Self:
        """Return the robot with other values for some fields of its cameras.

        Args:
            fields_of: returns these fields of a camera, from its name of `camera_names` and its present fields.
        """
        if not self.cameras:
            return self.model_copy(update=dict(fields_of("", self)))
        return self.with_cameras(
            {name: each.model_copy(update=dict(fields_of(name, each))) for name, each in self.cameras.items()}
        )

    @property
    def module_places(self) -> tuple[tuple[float, float], ...]:
        """Places of the swerve modules in base, m; empty if there are none."""
        return tuple((x_m, y_m) for x_m, y_m in self.swerve_modules_m)

    @property
    def is_left_open(self) -> bool:
        """Whether the sigma of the clock of any camera, or of the track, is larger than that of any measured value."""
        wheels = self.wheels
        cameras: Sequence[CameraFields] = tuple(self.cameras.values()) or (self,)
        return (
            any(each.is_clock_left_open for each in cameras)
            or wheels.track_m_sigma > _LEFT_OPEN_TRACK_SIGMA * wheels.track_m
        )

    def tag_size_m(self, family: str, tag_id: int) -> tuple[float, float, str]:
        """Return side (of the black border's outer edge), sigma and batch of a tag.

        Raises:
            CalibError: robot.yaml has no size for the tag.
        """
        of_family = [batch for batch in self.tags if batch.family == family]
        for batch in of_family:
            if tag_id in batch.sizes_m:
                size_m = batch.sizes_m[tag_id]
                return size_m, size_m * batch.relative_sigma, batch.batch
        for batch in of_family:
            if batch.default_size_m is not None:
                return batch.default_size_m, batch.sigma_size_m, batch.batch
        raise CalibError(
            f"robot {self.robot_id}: tags gives no size for {family} tag {tag_id}; "
            f"add default_size_m or sizes_m: {{{tag_id}: metres}} to a batch of family {family} in robot.yaml"
        )


def _single(robot: Robot, section: CameraSection) -> dict[str, Any]:
    """Return the fields of a robot with a single camera, for one of its several."""
    fields: dict[str, Any] = {name: getattr(section, name) for name in _OF_CAMERA}
    device = {name: getattr(section.device, name) for name in _OF_DEVICE}
    return fields | {"devices": robot.devices.model_copy(update=device)}


def parse_robot_yaml(text: str, source: str) -> Robot:
    """Parse and validate the text of a robot.yaml, the description of one robot (docs/robot_yaml.md).

    Args:
        text: content of the file.
        source: what messages call the text, usually the path of the file.

    Raises:
        CalibError: the text is not YAML, or a field is unknown, missing or out of range. The message names it.
    """
    return validate(Robot, parse_mapping(text, source), source)


def read_robot_yaml(path: Path) -> Robot:
    """Return the robot of a robot.yaml file. `camera` stays relative to the file's folder.

    Raises:
        CalibError: the file is unreadable or has an invalid value.
    """
    return parse_robot_yaml(read_text(path), str(path))


def write_robot_yaml(robot: Robot, path: Path) -> None:
    """Write every field, including defaults; atomically."""
    write_model(robot, path)
