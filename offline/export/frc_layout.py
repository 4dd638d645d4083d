"""Tag layouts of FRC tools: WPILib's AprilTagFieldLayout and Field, and Limelight's .fmap.

Both need a tag's pose in space. Their tag frame has x out of the printed face and z up.
"""

from typing import Any, Final

import numpy as np

from groundsbot.offline.errors import OfflineError
from groundsbot.offline.export.field import check_places, field_size_m
from groundsbot.offline.export.options import ExportOptions, LayoutForm
from groundsbot.offline.export.tag_poses import LayoutTag, layout_tags
from groundsbot.offline.maps import Component

# docs.limelightvision.io, "AprilTag Map Specification", names these two.
_LIMELIGHT_FAMILIES: Final = {"tag36h11": "apriltag3_36h11_classic", "tag16h5": "apriltag3_16h5_classic"}


def frc_layout_of(component: Component, options: ExportOptions) -> tuple[dict[str, Any], list[str]]:
    """Return the layout, and lines for the user.

    Raises:
        OfflineError: something that a layout needs is missing.
    """
    field_m = field_size_m(options.field_m)
    family = _one_family(component, options.family)
    twice = sorted({tag.tag_id for tag in component.tags if tag.family == family and tag.instance})
    chosen = [tag for tag in component.tags if tag.family == family and not tag.instance]
    placed, said = layout_tags(component, chosen, options)
    said += check_places(component, placed, field_m)
    if twice:
        said.append(f"left out, since a layout has one pose per id: {', '.join(map(str, twice))}")
    tags = [{"ID": each.tag.tag_id, "pose": _wpilib_pose(each)} for each in placed]
    size = dict(zip(("length", "width"), field_m, strict=True))
    if options.layout_form is LayoutForm.FIELD_TAGS:
        # WPILib's Field has all of these; a map knows no season and no game.
        head = {"name": options.output.stem, "season": "", "game": ""}
        return head | {"field-dimensions": size, "program": "frc", "field-tags": tags}, said
    return {"tags": tags, "field": size}, said


def fmap_of(component: Component, options: ExportOptions) -> tuple[dict[str, Any], list[str]]:
    """Return the .fmap, and lines for the user.

    Raises:
        OfflineError: something that it needs is missing.
    """
    for tag in component.tags:
        if tag.family not in _LIMELIGHT_FAMILIES:
            known = ", ".join(_LIMELIGHT_FAMILIES)
            raise OfflineError(f"--format limelight: supports {known}, not {tag.family}; choose another format")
        if tag.size_m is None:
            raise OfflineError(
                f"--format limelight: needs the size of each tag, and the map has none of tag {tag.tag_id} "
                "(its positions were imported); import the log with --robot, or choose another format"
            )
    placed, said = layout_tags(component, component.tags, options)
    fiducials = [
        {
            "family": _LIMELIGHT_FAMILIES[each.tag.family],
            "id": each.tag.tag_id,
            "size": 1000.0 * (each.tag.size_m or 0.0),
            "transform": _row_major(each),
            "unique": 0 if each.tag.instance else 1,
        }
        for each in placed
    ]
    return {"type": "frc", "fiducials": fiducials}, said


def _one_family(component: Component, wanted: str | None) -> str:
    families = sorted({tag.family for tag in component.tags})
    if not families:
        raise OfflineError("--format frc: the map has no tags; choose another format")
    if wanted is None and len(families) == 1:
        return families[0]
    if wanted not in families:
        asked = "--format frc: a layout holds one family" if wanted is None else f"--family {wanted}: no tag is of it"
        raise OfflineError(f"{asked}, and the map's tags are of {', '.join(families)}; choose one with --family")
    return wanted


def _wpilib_pose(each: LayoutTag) -> dict[str, Any]:
    x_m, y_m = each.tag.position_m.tolist()
    x, y, z, w = each.R_map_tag.as_quat(canonical=True).tolist()
    return {
        "translation": {"x": x_m, "y": y_m, "z": each.z_m},
        "rotation": {"quaternion": {"W": w, "X": x, "Y": y, "Z": z}},
    }


def _row_major(each: LayoutTag) -> list[float]:
    x_m, y_m = each.tag.position_m.tolist()
    T_map_tag = np.eye(4)
    T_map_tag[:3, :3], T_map_tag[:3, 3] = each.R_map_tag.as_matrix(), (x_m, y_m, each.z_m)
    row_major: list[float] = T_map_tag.ravel().tolist()
    return row_major
