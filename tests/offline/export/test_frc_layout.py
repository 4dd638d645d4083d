"""Layouts for FRC tools: poses of tags in space, by what was measured or assumed, never by invention."""

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from groundsbot.calib.geometry import se2
from groundsbot.offline.maps.files import write_map
from groundsbot.offline.maps.result import Component, GraphEdges, TagPose, TagResult
from groundsbot.offline.maps.shape import shape_of
from tests.support.data.maps import make_component, make_map
from tests.support.programs import Run

Export = Callable[..., tuple[dict[str, Any], list[str]]]
Refused = Callable[..., str]
FIELD = ("--field-m", "16.5,8.2")
ASSUMED = ("--tag-height-m", 1.25, "--face-viewers")


def of_one_family(tags: Sequence[TagResult]) -> tuple[TagResult, ...]:
    """In the field, counted from its corner."""
    shift = np.array([0.0, 3.0])
    return tuple(
        replace(tag, family="tag36h11", tag_id=i + 1, position_m=tag.position_m + shift) for i, tag in enumerate(tags)
    )


def view(component: Component) -> Component:
    """Each tag is seen from the starts of both runs."""
    n, m = component.runs[0].n_keyframes, len(component.tags)
    none = np.zeros(0, dtype=np.int64)
    edges = GraphEdges(
        first=none,
        motion=np.zeros((0, 3)),
        motion_information=np.zeros((0, 3, 3)),
        pose=np.tile([0, n], m),
        tag=np.repeat(np.arange(m), 2),
        place_m=np.zeros((2 * m, 2)),
        place_information=np.tile(np.eye(2), (2 * m, 1, 1)),
    )
    return replace(component, edges=edges)


@pytest.fixture
def component(tmp_path: Path) -> Component:
    made = view(make_component())
    made = replace(made, tags=of_one_family(made.tags))
    (tmp_path / "map").mkdir()
    write_map(make_map(made), tmp_path / "map")
    return made


@pytest.fixture
def export(run: Run, tmp_path: Path) -> Export:
    """What stands in the file, and what was said."""

    def call(form: str, *arguments: object) -> tuple[dict[str, Any], list[str]]:
        outcome = run("export", tmp_path / "map", "--format", form, "-o", tmp_path / "out.json", *arguments)
        assert outcome.code == 0, outcome.err
        data: dict[str, Any] = json.loads((tmp_path / "out.json").read_text())
        return data, outcome.out.splitlines()

    return call


@pytest.fixture
def refused(run: Run, tmp_path: Path) -> Refused:
    """The one line of a refusal that leaves nothing behind."""

    def call(form: str, *arguments: object) -> str:
        before = sorted(tmp_path.rglob("*"))
        outcome = run("export", tmp_path / "map", "--format", form, "-o", tmp_path / "out.json", *arguments)
        assert (outcome.code, outcome.out) == (1, "")
        assert outcome.err.count("\n") == 1
        assert sorted(tmp_path.rglob("*")) == before
        return outcome.err

    return call


def fill_in(folder: Path, rows: Sequence[tuple[str, str]]) -> Path:
    """The map's own tags.csv with z_m and yaw_rad, which stand in the fourth and fifth column."""
    header, *lines = (folder / "tags.csv").read_text().splitlines()
    cells = [line.split(",") for line in lines]
    for row, (z_m, yaw_rad) in zip(cells, rows, strict=True):
        row[3:5] = [z_m, yaw_rad]
    path = folder.parent / "measured.csv"
    path.write_text("\n".join([header, *(",".join(row) for row in cells)]) + "\n")
    return path


def test_wpilib_gets_its_layout(component: Component, export: Export, tmp_path: Path) -> None:
    yaws = (0.0, np.pi, -0.5 * np.pi)
    poses = fill_in(tmp_path / "map", [(f"{1.0 + i}", repr(yaw)) for i, yaw in enumerate(yaws)])
    layout, said = export("frc", *FIELD, "--tag-poses", poses)
    assert list(layout) == ["tags", "field"]
    assert layout["field"] == {"length": 16.5, "width": 8.2}
    for i, (entry, tag) in enumerate(zip(layout["tags"], component.tags, strict=True)):
        assert list(entry) == ["ID", "pose"]
        assert entry["ID"] == tag.tag_id
        place, turn = entry["pose"]["translation"], entry["pose"]["rotation"]["quaternion"]
        assert [place["x"], place["y"], place["z"]] == [*tag.position_m.tolist(), 1.0 + i]
        facing = Rotation.from_quat([turn["X"], turn["Y"], turn["Z"], turn["W"]]).apply([1.0, 0.0, 0.0])
        np.testing.assert_allclose(facing, [np.cos(yaws[i]), np.sin(yaws[i]), 0.0], atol=1e-12)
    assert not any("assumed" in line for line in said)


@pytest.mark.parametrize("arguments", [(), ("--layout-form", "tags"), ("--layout-form", "field-tags")])
def test_compare_reads_both_forms_back(
    component: Component, export: Export, run: Run, tmp_path: Path, arguments: tuple[str, ...]
) -> None:
    layout, _ = export("frc", *FIELD, *ASSUMED, *arguments)
    if "field-tags" in arguments:
        tags = layout.pop("field-tags")
        assert layout == {
            "name": "out",
            "season": "",
            "game": "",
            "field-dimensions": {"length": 16.5, "width": 8.2},
            "program": "frc",
        }
    else:
        tags = layout.pop("tags")
        assert layout == {"field": {"length": 16.5, "width": 8.2}}
    assert [entry["ID"] for entry in tags] == [tag.tag_id for tag in component.tags]
    outcome = run("compare", tmp_path / "map", "--survey", tmp_path / "out.json", "--json")
    assert outcome.code == 0, outcome.err
    errors = json.loads(outcome.out)
    assert [entry["verdict"] for entry in errors["entries"]] == 3 * ["fits"]
    np.testing.assert_allclose(errors["T_map_survey"], 0.0, atol=1e-9)
    assert errors["worst_m"] < 1e-9


def test_limelight_gets_its_fmap(component: Component, export: Export, tmp_path: Path) -> None:
    poses = fill_in(tmp_path / "map", [("1.5", "0.3")] * 3)
    fmap, _ = export("limelight", "--tag-poses", poses)
    assert fmap["type"] == "frc"
    for entry, tag in zip(fmap["fiducials"], component.tags, strict=True):
        assert (entry["family"], entry["id"], entry["unique"]) == ("apriltag3_36h11_classic", tag.tag_id, 1)
        assert entry["size"] == pytest.approx(150.0)
        matrix = np.reshape(entry["transform"], (4, 4))
        np.testing.assert_allclose(matrix[:3, :3], Rotation.from_euler("z", 0.3).as_matrix(), atol=1e-12)
        np.testing.assert_allclose(matrix[:, 3], [*tag.position_m, 1.5, 1.0])


def test_assumptions_are_those_requested_and_reported(component: Component, export: Export) -> None:
    layout, said = export("frc", *FIELD, *ASSUMED)
    starts = np.array([run.T_map_start[:2] for run in component.runs])
    for entry, tag in zip(layout["tags"], component.tags, strict=True):
        assert entry["pose"]["translation"]["z"] == 1.25
        towards = starts - tag.position_m
        x, y = (towards / np.linalg.norm(towards, axis=1, keepdims=True)).sum(axis=0)
        q = entry["pose"]["rotation"]["quaternion"]
        assert se2.wrap_angle(2.0 * np.arctan2(q["Z"], q["W"]) - np.arctan2(y, x)) == pytest.approx(0.0, abs=1e-12)
    assert "assumed: 3 of 3 tags are 1.25 m above the floor" in said
    assert any(line.startswith("assumed: 3 of 3 tags face the mean direction of their obs") for line in said)


def test_what_was_measured_wins_over_what_is_assumed(component: Component, export: Export, tmp_path: Path) -> None:
    poses = fill_in(tmp_path / "map", [("0.7", "0.3"), ("", "0.3"), ("", "")])
    layout, said = export("frc", *FIELD, "--tag-poses", poses, *ASSUMED)
    assert [entry["pose"]["translation"]["z"] for entry in layout["tags"]] == [0.7, 1.25, 1.25]
    assert "assumed: 2 of 3 tags are 1.25 m above the floor" in said
    assert any(line.startswith("assumed: 1 of 3 tags face") for line in said)


R_TILTED = Rotation.from_euler("ZYX", [0.4, 0.2, 0.1])  # of x out of the face, y to the viewer's right, z up


def place_tag(component: Component) -> Component:
    """Two of three tags with the pose that a map of corners has: its z out of the face, x to the right, y up."""
    right, up, out = R_TILTED.as_matrix()[:, [1, 2, 0]].T
    quaternion = Rotation.from_matrix(np.column_stack([right, up, out])).as_quat()
    pose = TagPose(1.7, quaternion, 1e-4 * np.eye(6))
    first, second, third = component.tags
    return replace(component, tags=(replace(first, pose=pose), replace(second, pose=pose), third))


def test_what_a_map_of_corners_holds_is_written_with_its_tilt(
    component: Component, export: Export, tmp_path: Path
) -> None:
    made = place_tag(component)
    write_map(make_map(made), tmp_path / "map")
    assert made.tags[0].pose is not None
    face = R_TILTED.apply([1.0, 0.0, 0.0])
    assert made.tags[0].pose.yaw_rad == pytest.approx(np.arctan2(face[1], face[0]))
    rows = [("", ""), ("0.7", repr(made.tags[0].pose.yaw_rad + 0.3)), ("0.9", "0.5")]
    layout, said = export("frc", *FIELD, "--tag-poses", fill_in(tmp_path / "map", rows))
    wanted = [(1.7, R_TILTED), (0.7, Rotation.from_euler("z", 0.3) * R_TILTED), (0.9, Rotation.from_euler("z", 0.5))]
    for entry, (z_m, rotation) in zip(layout["tags"], wanted, strict=True):
        assert entry["pose"]["translation"]["z"] == pytest.approx(z_m)
        q = entry["pose"]["rotation"]["quaternion"]
        turn = Rotation.from_quat([q["X"], q["Y"], q["Z"], q["W"]])
        assert (turn.inv() * rotation).magnitude() == pytest.approx(0.0, abs=1e-9)
    assert "treated as upright, with x out of the face: 1 of 3 tags" in said
    (tmp_path / "out.json").unlink()
    fmap, said = export("limelight", *ASSUMED)
    matrix = np.reshape(fmap["fiducials"][0]["transform"], (4, 4))
    np.testing.assert_allclose(matrix[:3, :3], R_TILTED.as_matrix(), atol=1e-9)
    assert matrix[2, 3] == pytest.approx(1.7)
    assert "assumed: 1 of 3 tags are 1.25 m above the floor" in said


T_FIELD_MAP = np.array([3.0, 7.0, -1.2])


def write_places(component: Component, path: Path, tags: Sequence[int], unit: float = 1.0) -> Path:
    """Places of some tags on the field, exact."""
    rows = ["tag_id,x_m,y_m"]
    for i in tags:
        x, y = (unit * se2.apply(T_FIELD_MAP, component.tags[i].position_m)).tolist()
        rows.append(f"{component.tags[i].tag_id},{x!r},{y!r}")
    path.write_text("\n".join(rows) + "\n")
    return path


def test_a_map_is_aligned_to_places_of_two_tags(
    component: Component, export: Export, refused: Refused, tmp_path: Path
) -> None:
    write_map(make_map(replace(place_tag(component), frame_run="blue_two")), tmp_path / "map")
    places = write_places(component, tmp_path / "places.csv", (0, 2))
    layout, said = export("frc", *FIELD, *ASSUMED, "--frame", places)
    assert not any(line.startswith("warning") for line in said)
    for entry, tag in zip(layout["tags"], component.tags, strict=True):
        place = entry["pose"]["translation"]
        np.testing.assert_allclose([place["x"], place["y"]], se2.apply(T_FIELD_MAP, tag.position_m), atol=1e-9)
    q = layout["tags"][0]["pose"]["rotation"]["quaternion"]
    turned = Rotation.from_euler("z", T_FIELD_MAP[2]) * R_TILTED
    assert (Rotation.from_quat([q["X"], q["Y"], q["Z"], q["W"]]).inv() * turned).magnitude() < 1e-9
    (tmp_path / "out.json").unlink()
    inches = write_places(component, tmp_path / "inches.csv", (0, 2), 1.0 / 0.0254)
    told = refused("frc", *FIELD, *ASSUMED, "--frame", inches)
    assert "relative to the survey's frame; check that --frame and --field-m are in metres" in told


def test_a_layout_in_the_frame_of_a_start_has_a_warning(component: Component, export: Export) -> None:
    _, said = export("frc", *FIELD, *ASSUMED)
    (warning,) = [line for line in said if line.startswith("warning")]
    assert "positions are relative to the start of red_one, not to a corner of the field; align the map" in warning


def test_a_tag_on_the_wall_may_be_as_far_outside_as_its_place_is_uncertain(
    component: Component, export: Export, refused: Refused
) -> None:
    shape = shape_of(component)
    assert shape is not None
    reach_m = 0.05 + 3.0 * float(shape.tag_sigmas_m[2])
    assert "1 of 3 tags lies outside, tag 3" in refused("frc", "--field-m", f"{8.999 - reach_m},8.2", *ASSUMED)
    export("frc", "--field-m", f"{9.001 - reach_m},8.2", *ASSUMED)


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("frc", *ASSUMED), "--field-m LENGTH,WIDTH"),
        (("frc", "--field-m", "16.5", *ASSUMED), "must be LENGTH,WIDTH"),
        (("frc", "--field-m", "16.5,-8", *ASSUMED), "must be above 0"),
        (("frc", "--field-m", "1650,820", *ASSUMED), "--field-m 1650,820: must be at most 50; give metres"),
        (("frc", *FIELD, "--tag-height-m", "125", "--face-viewers"), "tag 1 is 125 m high, must be at most 10"),
        (("frc", "--field-m", "5.5,8.2", *ASSUMED), "2 of 3 tags lie outside, tag 3 at x 9.00 m, y 8.00 m relative to"),
        (("limelight", "--frame", "1,4", *ASSUMED), "--frame 1,4: the map has no tag 4; name one of 1, 2, 3"),
        (("limelight", "--frame", "start:blue", *ASSUMED), "the logs hold no run 'blue'; use one of red_one, blue_two"),
        (("frc", *FIELD), "does not hold the height of tag 1 (tag36h11)"),
        (("limelight", "--tag-height-m", "1"), "does not hold the direction of tag 1 (tag36h11)"),
        (("frc", *FIELD, "--family", "tag16h5", *ASSUMED), "the map's tags are of tag36h11"),
        (("limelight", "--field-m", "1,2", *ASSUMED), "is not used by --format limelight"),
        (("limelight", "--layout-form", "tags", *ASSUMED), "--layout-form: is not used by --format limelight"),
    ],
)
def test_what_is_not_known_is_not_made_up(
    component: Component, refused: Refused, arguments: tuple[object, ...], named: str
) -> None:
    assert len(component.tags) == 3
    assert named in refused(str(arguments[0]), *arguments[1:])


def test_cells_that_are_no_numbers_are_named(component: Component, refused: Refused, tmp_path: Path) -> None:
    assert len(component.tags) == 3
    poses = fill_in(tmp_path / "map", [("1.0", "0.3"), ("high", "0.3"), ("1.0", "0.3")])
    assert "measured.csv line 3, column z_m: 'high' is not a number" in refused("frc", *FIELD, "--tag-poses", poses)


def test_an_id_in_two_places(component: Component, export: Export, tmp_path: Path) -> None:
    first, second, third = component.tags
    twice = (replace(first, tag_id=5, instance="a"), replace(second, tag_id=5, instance="b"), third)
    write_map(make_map(replace(component, tags=twice)), tmp_path / "map")
    layout, said = export("frc", *FIELD, *ASSUMED)
    assert [entry["ID"] for entry in layout["tags"]] == [3]
    assert "left out, since a layout has one pose per id: 5" in said
    (tmp_path / "out.json").unlink()
    fmap, _ = export("limelight", *ASSUMED)
    assert [(entry["id"], entry["unique"]) for entry in fmap["fiducials"]] == [(5, 0), (5, 0), (3, 1)]


def test_families_and_sizes(component: Component, export: Export, refused: Refused, tmp_path: Path) -> None:
    first, second, third = component.tags
    mixed = replace(component, tags=(first, second, replace(third, family="tag25h9")))
    write_map(make_map(mixed), tmp_path / "map")
    assert "holds one family, and the map's tags are of tag25h9, tag36h11" in refused("frc", *FIELD, *ASSUMED)
    assert "supports tag36h11, tag16h5, not tag25h9" in refused("limelight", *ASSUMED)
    layout, _ = export("frc", *FIELD, *ASSUMED, "--family", "tag36h11")
    assert [entry["ID"] for entry in layout["tags"]] == [1, 2]
    (tmp_path / "out.json").unlink()
    write_map(make_map(replace(component, tags=(first, replace(second, size_m=None), third))), tmp_path / "map")
    assert "the map has none of tag 2" in refused("limelight", *ASSUMED)
