"""Sentences about self-calibration: why a parameter was not freed, and which drive would determine it."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

from groundsbot.calib.robot import without_camera
from groundsbot.offline.maps import CalibrationChoice, CalibrationResult, MapResult
from groundsbot.offline.self_calibration.selection import LESS_CERTAIN

# Drives that determine each parameter.
CALIBRATION_DRIVES: Final[Mapping[str, str]] = MappingProxyType(
    {
        "wheel_scale": "give a measured --distance, or exact tag sizes: wheels and tags can be scaled together",
        "wheel_ratio": "drive straight for 20 m and more, past tags at both ends",
        "track_scale": "turn on the spot, whole turns to either side, in view of tags",
        "tag_scale": "give a measured --distance, or exact wheel radii: wheels and tags can be scaled together",
        "mount_x_m": "turn on the spot, whole turns to either side, with tags near",
        "mount_y_m": "turn on the spot, whole turns to either side, with tags near",
        "mount_yaw_rad": "drive straight towards tags and past them",
        "mount_roll_rad": "pass tags mounted at different heights, near, and far to either side; add --model corners",
        "mount_pitch_rad": "drive towards tags from afar until they are near; add --model corners",
        "time_offset_s": "turn on the spot to and fro, fast, in view of tags",
        "range_offset_m": "see the same tags from near and from afar",
        "edge_shift_px": "see the same tags from near and from afar; add --model corners",
        "focal_scale": "drive straight towards tags from afar until they are near, and map with --model corners",
    }
)


_OBSERVED_SHARE: Final = 0.7  # an observed parameter has at most this share of its prior sigma


def is_observed(entry: CalibrationResult) -> bool:
    """Return whether drives determine a parameter better than robot.yaml does."""
    return entry.sigma < _OBSERVED_SHARE * entry.prior_sigma


def refusal_lines(result: MapResult) -> list[str]:
    """Return terminal lines with the reason for each requested parameter that was not freed."""
    return [
        f"not freed: {each.name} of {each.owner}: {choice_words(each)}"
        for each in result.choices
        if each.is_asked and not each.is_freed
    ]


def choice_words(choice: CalibrationChoice) -> str:
    """Return that a parameter was freed, or why not and what to drive."""
    if choice.is_freed:
        return "freed"
    drive = (
        f"; to determine it, {CALIBRATION_DRIVES[without_camera(choice.name)]}" if choice.reason == LESS_CERTAIN else ""
    )
    return f"kept at robot.yaml's sigma {choice.prior_sigma:.5f}: {choice.reason}{drive}"
