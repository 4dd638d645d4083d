"""Names of the calibration parameters that an estimate may hold open."""

from typing import Final

# How many pixels too far out the sides of tags are seen.
EDGE_SHIFT: Final = "edge_shift_px"


# The calibration numbers that a tag reading depends on, besides the scale of the tag's batch.
MOUNT_PARAMETERS: Final = ("mount_x_m", "mount_y_m", "mount_yaw_rad")


# By how much pictures' stamps are late.
TIME_OFFSET: Final = "time_offset_s"


# The calibration numbers that odometry depends on, in the order of `ChainOdometry.jacobian`:
# left = left_nominal (1 + wheel_scale) (1 - wheel_ratio / 2), right likewise with +, track = nominal (1 + track_scale).
WHEEL_PARAMETERS: Final = ("wheel_scale", "wheel_ratio", "track_scale")


# What a robot's camera adds to its readings besides place and yaw of the mount, to first order: how its corners are
# read with another roll or pitch, where its tags were when the stamps are late, and what tags look too large by.
CAMERA_PARAMETERS: Final = ("mount_roll_rad", "mount_pitch_rad", TIME_OFFSET, EDGE_SHIFT)


TAG_SCALE: Final = "tag_scale"


IMPORTED_BATCH: Final = "imported "  # and the family: of positions that somebody else worked out


# By how much camera.yaml's focal lengths are off, as a share: both alike, about the principal point, which is held.
FOCAL_SCALE: Final = "focal_scale"
