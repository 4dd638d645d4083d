"""Heights and directions of tags: as measured, as in a map of corners, or as assumed.

A map of the floor estimates neither.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import atan2, isfinite
from pathlib import Path
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from groundsbot.offline.errors import OfflineError
from groundsbot.offline.export.options import ExportOptions
from groundsbot.offline.foundation import CsvTable, read_table
from groundsbot.offline.maps import Component, TagResult

_Key = tuple[str, int, str]

# Tag axes of layouts: x out of the face, y to the viewer's right, z up; of the map: z out of it, x to the right, y up.
_TO_LAYOUT: Final = Rotation.from_matrix([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])


@dataclass(frozen=True)
class LayoutTag:
    """Pose of a tag in space."""

    tag: TagResult
    z_m: float  # of its centre above the floor
    R_map_tag: Rotation  # of a tag frame with x out of the face, and z up if it is upright


@dataclass(frozen=True)
class _HeightAndYaw:
    """Height and yaw in a row of --tag-poses; None for empty cells."""

    z_m: float | None
    yaw_rad: float | None


def layout_tags(
    component: Component, tags: Sequence[TagResult], options: ExportOptions
) -> tuple[list[LayoutTag], list[str]]:
    """Return poses of some tags: from --tag-poses, else from the map, else by --tag-height-m and --face-viewers.

    If the map has a tag's tilt, a yaw from --tag-poses only rotates the tag about the vertical.

    Returns:
        The tags, and lines on what was assumed for how many.

    Raises:
        OfflineError: a tag's height or direction is not given, or --tag-poses cannot be read.
    """
    if options.tag_height_m is not None and not isfinite(options.tag_height_m):
        raise OfflineError(
            f"--tag-height-m {options.tag_height_m}: must be a finite number: the height of the tags' centres "
            "above the floor, in metres"
        )
    measured = {} if options.tag_poses is None else _read_tag_poses(options.tag_poses, component)
    viewed = _viewer_directions(component) if options.face_viewers else {}
    placed = []
    n_heights = n_directions = n_upright = 0
    for tag in tags:
        row = measured.get(_key(tag), _HeightAndYaw(None, None))
        known = _HeightAndYaw(None, None) if tag.pose is None else _HeightAndYaw(tag.pose.height_m, tag.pose.yaw_rad)
        z_m, yaw_rad = _or_default(row.z_m, known.z_m), _or_default(row.yaw_rad, known.yaw_rad)
        n_heights += z_m is None
        n_directions += yaw_rad is None
        n_upright += tag.pose is None
        z_m, yaw_rad = _or_default(z_m, options.tag_height_m), _or_default(yaw_rad, viewed.get(_key(tag)))
        if z_m is None or yaw_rad is None:
            raise OfflineError(_missing_value_text(tag, z_m, options))
        placed.append(LayoutTag(tag, z_m, _orientation(tag, yaw_rad)))
    said = [] if tags and not n_upright else ["treated as upright, with x out of the face"]
    if 0 < n_upright < len(placed):
        said = [f"treated as upright, with x out of the face: {n_upright} of {len(placed)} tags"]
    if n_heights:
        said.append(f"assumed: {n_heights} of {len(placed)} tags are {options.tag_height_m} m above the floor")
    if n_directions:
        said.append(
            f"assumed: {n_directions} of {len(placed)} tags face the mean direction of their observations; errors are "
            "tens of degrees"
        )
    return placed, said


def _or_default(value: float | None, otherwise: float | None) -> float | None:
    return otherwise if value is None else value


def _orientation(tag: TagResult, yaw_rad: float) -> Rotation:
    """Return R_map_tag in the axes of layouts for a yaw of the face, with the map's tilt."""
    if tag.pose is None:
        return Rotation.from_euler("z", yaw_rad)
    turn = Rotation.from_euler("z", yaw_rad - tag.pose.yaw_rad)
    return turn * Rotation.from_quat(tag.pose.quaternion_xyzw) * _TO_LAYOUT


def _missing_value_text(tag: TagResult, z_m: float | None, options: ExportOptions) -> str:
    what, column, instead = ("height", "z_m", "--tag-height-m") if z_m is None else ("direction", "yaw_rad", "")
    instead = instead or "--face-viewers (errors of tens of degrees)"
    return (
        f"--format {options.form}: the map does not hold the {what} of tag {tag.label} ({tag.family}); "
        f"fill in {column} in a copy of tags.csv for --tag-poses, or give {instead}"
    )


def _key(tag: TagResult) -> _Key:
    return tag.family, tag.tag_id, tag.instance


def _viewer_directions(component: Component) -> Mapping[_Key, float]:
    """Return the mean direction from each tag to the poses that observed it.

    Raises:
        OfflineError: the map holds no observations.
    """
    edges = component.edges
    if edges is None:
        raise OfflineError("--face-viewers: map.npz holds no graph, as an older version made it; make the map again")
    poses = np.concatenate([run.T_map_base for run in component.runs])
    found = {}
    for i, tag in enumerate(component.tags):
        towards = poses[edges.pose[edges.tag == i], :2] - tag.position_m
        towards /= np.maximum(np.linalg.norm(towards, axis=-1, keepdims=True), 1e-9)
        x, y = towards.sum(axis=0).tolist()
        found[_key(tag)] = atan2(y, x)
    return found


def _read_tag_poses(path: Path, component: Component) -> Mapping[_Key, _HeightAndYaw]:
    """Return rows by tag; `family` is optional if ids are unique, other columns are ignored."""
    table = read_table(path)
    for column in ("tag_id", "z_m", "yaw_rad"):
        if column not in table:
            raise OfflineError(f"{path}: has no column {column}; give a copy of the map's tags.csv, filled in")
    families = sorted({tag.family for tag in component.tags})
    if "family" not in table and len(families) > 1:
        raise OfflineError(f"{path}: has no column family, and the map has {', '.join(families)}; add it")
    ids = table.integers("tag_id", minimum=0)
    family = table.text("family") if "family" in table else (families or [""]) * len(table)
    instance = table.text("instance") if "instance" in table else [""] * len(table)
    rows: dict[_Key, _HeightAndYaw] = {}
    for i, key in enumerate(zip(family, ids, instance, strict=True)):
        if key in rows:
            table.fail(i, "tag_id", "is there twice; leave one out")
        rows[key] = _HeightAndYaw(_number(table, "z_m", i), _number(table, "yaw_rad", i))
    return rows


def _number(table: CsvTable, column: str, row: int) -> float | None:
    """Return a cell, None if empty."""
    text = table.text(column)[row]
    if not text:
        return None
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not isfinite(value):
        table.fail(row, column, "is not a number; write one such as 1.25, or leave the cell empty")
    return value
