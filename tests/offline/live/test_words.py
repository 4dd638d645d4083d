"""What is missing in a map of drives under way, in words."""

from dataclasses import replace

import pytest

from groundsbot.offline.live.drives import RunState, State
from groundsbot.offline.live.live_map import Update
from groundsbot.offline.live.words import hints, missing_joins, update_line
from groundsbot.offline.maps.json_document import map_as_json
from groundsbot.offline.maps.result import Component
from tests.support.data.maps import make_component, make_map

HALLWAY, LOOP = make_component("hallway_one", "hall_two"), make_component("loop_one", "loop_two")


def with_tags(component: Component, ids: list[int]) -> Component:
    tags = (replace(tag, tag_id=tag_id) for tag, tag_id in zip(component.tags, ids, strict=True))
    return replace(component, tags=tuple(tags))


@pytest.mark.parametrize(
    ("ids", "said"),
    [
        ([90, 91, 92], "loop_one has observed no tag of hallway_one: 2 join them"),
        ([HALLWAY.tags[0].tag_id, 91, 92], "loop_one has observed 1 tag of hallway_one: 1 more joins them"),
    ],
)
def test_the_number_of_tags_that_would_join_two_components_is_said(ids: list[int], said: str) -> None:
    assert missing_joins(make_map(HALLWAY, with_tags(LOOP, ids))) == [said]


def test_where_shared_tags_do_not_join_components_the_maps_reason_is_given() -> None:
    result = make_map(HALLWAY, LOOP)
    assert missing_joins(result) == ["loop_one has observed 3 tags of hallway_one, which do not join them yet"]
    warned = replace(result, warnings=("component 2: the place of loop_one in hallway_one is ambiguous",))
    assert missing_joins(warned) == ["the place of loop_one in hallway_one is ambiguous"]


def test_parts_of_one_run_are_named_as_such() -> None:
    later = with_tags(make_component("hallway_one"), [90, 91, 92])
    assert missing_joins(make_map(HALLWAY, later)) == [
        "hallway_one has observed no tag of another part of it: 2 join them"
    ]


def test_nothing_is_missing_in_a_map_of_one_component() -> None:
    assert missing_joins(make_map()) == []


def test_advice_is_given_only_where_nothing_must_be_joined_first() -> None:
    joined, apart = make_map(), make_map(HALLWAY, with_tags(LOOP, [90, 91, 92]))
    update = Update((RunState("red_one", "under way"),), result=joined)
    (advice,) = hints(update, map_as_json(joined))
    assert advice.startswith("advice: One more pass ")
    document = map_as_json(joined)
    document["advice"] = [each | {"sigma_then_m": each["sigma_m"]} for each in document["advice"]]
    assert hints(update, document) == []  # what hardly helps
    assert len(hints(replace(update, result=apart), map_as_json(apart))) == 1


def test_runs_that_are_missing_and_troubles_are_named() -> None:
    runs = (RunState("/runs/a", "waiting", "/runs/a: no such log"), RunState("red_one", "away", "cannot be read"))
    update = Update(runs, trouble="the wheels are exchanged")
    assert hints(update, None) == [
        "/runs/a: no such log",
        "red_one: cannot be read",
        "warning: the wheels are exchanged",
    ]


def test_the_line_of_an_update_counts_runs_by_their_state() -> None:
    states: list[State] = ["waiting", "under way", "away", "finished", "finished"]
    runs = tuple(RunState(str(n), state) for n, state in enumerate(states))
    line = update_line(Update(runs), map_as_json(make_map()), 0.1, 1.0)
    assert line.startswith("1 under way, 2 finished, 1 away, 1 waiting, ")
    assert "3 tags in one map" in line
