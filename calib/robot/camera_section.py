"""The camera of a robot: its calibration, its place on the base, and its device."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Final

from pydantic import Field, field_validator

from groundsbot.calib.robot.fields import Finite, NotNegative, Place, Positive, Section
from groundsbot.calib.robot.recording_options import CameraDevice

if TYPE_CHECKING:
    from scipy.spatial.transform import RigidTransform

# Outward shift of the sides of tags in pictures. It is below 0.05 px for a sharp camera with a linear response:
# pictures rendered with a gamma of 1.02 and a blur of 0.9 px show them 0.02 to 0.04 px too far in. With a gamma of 2.2
# and a blur of 0.5 to 1 px it is 0.2 to 0.4 px, by the erf that fits a blurred and then gamma-encoded step best. This
# sigma allows for that, and the tags of a drive determine the value.
EDGE_SHIFT_PX_SIGMA = 0.1
_LEFT_OPEN_TIME_SIGMA_S: Final = 0.05  # a measured clock has a smaller sigma
_LEVEL_OPTICAL: Final = (-0.5, 0.5, -0.5, 0.5)  # as R_LEVEL_OPTICAL


class Mount(Section):
    """Pose of the camera on the base: Trans(x, y, z) Rz(yaw) Ry(pitch) Rx(roll), then the optical axes.

    With all angles zero the camera looks level and straight ahead. Positive yaw turns it to the left, positive pitch
    down, and positive roll tilts its top to the right.
    """

    x_m: Place = 0.0
    x_m_sigma: Positive = 0.005
    y_m: Place = 0.0
    y_m_sigma: Positive = 0.005
    z_m: Place = 0.0
    z_m_sigma: Positive = 0.005
    roll_rad: Finite = 0.0
    roll_rad_sigma: Positive = math.radians(0.5)
    pitch_rad: Finite = 0.0
    pitch_rad_sigma: Positive = math.radians(0.5)
    yaw_rad: Finite = 0.0
    yaw_rad_sigma: Positive = math.radians(0.5)

    @field_validator("roll_rad", "pitch_rad", "yaw_rad")
    @classmethod
    def _no_degrees(cls, angle_rad: float) -> float:
        if abs(angle_rad) > 2.0 * math.pi:
            raise ValueError(f"{angle_rad} is more than a full turn (2 pi rad); give radians, not degrees")
        return angle_rad

    @property
    def T_base_camera(self) -> "RigidTransform":
        """Transform of points from the camera's optical frame to base; for the laptop, as it needs scipy."""
        from groundsbot.calib.robot.mount_transform import transform_of

        return transform_of(self.x_m, self.y_m, self.z_m, [self.yaw_rad, self.pitch_rad, self.roll_rad])

    @property
    def quaternion_base_camera(self) -> tuple[float, float, float, float]:
        """Rotation of `T_base_camera` as x, y, z, w, with w not negative."""
        found = list(_LEVEL_OPTICAL)
        for axis, angle_rad in enumerate((self.roll_rad, self.pitch_rad, self.yaw_rad)):
            turn = [0.0, 0.0, 0.0, math.cos(0.5 * angle_rad)]
            turn[axis] = math.sin(0.5 * angle_rad)
            found = _multiply_quaternions(turn, found)
        x, y, z, w = found if found[3] >= 0.0 else [-each for each in found]
        return x, y, z, w


def _multiply_quaternions(a: Sequence[float], b: Sequence[float]) -> list[float]:
    """Return the rotation by `b`, then by `a`."""
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return [
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    ]


class CameraFields(Section):
    """What robot.yaml has of each camera: at its top of a single one, else in the camera's section."""

    mount: Mount = Mount()
    camera: Annotated[str, Field(min_length=1)] | None = None
    focal_scale_sigma: NotNegative = 0.0
    readout_s: NotNegative = 0.0
    time_offset_s: Finite = 0.0
    time_offset_s_sigma: Positive = 0.002
    edge_shift_px: Finite = 0.0
    edge_shift_px_sigma: NotNegative = EDGE_SHIFT_PX_SIGMA

    @property
    def is_clock_left_open(self) -> bool:
        """Whether the sigma of the time offset is larger than that of any measured value."""
        return self.time_offset_s_sigma > _LEFT_OPEN_TIME_SIGMA_S


class CameraSection(CameraFields):
    """One of several cameras of a robot."""

    camera: Annotated[str, Field(min_length=1)]
    device: CameraDevice = CameraDevice()
