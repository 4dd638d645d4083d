"""Names of the calibration parameters that an estimate may contain."""

from typing import Final

# Wheels, in the order of `ChainOdometry.jacobian`: left = left_nominal (1 + wheel_scale) (1 - wheel_ratio / 2), right
# likewise with +, track = nominal (1 + track_scale).
WHEEL_PARAMETERS: Final = ("wheel_scale", "wheel_ratio", "track_scale")

# Mount of the camera, in the plane.
MOUNT_PARAMETERS: Final = ("mount_x_m", "mount_y_m", "mount_yaw_rad")

# Camera, or the sensor of imported positions, to first order: roll and pitch of the mount, delay of the stamps, outward
# shift of the tags' sides in the picture, and excess of imported ranges.
TIME_OFFSET: Final = "time_offset_s"
EDGE_SHIFT: Final = "edge_shift_px"
RANGE_OFFSET: Final = "range_offset_m"
CAMERA_PARAMETERS: Final = ("mount_roll_rad", "mount_pitch_rad", TIME_OFFSET, EDGE_SHIFT, RANGE_OFFSET)
# Relative error of both focal lengths, about a fixed principal point.
FOCAL_SCALE: Final = "focal_scale"

# Scale of a printed batch of tags. Imported positions form a batch of their own, named by this prefix and the family.
TAG_SCALE: Final = "tag_scale"
IMPORTED_BATCH: Final = "imported "


def camera_parameter(name: str, camera: str) -> str:
    """Return the name that a parameter has for one of several cameras, as mount_x_m.left; unchanged without a name."""
    return f"{name}.{camera}" if camera else name


def split_camera_parameter(name: str) -> tuple[str, str]:
    """Return the name of a parameter without its camera, and the camera, which is empty for any other parameter."""
    parameter, _, camera = name.partition(".")
    return parameter, camera


def without_camera(name: str) -> str:
    """Return the name of a parameter without its camera: mount_x_m of mount_x_m.left."""
    return split_camera_parameter(name)[0]
