"""What `--calibrate` says: off, auto, or names of numbers. Imports nothing heavy, for the command line."""

from dataclasses import dataclass
from typing import Final

from groundsbot.offline.errors import OfflineError

OFF: Final = "off"
AUTO: Final = "auto"
# Names of what may be freed; camera height is held, and with it the principal point.
NAMES: Final = (
    "wheel_scale",
    "wheel_ratio",
    "track_scale",
    "tag_scale",
    "mount_x_m",
    "mount_y_m",
    "mount_roll_rad",
    "mount_pitch_rad",
    "mount_yaw_rad",
    "time_offset_s",
    "edge_shift_px",
    "range_offset_m",
    "focal_scale",
)


@dataclass(frozen=True)
class Calibrate:
    """Whether drives may set numbers of robot.yaml, and which.

    Attributes:
        is_on: else calibration is a nuisance under robot.yaml's sigmas.
        names: what to free where drives tell it; none: what they contradict.
    """

    is_on: bool = False
    names: tuple[str, ...] = ()


def parse_calibrate(text: str) -> Calibrate:
    """Of the command line.

    Raises:
        OfflineError: a name that is none.
    """
    if text in (OFF, AUTO):
        return Calibrate(text == AUTO)
    names = tuple(name.strip() for name in text.split(","))
    for name in names:
        if name not in NAMES:
            raise OfflineError(
                f"--calibrate: {name!r} is neither {OFF} nor {AUTO} nor a number that drives can set; those are "
                f"{', '.join(NAMES)}"
            )
    return Calibrate(is_on=True, names=names)
