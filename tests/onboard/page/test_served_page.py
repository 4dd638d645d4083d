"""The page of a recording under way: what it shows, and what its commands do to the recording."""

import os
import re
import signal
from pathlib import Path

import numpy as np

from groundsbot.onboard.log.messages import Event, EventKind, WheelEncoders
from groundsbot.onboard.log.picture import decode
from groundsbot.onboard.log.reading.reader import find_logs, read_log
from tests.onboard.page.conftest import Served, page_processes, serving
from tests.support.devices.live_recording import tag_jpeg, until

GREEN_BGR = (60, 220, 60)


def test_the_state_has_rates_tags_and_progress(served: Served) -> None:
    state = served.wait_for_state(
        lambda state: any(row[0] == "tags in view" and "9" in row[1] for row in state["rows"])
    )
    assert state["state"] == "recording"
    rows = {label: (text, rating) for label, text, rating in state["rows"]}
    assert re.search(r"\d lines/s, the newest \d\.\d\d s old", rows["wheels"][0])
    assert rows["tags in view"][0] == "tag36h11 9"
    assert "1 tag seen, 0 seen again, loop open" in rows["drive"][0]
    assert re.fullmatch(r"tags' edges blurred by \d\.\d px", rows["sharpness"][0])
    assert state["warnings"] == []


def test_the_picture_has_the_outlines_of_its_tags(served: Served) -> None:
    status, jpeg = served.ask("/picture")
    assert status == 200
    picture = decode(jpeg)
    assert picture.shape == (120, 160, 3)
    off = np.abs(picture.astype(int) - GREEN_BGR).sum(axis=2)
    y, x = np.nonzero(off < 120)
    assert abs(x.min() - 50) < 4 and abs(x.max() - 110) < 4  # noqa: PT018 - the tag's corners
    assert abs(y.min() - 30) < 4 and abs(y.max() - 92) < 4  # noqa: PT018


def test_a_note_reaches_the_log(served: Served) -> None:
    assert served.order("note", "door 3\nclosed \x1b[2J") == (200, {})
    state = served.wait_for_state(lambda state: any(row[0] == "event" for row in state["rows"]))
    (shown,) = (text for label, text, _ in state["rows"] if label == "event" and "note" in text)
    assert "door 3 closed \\x1b[2J" in shown


def test_unusable_commands_are_refused_in_words(served: Served) -> None:
    assert served.order("note", " ") == (400, {"error": "a note has 0 characters; give 1 to 500"})
    assert served.order("note", "x" * 501) == (400, {"error": "a note has 501 characters; give 1 to 500"})
    assert served.order("start") == (409, {"error": "a run is being recorded"})
    assert served.order("reboot") == (400, {"error": "command must be one of start, stop, note"})


def test_runs_are_stopped_and_started(tmp_path: Path) -> None:
    with serving(tmp_path, tag_jpeg()) as (served, _):
        assert served.order("note", "first run")[0] == 200
        assert served.order("stop") == (200, {})
        served.wait_for_state(lambda state: state["state"] == "stopped")
        assert served.order("note", "too late") == (
            409,
            {"error": "no run is being recorded, so there is no log for the note"},
        )
        assert served.order("stop") == (409, {"error": "no run is being recorded"})
        assert served.order("start") == (200, {})
        served.wait_for_state(lambda state: state["state"] == "recording")
        until(lambda: served.order("note", "second run")[0] == 200, "a log for the note")
        said = served.end()
    assert served.process.returncode == 0
    assert "lost: " not in said
    notes = []
    for log in find_logs([served.logs]):
        messages = [each.message for each in read_log(log)]
        notes.append([each.text for each in messages if isinstance(each, Event) and each.kind == EventKind.NOTE])
        assert any(isinstance(each, WheelEncoders) for each in messages)
    assert sorted(notes) == [["first run"], ["second run"]]


def test_a_page_that_is_killed_is_started_again(tmp_path: Path) -> None:
    with serving(tmp_path, tag_jpeg()) as (served, _):
        served.wait_for_state(lambda state: state["picture"] > 0)
        (first,) = page_processes(served.process.pid)
        os.kill(first, signal.SIGKILL)
        until(lambda: any("page: it ended" in line for line in served.said), "a notice of its end")
        served.wait_for_state(lambda state: state["picture"] > 0)
        (second,) = page_processes(served.process.pid)
        assert second != first
        said = served.end()
    assert served.process.returncode == 0
    assert "lost: " not in said


def test_the_page_ends_with_the_recorder(tmp_path: Path) -> None:
    with serving(tmp_path, tag_jpeg()) as (served, _):
        served.wait_for_state(lambda state: state["picture"] > 0)
        (page,) = page_processes(served.process.pid)
        served.process.kill()
        until(lambda: not Path(f"/proc/{page}").exists(), "its end")
