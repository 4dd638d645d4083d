"""Names of the calibration parameters that an estimate may hold open."""

from typing import Final

# Of the wheels, in the order of `ChainOdometry.jacobian`: left = left_nominal (1 + wheel_scale) (1 - wheel_ratio / 2),
# right likewise with +, track = nominal (1 + track_scale).
WHEEL_PARAMETERS: Final = ("wheel_scale", "wheel_ratio", "track_scale")

# Of the camera's mount, in the plane.
MOUNT_PARAMETERS: Final = ("mount_x_m", "mount_y_m", "mount_yaw_rad")

# Of the camera, or of the sensor that imported positions come from, to first order: how late its stamps are, by how
# many pixels it sees the sides of tags too far out, by how much imported ranges are too long, and what else a reading
# depends on besides the mount in the plane.
TIME_OFFSET: Final = "time_offset_s"
EDGE_SHIFT: Final = "edge_shift_px"
RANGE_OFFSET: Final = "range_offset_m"
CAMERA_PARAMETERS: Final = ("mount_roll_rad", "mount_pitch_rad", TIME_OFFSET, EDGE_SHIFT, RANGE_OFFSET)
# By how much the focal lengths are off, as a share: both alike, about the principal point, which is held.
FOCAL_SCALE: Final = "focal_scale"

# Of a printed batch of tags. Positions that were imported form a batch of their own: this prefix and the family.
TAG_SCALE: Final = "tag_scale"
IMPORTED_BATCH: Final = "imported "
