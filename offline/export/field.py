"""The field of an FRC layout: its size, and whether the tags of a map lie in it, all in metres."""

from collections.abc import Sequence
from typing import Final

import numpy as np

from groundsbot.calib.foundation import plural
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.export.options import numbers
from groundsbot.offline.export.tag_poses import LayoutTag
from groundsbot.offline.maps import Component, DatumKind, shape_of

# FRC's fields are 16 to 18 m long, 53 to 58 ft: in feet they are longer than this.
_LONGEST_M: Final = 50.0
_HIGHEST_M: Final = 10.0  # no hall is higher; in inches and millimetres heights of tags are larger numbers
# WPILib's layouts have tags up to 4 mm outside the field (2022, tag 0), on walls of some centimetres.
_WALL_M: Final = 0.05
# So many sigmas a tag on the wall may be measured outside: one in a thousand is farther.
_MOST_SIGMAS: Final = 3.0


def field_size_m(text: str | None) -> tuple[float, float]:
    """Return length and width from --field-m.

    Raises:
        OfflineError: the lengths are missing, or are not those of a field in metres.
    """
    if text is None:
        raise OfflineError(
            "--format frc: a layout needs the size of the field, as WPILib rotates it about the field's centre for the "
            "other alliance; give --field-m LENGTH,WIDTH"
        )
    length_m, width_m = numbers("--field-m", text, "LENGTH,WIDTH")
    if min(length_m, width_m) <= 0.0:
        raise OfflineError(f"--field-m {text}: both lengths must be above 0; give metres, as 16.484,8.103")
    if max(length_m, width_m) > _LONGEST_M:
        raise OfflineError(
            f"--field-m {text}: must be at most {_LONGEST_M:g}; give metres, as 16.484,8.103 for a field of 54 by 26 ft"
        )
    return length_m, width_m


def check_places(component: Component, placed: Sequence[LayoutTag], field_m: tuple[float, float]) -> list[str]:
    """Raise an error if tags are outside the field, or so high that heights are not in metres.

    A tag may be as far outside as its place relative to the other tags may be wrong.

    Returns:
        A warning if the map's frame is not one of a field.

    Raises:
        OfflineError: how many tags, the farthest of them, and what to do.
    """
    high = [each for each in placed if abs(each.z_m) > _HIGHEST_M]
    if high:
        raise OfflineError(
            f"--format frc: tag {high[0].tag.label} is {high[0].z_m:g} m high, must be at most {_HIGHEST_M:g}; "
            "correct it, in metres"
        )
    has_frame = component.datum is not None and component.datum.kind is not DatumKind.TAGS
    shape = shape_of(component)
    sigmas_m = np.zeros(len(component.tags)) if shape is None else shape.tag_sigmas_m
    margins_m = {tag.full_label: _WALL_M + _MOST_SIGMAS * s for tag, s in zip(component.tags, sigmas_m, strict=True)}
    beyond_m = {
        each.tag.full_label: float(np.maximum(-each.tag.position_m, each.tag.position_m - field_m).max())
        for each in placed
    }
    outside = [each.tag for each in placed if beyond_m[each.tag.full_label] > margins_m[each.tag.full_label]]
    if outside:
        far = max(outside, key=lambda tag: beyond_m[tag.full_label])
        x_m, y_m = far.position_m.tolist()
        raise OfflineError(
            f"--field-m {field_m[0]:g},{field_m[1]:g}: {len(outside)} of {plural(len(placed), 'tag')} "
            f"{'lies' if len(outside) == 1 else 'lie'} outside, tag {far.label} at x {x_m:.2f} m, y {y_m:.2f} m "
            f"relative to {component.frame_name}; {_WAY_OUT if has_frame else _ALIGNMENT}"
        )
    if has_frame:
        return []
    return [f"warning: positions are relative to {component.frame_name}, not to a corner of the field; {_ALIGNMENT}"]


_ALIGNMENT: Final = (
    "align the map by --frame with a layout (.json) or with places of two tags or more (.csv of tag_id,x_m,y_m), in "
    "metres from the field's corner"
)
_WAY_OUT: Final = "check that --frame and --field-m are in metres from the field's corner"
