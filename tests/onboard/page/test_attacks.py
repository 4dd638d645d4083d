"""Who does not have the page's address gets nothing, and who floods it takes nothing from the recording.

The table of docs/robot_page.md lists these.
"""

import json
from collections.abc import Iterator
from contextlib import ExitStack, suppress

import pytest

from groundsbot.onboard.page.hub import MOST_WATCHERS
from tests.onboard.page.conftest import Served, page_processes, serving
from tests.support.devices.live_recording import tag_jpeg, until
from tests.support.hostile.page_attacks import PageAttacks, Site, in_threads


@pytest.fixture
def site(served: Served) -> Site:
    return served.site


class TestPageOfARecording(PageAttacks):
    """What every page withstands."""


def test_other_sites_give_no_commands(served: Served) -> None:
    refused = (403, {"error": "commands come from the page itself only"})
    assert served.order("note", "x", Origin="http://evil.example") == refused
    assert served.order("note", "x", Origin="null") == refused
    assert served.order("note", "x", Content_Type="text/plain") == refused
    assert served.order("note", "x", Sec_Fetch_Site="cross-site") == refused
    status, body = served.ask("/command", "POST", b"{}", Content_Type="application/json")  # without an origin
    assert (status, json.loads(body)) == refused


@pytest.mark.parametrize("body", [b"", b"[]", b"{", b"[" * 4000, b'{"command": 1}', b'{"command": ["note"]}', b"\xff"])
def test_a_body_that_is_no_command_is_refused(served: Served, body: bytes) -> None:
    own = {"Content_Type": "application/json", "Origin": f"http://127.0.0.1:{served.site.port}"}
    status, answer = served.ask("/command", "POST", body, **own)
    assert status == 400
    assert "error" in json.loads(answer)


def test_there_are_only_so_many_browsers(served: Served) -> None:
    with ExitStack() as stack:
        for _ in range(MOST_WATCHERS):
            next(stack.enter_context(served.watching()))
        status, body = served.ask("/states")
        assert (status, json.loads(body)) == (503, {"error": f"{MOST_WATCHERS} browsers watch already"})
    until(lambda: _can_watch(served), "room for one more")


def _can_watch(served: Served) -> bool:
    with suppress(AssertionError), served.watching() as states:
        return next(states) is not None
    return False


@pytest.fixture(scope="module")
def flooded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Served, list[int]]]:
    """A recording whose page is flooded, and the line numbers that its wheels sent in vain."""
    with serving(tmp_path_factory.mktemp("flooded"), tag_jpeg()) as (served, driver):
        served.wait_for_state(lambda state: state["picture"] > 0)
        (before,) = page_processes(served.process.pid)
        served.site.hold_connections(1000)
        served.site.read_nothing(50)
        in_threads(50, 3.0, lambda: (served.ask("/picture"), served.order("note", "flood")))
        served.site.send_junk(500)
        served.wait_for_state(lambda state: state["state"] == "recording")
        assert page_processes(served.process.pid) == [before]
        served.end()
        yield served, driver.refused


def test_a_flood_takes_nothing_from_the_recording(flooded: tuple[Served, list[int]]) -> None:
    served, refused = flooded
    assert served.process.returncode == 0
    assert "lost: " not in "".join(served.said)
    assert refused == []
    assert len(served.said) < 60  # a line for each bad request would fill the journal


def test_a_flood_of_notes_is_limited(flooded: tuple[Served, list[int]]) -> None:
    served, _ = flooded
    notes = [each.text for each in served.events() if each.kind == "note"]
    assert 10 <= len(notes) < 40  # ten at once, and one more each second
