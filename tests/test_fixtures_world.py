"""World files: the documented one, the packaged ones, and what is refused."""

import re
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from pydantic import BaseModel

from groundsbot.calib.foundation.yaml_file import LONGEST_TEXT
from groundsbot.fixtures.errors import FixturesError
from groundsbot.fixtures.worlds.world import World, load_world, parse_world, world_names

ROOT = Path(__file__).resolve().parent.parent
TINY = """
name: tiny
robots:
  - id: a
    robot: {wheels: {radius_left_m: 0.1, radius_right_m: 0.1, track_m: 0.4, ticks_per_turn: 4096}}
    route: {start: {x_m: 0.0, y_m: 0.0, yaw_deg: 0.0}, waypoints: [{x_m: 2.0, y_m: 0.0}]}
"""


def documented_world() -> str:
    found = re.search(r"```yaml\n(.*?)```", (ROOT / "docs" / "worlds.md").read_text(encoding="utf-8"), re.DOTALL)
    assert found is not None
    return found[1]


def test_the_documented_world_is_one_and_shows_the_true_defaults() -> None:
    world = parse_world(documented_world(), "docs/worlds.md")
    bare = parse_world(TINY, "tiny")
    for part in ("slips", "wheel_link", "pictures", "detection"):
        assert getattr(world, part) == getattr(bare, part), part
    np.testing.assert_allclose(list(world.noise.model_dump().values()), list(bare.noise.model_dump().values()))
    kept = {"start", "waypoints", "final_yaw_deg"}
    assert world.robots[0].route.model_dump(exclude=kept) == bare.robots[0].route.model_dump(exclude=kept)
    assert world.tags[0].model_dump(include={"family", "size_m"}) == world.tags[1].model_dump(
        include={"family", "size_m"}
    )


def test_every_field_is_documented() -> None:
    text = (ROOT / "docs" / "worlds.md").read_text(encoding="utf-8")

    def names(model: type[BaseModel]) -> set[str]:
        found = set(model.model_fields)
        for field in model.model_fields.values():
            for kind in (field.annotation, *get_args(field.annotation)):
                if isinstance(kind, type) and issubclass(kind, BaseModel):
                    found |= names(kind)
        return found

    assert [name for name in sorted(names(World)) if not re.search(rf"\b{name}\b", text)] == []


def test_a_world_may_be_longer_than_what_a_log_carries(tmp_path: Path) -> None:
    long = TINY + "# x\n" * (LONGEST_TEXT // 4)
    (tmp_path / "long.yaml").write_text(long, encoding="utf-8")
    assert parse_world(long, "long.yaml") == load_world(str(tmp_path / "long.yaml")) == parse_world(TINY, "tiny.yaml")


def test_a_file_that_can_be_no_world_is_refused_at_once() -> None:
    with pytest.raises(FixturesError, match=r"huge\.yaml: has \d+ characters, limit 4194304; is this the right file"):
        parse_world(TINY + "# x\n" * (1 << 20), "huge.yaml")


def test_packaged_worlds_load() -> None:
    assert {"nsh", "nsh_flat", "room"} <= set(world_names())
    for name in world_names():
        assert load_world(name).name == name


def test_base_gives_what_is_not_given_again(tmp_path: Path) -> None:
    (tmp_path / "first.yaml").write_text(TINY + "ceiling_height_m: 3.0\n")
    (tmp_path / "second.yaml").write_text("base: first\nname: second\nboxes: [{centre_m: [9, 9], size_m: [1, 1, 1]}]\n")
    world = load_world(tmp_path / "second.yaml")
    assert (world.name, world.ceiling_height_m, len(world.boxes)) == ("second", 3.0, 1)
    flat, full = load_world("nsh_flat"), load_world("nsh")
    assert flat.robots == full.robots
    assert {tag.tag_id for tag in flat.tags} == {tag.tag_id for tag in full.tags}


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (TINY.replace("x_m: 2.0", "x_m: far"), r"tiny: robots\[0\].route.waypoints\[0\].x_m is 'far' but must be"),
        (TINY + "wals: []\n", r"tiny: wals .*is not a field; did you mean walls\?"),
        (TINY + "pictures: {gamma: 0}\n", "tiny: pictures.gamma is 0 but must be greater than 0"),
        (TINY + "pictures: {rate_hz: 1001}\n", "pictures.rate_hz is 1001 but must be less than or equal to 1000"),
        (TINY + "wheel_link: {rate_hz: 1.0e+6}\n", "wheel_link.rate_hz is .* must be less than or equal to 10000"),
        (TINY + TINY.split("robots:\n")[1], r"id a is given twice"),
        (
            TINY + "tags:\n" + 2 * "- {tag_id: 5, position_m: [0, 0, 1], yaw_deg: 0}\n",
            "tiny: .*tags: tag_id 5 of tag36h11 is given 2 times",
        ),
        ("name: x\nbase: nowhere\n", "world nowhere: neither a file nor one of"),
    ],
)
def test_errors_name_file_field_and_value(text: str, expected: str) -> None:
    with pytest.raises(FixturesError, match=expected) as caught:
        parse_world(text, "tiny")
    assert "\n" not in str(caught.value)


def test_one_id_in_two_families_is_two_tags() -> None:
    place = "position_m: [0, 0, 1], yaw_deg: 0"
    world = parse_world(TINY + f"tags: [{{tag_id: 5, {place}}}, {{tag_id: 5, family: tag25h9, {place}}}]\n", "tiny")
    assert [tag.family for tag in world.tags] == ["tag36h11", "tag25h9"]


def test_a_base_that_leads_back_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text("base: b\n")
    (tmp_path / "b.yaml").write_text("base: a\n")
    with pytest.raises(FixturesError, match="leads back"):
        load_world(tmp_path / "a.yaml")


def test_a_tag_looks_where_its_yaw_says() -> None:
    world = parse_world(TINY + "tags: [{tag_id: 0, position_m: [0, 0, 1], yaw_deg: 90.0}]\n", "tiny")
    right, top, normal = world.tags[0].rotation().T
    # Who stands before it looks along -y: x is to the left, so the face's right is -x.
    np.testing.assert_allclose([right, top, normal], [[-1, 0, 0], [0, 0, 1], [0, 1, 0]], atol=1e-12)
    up = world.tags[0].model_copy(update={"pitch_deg": 90.0}).rotation()
    np.testing.assert_allclose(up[:, 2], [0, 0, 1], atol=1e-12)
    rolled = world.tags[0].model_copy(update={"roll_deg": 90.0}).rotation()
    np.testing.assert_allclose(rolled[:, 0], top, atol=1e-12)  # counter-clockwise: its right side goes up
