"""What is wrong with tags and readings is named as what it is, and nothing that is right is named."""

from collections.abc import Mapping
from typing import Final

import pytest

from groundsbot.offline.mapping.pipeline import build_map
from groundsbot.offline.maps.result import MapResult
from tests.offline.estimate.made_drives import NO_FAULT, PLACES, Fault, Truth, make_drive

SECONDS: Final = 90.0
TRUTHS: Final = {
    "a": Truth(distance=-0.02, turn_left=-0.02, mount=(0.1, 0.0, 0.03), delay_s=0.1, depth=1.0),
    "b": Truth(turn_right=0.03, mount=(0.0, 0.05, -0.02), delay_s=0.05, offset_m=0.03, depth=1.0),
    "c": Truth(distance=0.01, wheel_ratio=0.01, mount=(0.05, 0.0, 0.0), delay_s=0.12, depth=1.0),
}
MOVED: Final = {8: (PLACES[8][0] + 0.3, PLACES[8][1] - 0.4)}


def map_of(
    seed: int,
    moved: Mapping[str, Mapping[int, tuple[float, float]]] | None = None,
    faults: Mapping[str, Fault] | None = None,
) -> MapResult:
    """Of a drive of each robot, for which tags are elsewhere or something goes wrong."""
    drives = [
        make_drive(
            name, seed, SECONDS, truth, {**PLACES, **(moved or {}).get(name, {})}, (faults or {}).get(name, NO_FAULT)
        )
        for name, truth in TRUTHS.items()
    ]
    result = build_map([each.run for each in drives])
    assert len(result.components) == 1
    return result


def named(result: MapResult) -> list[tuple[int, str, tuple[str, ...]]]:
    return [(each.tag_id, each.kind, each.runs) for each in result.outliers]


@pytest.mark.parametrize("seed", range(2))
def test_clean_drives_name_nothing(seed: int) -> None:
    result = map_of(seed)
    assert named(result) == []
    assert [tag.label for tag in result.tags] == [str(tag_id) for tag_id in sorted(PLACES)]
    assert result.warnings == ()


@pytest.mark.parametrize("drives", [("c",), ("b", "c")])
def test_a_tag_moved_by_half_a_metre_is_named_where_it_is_elsewhere(drives: tuple[str, ...]) -> None:
    """Which of both places is the first is for the drives to say: of one and two, the one."""
    result = map_of(0, moved=dict.fromkeys(drives, MOVED))
    elsewhere = ("c_one",) if len(drives) == 1 else ("a_one",)
    assert named(result) == [(8, "moved", elsewhere)]
    assert float(result.outliers[0].evidence.split()[0]) == pytest.approx(0.5, abs=0.05)
    assert [tag.label for tag in result.tags if tag.tag_id == 8] == ["8a", "8b"]
    assert result.warnings == ()


def test_two_exchanged_tags_are_named_with_each_other() -> None:
    result = map_of(1, faults={"b": Fault(exchanged=(2, 8))})
    assert named(result) == [(2, "swapped", ("b_one",)), (8, "swapped", ("b_one",))]
    assert [each.swapped_with for each in result.outliers] == [8, 2]
    assert result.warnings == ()


@pytest.mark.parametrize(
    ("seed", "tag_id", "read_as", "first"), [(0, 9, 3, 5), (1, 9, 3, 0), (2, 9, 3, 5), (3, 8, 9, 20)]
)
def test_a_run_of_misread_readings_is_told_and_names_no_tag(seed: int, tag_id: int, read_as: int, first: int) -> None:
    result = map_of(seed, faults={"a": Fault(called=(tag_id, read_as, 20, first))})
    assert named(result) == []
    (told,) = result.warnings
    assert "have the id of another tag than the one that stands there" in told
    assert f"of {tag_id} as {read_as} in a_one" in told
    assert 5 <= int(told.split()[0]) <= 20
