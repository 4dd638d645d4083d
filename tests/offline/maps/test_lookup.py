"""Tags by their ids, runs by their names."""

from dataclasses import replace

import pytest

from groundsbot.offline.errors import UnknownNameError
from tests.support.data.maps import make_component, make_map

ASK = "name one of them, and ask its component if they are in several"


def test_a_tag_has_its_id_its_label_and_its_family() -> None:
    result = make_map()
    assert result.tag(7) is result.tag("7") is result.tag("tag36h11:7") is result.components[0].tags[1]
    assert result.components[0].tag("tag25h9:3") is result.tags[2]
    component = make_component()
    twins = tuple(replace(tag, tag_id=7, instance=name) for tag, name in zip(component.tags, "abc", strict=True))
    split = replace(component, tags=twins)
    assert split.tag("7b") is split.tags[1]
    assert split.tag("tag25h9:7") is split.tag("tag25h9:7c") is split.tags[2]


def test_a_run_has_its_name_and_its_robots() -> None:
    result = make_map()
    assert result.run("blue_two") is result.run("blue") is result.components[0].run("blue") is result.runs[1]


@pytest.mark.parametrize(
    ("name", "said"),
    [
        (9, "tag 9: is not in the map, which has 3, 7, 3"),
        (3, f"tag 3: 2 tags fit, tag36h11:3, tag25h9:3; {ASK}"),
    ],
)
def test_a_tag_that_is_not_there_or_not_alone_is_an_error_that_names_them(name: int, said: str) -> None:
    with pytest.raises(KeyError) as error:
        make_map().tag(name)
    assert str(error.value) == said


def test_a_run_that_is_not_there_or_not_alone_is_an_error_that_names_them() -> None:
    with pytest.raises(KeyError, match=r"^run green: is not in the map, which has red_one, blue_two$"):
        make_map().run("green")
    with pytest.raises(UnknownNameError, match=r"^run red: 2 runs fit, red_one, red_two; name one of them$"):
        make_map(make_component("red_one", "red_two")).run("red")
    many = make_component()
    many = replace(many, runs=tuple(replace(many.runs[0], name=f"r{i}") for i in range(60)))
    with pytest.raises(UnknownNameError, match=r", r49 and 10 more$"):
        many.run("x")
