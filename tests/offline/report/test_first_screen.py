"""What a person sees and does first: the verdict, the map, suspect tags, tables that show tags, fingers on a phone."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from groundsbot.offline.mapping.inputs import read_runs
from groundsbot.offline.mapping.pipeline import build_map
from groundsbot.offline.mapping.workings import Diagnostics
from groundsbot.offline.maps.fit_results import AlignmentResult, AlternativeResult, OutlierTag
from groundsbot.offline.maps.json_document import map_as_json
from groundsbot.offline.report.figures import figures
from groundsbot.offline.report.report import write_report
from groundsbot.offline.report.sentences import next_step
from groundsbot.offline.report.verdict import doubts, verdict_sentence
from tests.offline.report.conftest import Inside
from tests.support.browser import Page
from tests.support.data.drives import make_robot, write_drive
from tests.support.data.map_cases import DRIVES, TAGS
from tests.support.data.maps import make_map, suspect_entry
from tests.support.report_reader import Read

pytest.importorskip("plotly", reason="no plotly: `make setup` installs it; without it there is no report")

RED = "rgb(197, 34, 31)"
MAP = "document.querySelector('.plot.map')"
RANGE = f"{MAP}._fullLayout.xaxis.range"


def test_the_next_step_is_to_look_at_suspect_tags() -> None:
    document = map_as_json(make_map())
    (component,) = document["components"]
    suspects = [suspect_entry(8), suspect_entry(19)]
    places = [document["tags"][0] | {"tag_id": 8, "family": "f", "instance": each} for each in ("b", "a")]
    rest = "this needs no new drive, since the rest of the map does not depend on"
    several = document | {"suspect_tags": suspects, "tags": [*document["tags"], *places]}
    assert next_step(several) == (
        "See in the building where tags 8 and 19 are now. "
        "Use their places there, and none of their other places in the map "
        f"(by the logs' clocks, 8b is later than 8a); {rest} them."
    )
    unordered = several | {"suspect_tags": [each | {"has_ordered_places": False} for each in suspects]}
    assert f"in the map; {rest} them." in next_step(unordered)
    assert next_step(document | {"suspect_tags": suspects[:1]}) == (
        "See in the building where tag 8 is now. "
        f"Use its place there, and none of its other places in the map; {rest} it."
    )
    assert "join the components" in next_step(document | {"suspect_tags": suspects, "components": [component] * 2})


def test_the_verdict_follows_from_the_doubts() -> None:
    document = map_as_json(make_map()) | {"checks": [], "warnings": []}
    (component,) = document["components"]
    calm = "Use this map: nothing in it contradicts anything else by more than chance allows"
    assert verdict_sentence(document) == f"{calm}."

    def told(**changes: Any) -> str:
        return verdict_sentence(document | changes)

    few = [tag | {"n_observations": 2} for tag in document["tags"]]
    assert told(tags=few) == f"{calm}; 3 tags were observed fewer than 3 times."
    suspect = suspect_entry(3)
    care = "Use this map with care, because "
    assert told(suspect_tags=[suspect]) == f"{care}1 tag is suspect: 3 (moved)."
    weak = [document["alignments"][0] | {"is_weak": True}]
    assert told(suspect_tags=[suspect], alignments=weak) == (
        f"{care}1 alignment rests on one tag; and 1 tag is suspect."
    )
    metres = [document["metres"][0] | {"sigma": None}]
    assert told(warnings=["x", "y"]) == f"{calm}; it comes with 2 warnings."
    everything = {
        "suspect_tags": [suspect] * 2,
        "alignments": weak,
        "metres": metres,
        "losses": ["x"],
        "warnings": ["y"],
    }
    assert told(**everything).endswith("1 alignment rests on one tag; and there are 2 more doubts.")
    assert "nothing determines its scale" in told(**everything)
    assert [f"{doubt.n} {doubt.name}" for doubt in doubts(document | everything)] == [
        "1 data gap",
        "1 unknown scale",
        "1 weak alignment",
        "2 suspect tag",
        "1 warning",
    ]
    assert told(components=[component, component]).startswith(
        "Use each component of this map alone, with care, because its 2 components could not be joined, so distances "
        "between them are unknown"
    )
    assert told(losses=["a chunk"]) == f"{care}data of its logs were lost."
    assert told(components=[component | {"converged": False}], suspect_tags=[suspect]) == (
        "Do not use this map, because its solve did not converge."
    )
    assert told(tags=[]).startswith("Do not use this map, because it has no tags")


def test_the_map_fills_most_of_the_first_screen(window: Page, made: Path) -> None:
    read = Read((made / "report.html").read_text())
    links = [attributes["href"] for tag, attributes in read.elements if tag == "a"]
    ids = {f"#{attributes['id']}" for _, attributes in read.elements if attributes.get("id")}
    assert {"#map", "#summary", "#tags"} <= set(links) <= ids
    assert [tag for tag, _ in read.elements].count("dt") == 4
    window.open(made / "report.html", wide=1400, high=1000)
    assert window.look("document.querySelector('#verdict').getBoundingClientRect().bottom") < 100
    top, bottom = window.look(f"(({{top, bottom}}) => [top, bottom])({MAP}.getBoundingClientRect())")
    assert top < 320
    assert 960 < bottom <= 1000
    assert window.look("document.querySelector('#words').getBoundingClientRect().top") > bottom


@pytest.fixture(scope="module")
def doubtful(inside: Inside) -> Inside:
    """A map in which tag 3 was moved to where tag 2 is by the truth."""
    result, workings = inside
    (component,) = result.components
    *tags, old, new = component.tags
    places = (replace(old, tag_id=3, instance="a"), replace(new, instance="b"))
    evidence = "by 4.03 m (90 sigma) between runs"
    suspect = OutlierTag("tag36h11", 3, "moved", ("b_one",), evidence, has_ordered_places=True)
    changed = replace(component, tags=(*tags, *places))
    return replace(result, components=(changed,), outliers=(suspect,)), workings


@pytest.fixture(scope="module")
def page(doubtful: Inside, folder: Path) -> Path:
    write_report(*doubtful, folder / "doubtful.html")
    return folder / "doubtful.html"


def test_suspect_tags_are_red_with_an_arrow_to_the_new_place(window: Page, doubtful: Inside, page: Path) -> None:
    window.scheme("light")
    window.open(page)
    suspects = f"{MAP}.data.find((each) => each.name === 'suspect tags')"
    assert window.look(f"{suspects}.text") == ["3a (old)", "3b (new)"]
    red = window.look(f"getComputedStyle([...{MAP}.querySelectorAll('.trace')].at(-1).querySelector('.point')).fill")
    assert red == RED
    assert window.look(f"{suspects}.marker.symbol") == "x"  # for those who cannot tell red from the scale of sigmas
    old, new = (tag.position_m for tag in doubtful[0].components[0].tags[-2:])
    (arrow,) = window.look(f"{MAP}.layout.annotations.map(({{ax, ay, x, y, arrowhead}}) => [ax, ay, x, y, arrowhead])")
    assert arrow == pytest.approx([*old, *new, 2], abs=1e-3)
    assert window.look("document.querySelector('dl a').textContent") == "1 suspect tag: 3 (moved)"


def test_places_whose_order_is_unknown_are_neither_old_nor_new(window: Page, doubtful: Inside, folder: Path) -> None:
    result, workings = doubtful
    unordered = tuple(replace(each, has_ordered_places=False) for each in result.outliers)
    write_report(replace(result, outliers=unordered), workings, folder / "unordered.html")
    window.open(folder / "unordered.html")
    assert window.look(f"{MAP}.data.find((each) => each.name === 'suspect tags').text") == ["3a", "3b"]
    assert window.look(f"{MAP}.layout.annotations.map((each) => each.arrowhead)") == [0]


def test_uncertain_places_of_a_run_are_drawn(window: Page, logs: list[Path], tmp_path: Path) -> None:
    far = [replace(tag, tag_id=tag.tag_id + 50) for tag in TAGS]
    alone = write_drive(tmp_path / "logs", DRIVES["a"], far, make_robot("c"))
    workings = Diagnostics()
    result = build_map(read_runs([*logs, alone]), workings=workings)
    places = np.array([[1.0, 2.0, 0.0], [4.0, -3.0, np.pi / 2]])
    rival = AlternativeResult(places[1], (("tag36h11", 0),))
    for names, transforms in ((("a_one", "c_one"), places), (("c_one", "a_one"), np.array([[-1.0, -2.0, 0.0]]))):
        unsure = AlignmentResult(
            *names, transforms[0], 2, 2, 0.1, (), is_accepted=False, alternatives=(rival,) * (len(transforms) - 1)
        )
        document = map_as_json(replace(result, alignments=(*result.alignments, unsure)))
        first, second = figures(document, workings)["components"]
        assert second["rivals"] == []
        starts = [[run["x"][0], run["y"][0]] for run in first["rivals"]]
        assert np.array(starts) == pytest.approx(places[: len(transforms), :2], abs=1e-3)
        assert {run["run"] for run in first["rivals"]} == {"c_one"}
    unsure = AlignmentResult("a_one", "c_one", places[0], 2, 2, 0.1, (), is_accepted=False, alternatives=(rival,))
    write_report(replace(result, alignments=(unsure,)), workings, tmp_path / "report.html")
    window.open(tmp_path / "report.html")
    dotted = "each.line?.dash === 'dot' && each.name !== 'before merging'"
    names = window.look(f"{MAP}.data.filter((each) => {dotted}).map((each) => each.name)")
    assert names == ["c_one, 2 possible places"] * 2


def test_a_click_in_a_table_shows_the_tag(window: Page, doubtful: Inside, page: Path) -> None:
    window.open(page)
    tags = doubtful[0].components[0].tags
    picked = f"{MAP}.data.find((each) => each.name === 'chosen tag')"
    wide = window.look(f"{RANGE}[1] - {RANGE}[0]")

    def click(row: str, places: Any) -> None:
        window.look(f"document.querySelector('{row}').click()")
        window.wait_for(f"{picked}?.x.length === {len(places)} && scrollY < 600")
        assert pytest.approx(np.array(places), abs=1e-3) == np.array(window.look(f"[{picked}.x, {picked}.y]")).T

    click("#tags tbody tr:nth-child(2)", [tags[1].position_m])
    window.wait_for(f"{RANGE}[1] - {RANGE}[0] < {0.8 * wide}")
    low, high = window.look(RANGE)
    assert (low + high) / 2 == pytest.approx(tags[1].position_m[0], abs=0.1)
    click("#suspects tbody tr", [tag.position_m for tag in tags[-2:]])
    box = f"{MAP}.getBoundingClientRect()"
    assert window.look(f"{box}.top") >= 0
    assert window.look(f"{box}.bottom <= innerHeight")


# On a phone.


@pytest.fixture
def phone(window: Page, page: Path) -> Iterator[Page]:
    window.call("Emulation.setTouchEmulationEnabled", enabled=True, maxTouchPoints=2)
    window.open(page, wide=390, high=844, mobile=True)
    yield window
    window.call("Emulation.setTouchEmulationEnabled", enabled=False)


def touch(window: Page, kind: str, *points: tuple[float, float]) -> None:
    window.call("Input.dispatchTouchEvent", type=kind, touchPoints=[{"x": x, "y": y} for x, y in points])


def middle_of(window: Page, element: str) -> tuple[float, float]:
    window.look(f"{element}.scrollIntoView({{block: 'center', behavior: 'instant'}})")
    x, y = window.look(
        f"(({{x, y, width, height}}) => [x + width / 2, y + height / 2])({element}.getBoundingClientRect())"
    )
    return x, y


def test_two_fingers_zoom_the_map(phone: Page) -> None:
    x, y = middle_of(phone, MAP)
    before = phone.look(RANGE)
    shown = f"{MAP}._fullLayout.xaxis.p2d({x} - {MAP}.getBoundingClientRect().left - {MAP}._fullLayout.xaxis._offset)"
    at = phone.look(shown)
    touch(phone, "touchStart", (x - 40, y), (x + 40, y))
    for apart in (50, 60, 80):
        touch(phone, "touchMove", (x - apart, y), (x + apart, y))
    touch(phone, "touchEnd")
    phone.wait_for(f"{RANGE}[1] - {RANGE}[0] < {0.51 * (before[1] - before[0])}")
    assert phone.look(f"{RANGE}[1] - {RANGE}[0]") == pytest.approx((before[1] - before[0]) / 2, rel=0.01)
    assert phone.look(shown) == pytest.approx(at, abs=0.02 * (before[1] - before[0]))


@pytest.mark.parametrize("kind", ["timeline", "before"])
def test_a_finger_outside_the_map_scrolls(phone: Page, kind: str) -> None:
    x, y = middle_of(phone, f"document.querySelector('.plot.{kind}')")
    before = phone.look("scrollY")
    touch(phone, "touchStart", (x, y))
    for moved in range(20, 220, 20):
        touch(phone, "touchMove", (x, y - moved))
    touch(phone, "touchEnd")
    phone.wait_for(f"scrollY > {before + 100}")


def test_a_phone_has_room_beside_the_map_and_readable_tables(phone: Page) -> None:
    assert phone.look("document.documentElement.scrollWidth") == 390
    assert phone.look(f"{MAP}.getBoundingClientRect().height") <= 0.65 * 844
    assert phone.look("document.querySelectorAll('.plot .legend').length") == 0
    phone.look("document.querySelector('#tags .scroll').scrollLeft = 200")
    assert phone.look("document.querySelector('#tags .scroll').scrollLeft") == 200
    first = "document.querySelector('#tags td').getBoundingClientRect()"
    assert phone.look(f"{first}.left") == pytest.approx(
        phone.look("document.querySelector('#tags h2').offsetLeft"), abs=1
    )


@pytest.mark.parametrize("wide", [360, 390, 700])
def test_no_legend_covers_an_axis(window: Page, made: Path, wide: int) -> None:
    window.open(made / "report.html", wide=wide)
    legends = "document.querySelectorAll('.plot .legend').length"
    if wide <= 600:
        assert window.look(legends) == 0  # folded
        window.look("document.querySelector('button[data-value=shown]').click()")
        window.wait_for(f"{legends} === 2")
    for kind in ("map", "before"):
        top = window.look(f"document.querySelector('.plot.{kind} .legend').getBoundingClientRect().top")
        title = window.look(f"document.querySelector('.plot.{kind} .xtitle').getBoundingClientRect().bottom")
        ticks = window.look(
            f"Math.max(...[...document.querySelectorAll('.plot.{kind} .xtick')].map((tick) => "
            "tick.getBoundingClientRect().bottom))"
        )
        assert max(title, ticks) <= top, kind
    wide_text = "[...document.querySelectorAll('section td')].filter((cell) => cell.textContent.length > 40)"
    assert window.look(f"{wide_text}.every((cell) => cell.clientWidth >= 200)")
