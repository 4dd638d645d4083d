"""The page of a map of drives under way: who gets it, and what a browser makes of it."""

import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.calib.web.endpoint import open_page
from groundsbot.calib.web.page_address import PageAddress
from groundsbot.offline.live.live_map import LiveMap, Update
from groundsbot.offline.live.page import NewestState, serve_page
from groundsbot.offline.maps.json_document import map_as_json
from tests.support.browser import Page
from tests.support.hostile.page_attacks import PageAttacks, Site, in_threads

HINTS = ["b has observed 1 tag of a: 1 more joins them", "advice: go <b>back</b>"]


STARTS = """[...document.querySelectorAll('.plot.map')].flatMap((each) => each.data ?? [])
  .filter((each) => each.marker?.symbol === 'triangle-up').map((each) => [each.legendgroup, each.marker.color])"""


def _rgb(colour: str) -> tuple[int, ...]:
    return tuple(bytes.fromhex(colour.removeprefix("#")))


@pytest.fixture(scope="module")
def update(room: Path) -> Update:
    return LiveMap([room / "a", room / "b"], noise=NoiseParameters()).update()


class LivePage(NamedTuple):
    site: Site
    state: NewestState


@contextmanager
def serving(folder: Path) -> Iterator[LivePage]:
    endpoint = open_page(PageAddress("127.0.0.1", 0), folder / ".live_token", "laptop", lambda _: None, qr=False)
    (url,) = endpoint.urls()
    cookie = f"groundsbot_live_{endpoint.listener.getsockname()[1]}"
    with serve_page(endpoint) as state:
        yield LivePage(Site(url, cookie, ("/", "/plotly.js", "/state"), "/plotly.js", "'unsafe-inline'", False), state)


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LivePage]:
    with serving(tmp_path_factory.mktemp("page")) as served:
        yield served


@pytest.fixture
def site(page: LivePage) -> Site:
    return page.site


class TestPageOfAMap(PageAttacks):
    """What every page withstands."""


def show(page: LivePage, update: Update, line: str = "2 under way") -> None:
    assert update.result is not None
    page.state.show(update, map_as_json(update.result), line, HINTS)


def test_a_flood_is_bounded_and_the_page_goes_on(site: Site, capfd: pytest.CaptureFixture[str]) -> None:
    site.hold_connections(1000)
    before_mb = _resident_mb()
    grown_mb: list[float] = []
    site.read_nothing(50, lambda: grown_mb.append(_resident_mb() - before_mb))
    assert grown_mb[0] < 80.0  # the script for 50 clients is 230 MB
    in_threads(20, 1.0, lambda: site.ask("/state"))
    site.send_junk(100)
    assert site.ask("/state")[0] == 200
    assert capfd.readouterr() == ("", "")  # a line for each bad request would hide the others


def _resident_mb() -> float:
    (kb,) = re.findall(r"VmRSS:\s+(\d+) kB", Path("/proc/self/status").read_text())
    return int(kb) / 1000.0


def test_the_state_has_line_hints_runs_and_figures(tmp_path: Path, update: Update) -> None:
    with serving(tmp_path) as page:
        _check_states(page, update)


def _check_states(page: LivePage, update: Update) -> None:
    ask = page.site.ask
    assert json.loads(ask("/state")[1])["line"] == "No map yet."
    show(page, update)
    status, text = ask("/state?after=0")
    state: dict[str, Any] = json.loads(text)
    assert (status, state["line"], state["hints"]) == (200, "2 under way", HINTS)
    assert [(run["name"], run["state"]) for run in state["runs"]] == [("a_seed3", "finished"), ("b_seed3", "finished")]
    assert sum(len(component["tags"]) for component in state["components"]) == 8
    assert ask(f"/state?after={state['number']}") == (204, b"")
    show(page, update, "later")
    assert json.loads(ask(f"/state?after={state['number']}")[1])["line"] == "later"


def test_an_odd_number_is_none(site: Site) -> None:
    for after in ("9" * 9000, "-1", "x", "%00"):
        assert site.ask(f"/state?after={after}")[0] == 200


def test_names_of_others_are_escaped(page: LivePage, update: Update) -> None:
    show(page, update, "\x1b[2J")
    assert json.loads(page.site.ask("/state")[1])["line"] == r"\x1b[2J"
    assert b"innerHTML" not in page.site.ask("/")[1]


def test_a_browser_draws_the_newest_map_and_says_when_it_is_alone(window: Page, tmp_path: Path, update: Update) -> None:
    window.complaints.clear()
    with serving(tmp_path) as page:
        show(page, update)
        window.visit(page.site.url)
        window.wait_for("document.querySelectorAll('.plot.map .main-svg .trace').length > 4")
        assert window.look("document.getElementById('line').textContent") == "2 under way"
        assert window.look("[...document.querySelectorAll('#hints li')].map((each) => each.textContent)") == HINTS
        starts = dict(window.look(STARTS))
        runs = "[...document.querySelectorAll('#runs li')].map((each) => [each.textContent, each.style.borderColor])"
        shown = {text: tuple(map(int, re.findall(r"\d+", colour))) for text, colour in window.look(runs)}
        assert shown == {f"{run}_seed3: finished": _rgb(starts[f"{run}_seed3"]) for run in "ab"}
        show(page, update, "later")
        window.wait_for("document.getElementById('line').textContent === 'later'")
        assert "token" not in window.look("location.href")
        assert window.complaints == []
    window.wait_for("document.getElementById('line').textContent.startsWith('No answer')")
    window.visit("about:blank")
    window.complaints.clear()  # of requests without an answer
