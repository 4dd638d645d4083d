"""Changes that self-calibration makes to a robot's file: wide sigmas for freed parameters, and corrections applied."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final, NamedTuple

from groundsbot.calib.robot import (
    EDGE_SHIFT,
    FOCAL_SCALE,
    IMPORTED_BATCH,
    MOUNT_PARAMETERS,
    RANGE_OFFSET,
    TAG_SCALE,
    TIME_OFFSET,
    WHEEL_PARAMETERS,
    CameraFields,
    Mount,
    Robot,
    TagBatch,
    Wheels,
    camera_parameter,
    without_camera,
)

_WHEEL_SCALE, _WHEEL_RATIO, TRACK_SCALE = WHEEL_PARAMETERS
_MOUNT: Final = "mount_"

# Parameters that may be freed, of several cameras those of each, and their prior sigma when freed: that of a robot that
# was calibrated, so wide that the data dominate it. Camera height is not among them: on a floor only differences of
# heights are observable.
FREED_SIGMAS: Final[Mapping[str, float]] = MappingProxyType(
    {
        _WHEEL_SCALE: 0.05,
        _WHEEL_RATIO: 0.05,
        TRACK_SCALE: 0.25,  # tracked and skidding robots turn half as far again as their wheels' track implies
        **dict.fromkeys((*MOUNT_PARAMETERS, "mount_roll_rad", "mount_pitch_rad"), 0.15),  # rad; 9 degrees
        "mount_x_m": 0.5,
        "mount_y_m": 0.5,
        TIME_OFFSET: 0.3,
        EDGE_SHIFT: 1.0,
        RANGE_OFFSET: 0.1,
        TAG_SCALE: 0.15,  # a tag of ten cells measured over the white margin comes out 25 % too large
        FOCAL_SCALE: 0.05,
    }
)
# Parameters whose error may be too large for a first-order judgement of robot.yaml.
GROSS_ERROR_NAMES: Final = (TIME_OFFSET, TRACK_SCALE, *MOUNT_PARAMETERS)
# A larger error means the file of another robot, not a calibration error.
MAX_FREED_SIGMAS: Final = 3.0


class Correction(NamedTuple):
    """A correction to a number of robot.yaml, and its sigma."""

    value: float
    sigma: float


class OwnedParameter(NamedTuple):
    """A calibration parameter by owner (a robot id, or a batch of tags with its family) and name."""

    owner: str
    name: str


def freed_sigma(name: str) -> float:
    """Return the prior sigma of a parameter when freed, in its unit.

    Args:
        name: name in FREED_SIGMAS, or that of one of several cameras.
    """
    return FREED_SIGMAS[without_camera(name)]


def names_of_cameras(robot: Robot, name: str) -> list[str]:
    """Return the names that a camera's parameter has for each camera of a robot, in the order of its cameras."""
    return [camera_parameter(name, camera) for camera in robot.camera_names]


def open_parameters(robot: Robot, freed: Mapping[OwnedParameter, float]) -> Robot:
    """Return the robot with these sigmas for freed parameters; its values stay."""

    def sigma(name: str) -> float | None:
        return freed.get(OwnedParameter(robot.robot_id, name))

    def of_camera(camera: str, fields: CameraFields) -> dict[str, object]:
        mount = {f"{field}_sigma": sigma(camera_parameter(_MOUNT + field, camera)) for field in _mount_fields()}
        return {
            "mount": fields.mount.model_copy(update={name: each for name, each in mount.items() if each}),
            "time_offset_s_sigma": sigma(camera_parameter(TIME_OFFSET, camera)) or fields.time_offset_s_sigma,
            "edge_shift_px_sigma": sigma(camera_parameter(EDGE_SHIFT, camera)) or fields.edge_shift_px_sigma,
            "focal_scale_sigma": sigma(camera_parameter(FOCAL_SCALE, camera)) or fields.focal_scale_sigma,
        }

    wheels, track = robot.wheels, sigma(TRACK_SCALE)
    changed: dict[str, object] = {
        "radii_scale_sigma": sigma(_WHEEL_SCALE) or wheels.radii_scale_sigma,
        "radii_ratio_sigma": sigma(_WHEEL_RATIO) or wheels.radii_ratio_sigma,
        "track_m_sigma": track * wheels.track_m if track else wheels.track_m_sigma,
    }
    return robot.update_cameras(of_camera).model_copy(
        update={
            "wheels": wheels.model_copy(update=changed),
            "range_offset_m_sigma": sigma(RANGE_OFFSET) or robot.range_offset_m_sigma,
            "tags": [_open_batch(batch, freed.get(_of_batch(batch))) for batch in robot.tags],
            "imported_tag_scale_sigma": next(
                (value for each, value in freed.items() if each.owner.startswith(IMPORTED_BATCH)),
                robot.imported_tag_scale_sigma,
            ),
        }
    )


def with_unknown_calibration(robot: Robot) -> Robot:
    """Return the robot with wide sigmas for every parameter that may be grossly wrong, and for the focal length."""
    of_cameras = [
        each for name in (TIME_OFFSET, *MOUNT_PARAMETERS, FOCAL_SCALE) for each in names_of_cameras(robot, name)
    ]
    own = {OwnedParameter(robot.robot_id, each): freed_sigma(each) for each in (TRACK_SCALE, RANGE_OFFSET, *of_cameras)}
    batches = [*(_of_batch(batch) for batch in robot.tags), OwnedParameter(IMPORTED_BATCH, TAG_SCALE)]
    return open_parameters(robot, own | dict.fromkeys(batches, FREED_SIGMAS[TAG_SCALE]))


def correct_robot(robot: Robot, learnt: Mapping[OwnedParameter, Correction]) -> Robot:
    """Return the robot with corrections applied to values and sigmas; the camera is not part of it."""

    def of(name: str, camera: str = "") -> Correction | None:
        return learnt.get(OwnedParameter(robot.robot_id, camera_parameter(name, camera)))

    def of_camera(camera: str, fields: CameraFields) -> dict[str, object]:
        changed: dict[str, object] = {
            "mount": _correct_mount(fields.mount, {field: of(_MOUNT + field, camera) for field in _mount_fields()})
        }
        if late := of(TIME_OFFSET, camera):
            changed |= {"time_offset_s": fields.time_offset_s + late.value, "time_offset_s_sigma": late.sigma}
        if shift := of(EDGE_SHIFT, camera):
            changed |= {"edge_shift_px": fields.edge_shift_px + shift.value, "edge_shift_px_sigma": shift.sigma}
        if focal := of(FOCAL_SCALE, camera):
            changed |= {"focal_scale_sigma": focal.sigma}
        return changed

    changed: dict[str, object] = {
        "wheels": _correct_wheels(robot.wheels, of(_WHEEL_SCALE), of(_WHEEL_RATIO), of(TRACK_SCALE)),
        "tags": [_correct_batch(batch, learnt.get(_of_batch(batch))) for batch in robot.tags],
    }
    if offset := of(RANGE_OFFSET):
        changed |= {"range_offset_m": robot.range_offset_m + offset.value, "range_offset_m_sigma": offset.sigma}
    return robot.update_cameras(of_camera).model_copy(update=changed)


def _mount_fields() -> list[str]:
    """Return the fields of a mount that can be freed, without their `mount_`."""
    return [name.removeprefix(_MOUNT) for name in FREED_SIGMAS if name.startswith(_MOUNT)]


def _of_batch(batch: TagBatch) -> OwnedParameter:
    return OwnedParameter(f"{batch.batch} {batch.family}", TAG_SCALE)


def _open_batch(batch: TagBatch, sigma: float | None) -> TagBatch:
    if sigma is None:
        return batch
    return batch.model_copy(update={"sigma_size_m": sigma * batch.sigma_size_m / batch.relative_sigma})


def _correct_wheels(
    wheels: Wheels, scale: Correction | None, ratio: Correction | None, track: Correction | None
) -> Wheels:
    changed: dict[str, float] = {}
    if scale and ratio:
        of_one = (scale.sigma**2 + 0.25 * ratio.sigma**2) ** 0.5  # relative sigma of one radius
        for side, sign in (("left", -1.0), ("right", 1.0)):
            radius_m = getattr(wheels, f"radius_{side}_m") * (1.0 + scale.value) * (1.0 + sign * 0.5 * ratio.value)
            changed |= {f"radius_{side}_m": radius_m, f"radius_{side}_m_sigma": radius_m * of_one}
        changed |= {"radii_scale_sigma": scale.sigma, "radii_ratio_sigma": ratio.sigma}
    if track:
        track_m = wheels.track_m * (1.0 + track.value)
        changed |= {"track_m": track_m, "track_m_sigma": track_m * track.sigma}
    return wheels.model_copy(update=changed)


def _correct_mount(mount: Mount, learnt: Mapping[str, Correction | None]) -> Mount:
    changed: dict[str, float] = {}
    for field, found in learnt.items():
        if found:
            changed |= {field: getattr(mount, field) + found.value, f"{field}_sigma": found.sigma}
    return mount.model_copy(update=changed)


def _correct_batch(batch: TagBatch, scale: Correction | None) -> TagBatch:
    if scale is None:
        return batch
    larger = 1.0 + scale.value
    reference_m = batch.sigma_size_m / batch.relative_sigma
    return batch.model_copy(
        update={
            "default_size_m": None if batch.default_size_m is None else batch.default_size_m * larger,
            "sizes_m": {tag_id: size_m * larger for tag_id, size_m in batch.sizes_m.items()},
            "sigma_size_m": reference_m * larger * scale.sigma,
        }
    )
