"""The page in a browser, on a desk and on a phone, while a robot records."""

import os
import signal
from pathlib import Path
from typing import Any

import pytest

from groundsbot.onboard.log.messages import EventKind
from tests.onboard.page.conftest import Served, page_processes, serving
from tests.support.browser import Page
from tests.support.devices.live_recording import tag_jpeg

SHOWN = """document.getElementById('picture')?.naturalWidth > 0
  && document.getElementById('rows').textContent.includes('tag36h11 9')"""
# Green as the outlines of tags, at the middle of the tag's left side.
OUTLINE = """(() => {
  const picture = document.getElementById('picture'), canvas = document.createElement('canvas');
  canvas.width = picture.naturalWidth, canvas.height = picture.naturalHeight;
  if (!canvas.width) return [0, 0, 0, 0];
  const context = canvas.getContext('2d');
  context.drawImage(picture, 0, 0);
  return [...context.getImageData(51, 60, 1, 1).data];
})()"""
ROWS = """Object.fromEntries(
  [...document.querySelectorAll('dt')].map((each) => [each.textContent, each.nextSibling.textContent]))"""


@pytest.mark.parametrize(("wide", "high"), [(1200, 900), (390, 844)], ids=["desktop", "phone"])
def test_the_page_shows_the_picture_with_its_tags(window: Page, served: Served, wide: int, high: int) -> None:
    window.complaints.clear()
    window.requests.clear()
    window.visit(served.url, wide=wide, high=high, mobile=wide < 600)
    window.wait_for(SHOWN)
    window.wait_for(f"(([red, green, blue]) => green > 1.5 * Math.max(red, blue))({OUTLINE})")
    rows: dict[str, Any] = window.look(ROWS)
    assert rows["tags in view"] == "tag36h11 9"
    assert window.look("document.getElementById('state').textContent") == "recording"
    assert window.look("document.documentElement.scrollWidth") <= wide
    # The token does not stay in the address, and all that is loaded is the robot's own.
    assert "token" not in window.look("location.href")
    assert all(url.startswith((f"http://127.0.0.1:{served.site.port}/", "data:")) for url in window.requests)
    assert window.complaints == []


def test_a_note_with_elements_stays_text(window: Page, served: Served) -> None:
    assert served.order("note", "<img src=x onerror=document.title='owned'>")[0] == 200
    window.visit(served.url)
    window.wait_for("document.getElementById('rows')?.textContent.includes('onerror')")
    assert window.look("document.querySelectorAll('img').length") == 1
    assert window.look("document.title") == "gb1"


def test_values_and_pictures_change(window: Page, served: Served) -> None:
    window.visit(served.url)
    window.wait_for(SHOWN)
    before, source = window.look(ROWS), window.look("document.getElementById('picture').src")
    window.wait_for(f"{ROWS}.drive !== {before['drive']!r} && document.getElementById('picture').src !== {source!r}")


def test_a_lost_connection_is_shown_and_comes_back(window: Page, served: Served) -> None:
    window.visit(served.url)
    window.wait_for(SHOWN)
    alert = "document.getElementById('lost')"
    assert window.look(f"{alert}.hidden")
    (process,) = page_processes(served.process.pid)
    os.kill(process, signal.SIGSTOP)  # nothing comes, as without a network
    window.wait_for(f"!{alert}.hidden && document.getElementById('run').disabled")
    assert window.look(f"{alert}.textContent") == (
        "No connection to the robot. It goes on by itself; this page tries again."
    )
    os.kill(process, signal.SIGCONT)
    window.wait_for(f"{alert}.hidden && !document.getElementById('run').disabled")
    window.wait_for(SHOWN)
    window.complaints.clear()  # of requests that failed


def test_a_run_is_stopped_started_and_noted_from_a_phone(window: Page, tmp_path: Path) -> None:
    with serving(tmp_path, tag_jpeg()) as (served, _):
        window.visit(served.url, wide=390, high=844, mobile=True)
        window.wait_for(SHOWN)
        window.look(
            "document.getElementById('text').value = 'door 3 closed'; document.querySelector('form button').click()"
        )
        window.wait_for("document.getElementById('said').textContent === 'In the log: door 3 closed'")
        assert window.look("document.getElementById('text').value") == ""
        button = "document.getElementById('run')"
        window.stop_run()
        window.wait_for(f"{button}.textContent === 'Start a new run'")
        window.look(f"{button}.click()")
        window.wait_for(f"{button}.textContent === 'Stop this run'")
        served.end()
        events = served.events()
    assert [each.text for each in events if each.kind == EventKind.NOTE] == ["door 3 closed"]
    assert [each.kind for each in events].count(EventKind.RECORDING_STARTED) == 2
    window.visit("about:blank")
    window.complaints.clear()
