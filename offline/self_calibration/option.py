"""The value of `--calibrate`: off, auto, or parameter names. Imports nothing heavy, for the command line."""

from dataclasses import dataclass
from typing import Final

from groundsbot.offline.errors import OfflineError

OFF: Final = "off"
AUTO: Final = "auto"
# Parameters that may be freed; those of a camera have its name behind, as mount_x_m.left, where a robot has several.
# Camera height, not observable on a floor, stays fixed, and so does the principal point.
_OF_CAMERA: Final = (
    "mount_x_m",
    "mount_y_m",
    "mount_roll_rad",
    "mount_pitch_rad",
    "mount_yaw_rad",
    "time_offset_s",
    "edge_shift_px",
    "focal_scale",
)
NAMES: Final = ("wheel_scale", "wheel_ratio", "track_scale", "tag_scale", *_OF_CAMERA, "range_offset_m")


@dataclass(frozen=True)
class Calibrate:
    """Whether drives may correct parameters of robot.yaml, and which.

    Attributes:
        is_on: if False, calibration is a nuisance parameter under robot.yaml's sigmas.
        names: parameters to free where the drives observe them; if empty, those that contradict robot.yaml.
    """

    is_on: bool = False
    names: tuple[str, ...] = ()


def parse_calibrate(text: str) -> Calibrate:
    """Parse the command-line value.

    Raises:
        OfflineError: a name is unknown.
    """
    if text in (OFF, AUTO):
        return Calibrate(text == AUTO)
    names = tuple(name.strip() for name in text.split(","))
    for name in names:
        parameter, dot, _ = name.partition(".")
        if parameter not in (_OF_CAMERA if dot else NAMES):
            raise OfflineError(
                f"--calibrate: {name!r} is neither {OFF} nor {AUTO} nor a parameter that drives can calibrate; those "
                f"are {', '.join(NAMES)}, and of one of several cameras such as {_OF_CAMERA[0]}.left"
            )
    return Calibrate(is_on=True, names=names)
