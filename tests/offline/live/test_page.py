"""The page of a map of drives under way: who gets it, and what a browser makes of it."""

import http.client
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.live.live_map import LiveMap, Update
from groundsbot.offline.live.page import LivePage, serve_page
from groundsbot.offline.maps.json_document import map_as_json
from tests.support.browser import Page

HINTS = ["b has observed 1 tag of a: 1 more joins them", "advice: go <b>back</b>"]


@pytest.fixture(scope="module")
def update(room: Path) -> Update:
    return LiveMap([room / "a", room / "b"], noise=NoiseParameters()).update()


@pytest.fixture
def page() -> Iterator[LivePage]:
    with serve_page(0) as served:
        yield served


def show(page: LivePage, update: Update, line: str = "2 under way") -> None:
    assert update.result is not None
    page.state.show(update, map_as_json(update.result), line, HINTS)


def ask(
    page: LivePage, path: str, *, method: str = "GET", token: str | None = None, host: str = "localhost"
) -> tuple[int, str]:
    address, own = page.url.removeprefix("http://").split("/?token=")
    connection = http.client.HTTPConnection("127.0.0.1", int(address.split(":")[1]), timeout=30.0)
    separator = "&" if "?" in path else "?"
    connection.request(method, f"{path}{separator}token={own if token is None else token}", headers={"Host": host})
    answer = connection.getresponse()
    text = answer.read().decode()
    connection.close()
    return answer.status, text


def test_the_state_has_line_hints_runs_and_figures(page: LivePage, update: Update) -> None:
    assert json.loads(ask(page, "/state")[1])["line"] == "No map yet."
    show(page, update)
    status, text = ask(page, "/state?after=0")
    state: dict[str, Any] = json.loads(text)
    assert (status, state["line"], state["hints"]) == (200, "2 under way", HINTS)
    assert [(run["name"], run["state"]) for run in state["runs"]] == [("a_seed3", "finished"), ("b_seed3", "finished")]
    assert sum(len(component["tags"]) for component in state["components"]) == 8
    assert ask(page, f"/state?after={state['number']}") == (204, "")
    show(page, update, "later")
    assert json.loads(ask(page, f"/state?after={state['number']}")[1])["line"] == "later"


@pytest.mark.parametrize(
    ("asked", "status"),
    [
        ({"path": "/state"}, 200),
        ({"path": "/state", "token": "wrong"}, 403),
        ({"path": "/state", "token": ""}, 403),
        ({"path": "/", "host": "evil.example"}, 403),
        ({"path": "/", "host": "evil.example:8000"}, 403),
        ({"path": "/../../etc/passwd"}, 404),
        ({"path": "/state/..%2f..%2fmap.json"}, 404),
        ({"path": "/state", "method": "POST"}, 405),
        ({"path": f"/state?after={'9' * 9000}"}, 200),
    ],
)
def test_only_the_page_itself_is_answered(page: LivePage, asked: dict[str, str], status: int) -> None:
    assert ask(page, **asked)[0] == status


def test_names_of_others_are_escaped(page: LivePage, update: Update) -> None:
    show(page, update, "\x1b[2J")
    assert json.loads(ask(page, "/state")[1])["line"] == r"\x1b[2J"
    assert "innerHTML" not in ask(page, "/")[1]


def test_a_port_in_use_is_refused(page: LivePage) -> None:
    port = page.url.split(":")[2].split("/")[0]
    with pytest.raises(OfflineError, match=f"^--page {port}: cannot be served there"), serve_page(int(port)):
        pass


def test_a_browser_draws_the_newest_map_and_says_when_it_is_alone(window: Page, update: Update) -> None:
    window.complaints.clear()
    with serve_page(0) as page:
        show(page, update)
        window.visit(page.url)
        window.wait_for("document.querySelectorAll('.plot.map .main-svg .trace').length > 4")
        assert window.look("document.getElementById('line').textContent") == "2 under way"
        assert window.look("[...document.querySelectorAll('#hints li')].map((each) => each.textContent)") == HINTS
        show(page, update, "later")
        window.wait_for("document.getElementById('line').textContent === 'later'")
        assert window.complaints == []
    window.wait_for("document.getElementById('line').textContent.startsWith('No answer')")
    window.visit("about:blank")
    window.complaints.clear()  # of requests without an answer
