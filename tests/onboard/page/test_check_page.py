"""The page while the devices are checked, in a browser."""

import re
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest.mock import create_autospec

import pytest

from groundsbot.calib.web import Endpoint
from groundsbot.fixtures.recording.devices import PictureFolder, PtyPort
from groundsbot.onboard.monitoring.check import DeviceCheck
from groundsbot.onboard.page import checking
from groundsbot.onboard.page.link import PageLink
from groundsbot.onboard.wheels.protocol import WheelLine, format_line
from tests.onboard.page.test_in_browser import OUTLINE, ROWS
from tests.support.browser import Page
from tests.support.devices.live_recording import PATIENCE_S, repeat, robot_yaml, tag_jpeg
from tests.support.hostile.page_attacks import Site, free_port
from tests.support.programs import running

# Shorter than a person's patience.
PROGRAM = """
from groundsbot.onboard.cli import main
from groundsbot.onboard.monitoring import check, push_check
check._LISTEN_NS = 1_200_000_000
check._LOOK_NS = 200_000_000
push_check._STILL_NS = 500_000_000
main()
"""
STATE = "document.getElementById('state')?.textContent"
BUTTON = "document.getElementById('run')"


@contextmanager
def open_check(window: Page, robot: Path, wide: int, *options: str) -> Iterator[Site]:
    """A check whose page is open; it ends with the block by Ctrl-C."""
    arguments = ["check", "--robot", robot, "-o", robot.parent, "--listen-s", "0.5", "--page", free_port(), *options]
    with running([sys.executable, "-c", PROGRAM, *arguments]) as process:
        assert process.stdout is not None
        url = next(found[1] for line in process.stdout if (found := re.match(r"page: (\S+)", line)))
        window.visit(url, wide=wide, high=844, mobile=wide < 600)
        yield Site(url, "groundsbot_check", ("/",), "/", "", takes_commands=True)
        process.send_signal(signal.SIGINT)
        window.wait_for(f"{STATE} === 'done' && {BUTTON}.hidden")
        assert window.look("document.getElementById('lost').hidden")
        process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 130


def test_each_test_has_its_verdict_and_the_button_repeats_them(window: Page, tmp_path: Path) -> None:
    robot = robot_yaml(tmp_path, "{camera: pictures}")
    camera, picture = PictureFolder(tmp_path / "pictures", keep=20), tag_jpeg()
    with open_check(window, robot, 390) as site:
        window.wait_for(f"{STATE} === 'checked' && !{BUTTON}.disabled && {BUTTON}.textContent === 'Check again'")
        rows = window.look(ROWS)
        assert rows["now"] == "1 check failed: camera"
        assert rows["camera"].startswith("failed: camera")
        assert window.look("document.getElementById('picture').hidden && !document.getElementById('none').hidden")
        assert window.look("getComputedStyle(document.getElementById('note')).display") == "none"
        with repeat(lambda _: camera.show(picture), 10.0):
            window.look(f"{BUTTON}.click()")
            window.wait_for(f"{STATE} === 'checking' && {BUTTON}.disabled")
            window.wait_for(f"{STATE} === 'checked'")
        rows = window.look(ROWS)
        assert rows["now"] == "all checks passed"
        assert list(rows) == ["now", "camera", "detection", "clock", "disk", "sharpness"]
        assert rows["detection"].startswith("ok: tags in view: tag36h11 9;")
        window.wait_for(f"(([red, green, blue]) => green > 1.5 * Math.max(red, blue))({OUTLINE})")
        time.sleep(2.5)  # a picture of a recording would be old now
        assert window.look("document.getElementById('picture').className") == ""
        assert window.look("document.documentElement.scrollWidth") <= 390
        status, body = site.ask(
            "/command", "POST", b'{"command": "stop"}', Content_Type="application/json", Origin=site.url.split("/?")[0]
        )
        assert (status, body) == (409, b'{"error":"only a check can be started here"}')


def test_a_robot_yaml_that_was_broken_meanwhile_is_said(window: Page, tmp_path: Path) -> None:
    robot = robot_yaml(tmp_path, "{camera: pictures}")
    with open_check(window, robot, 1400):
        window.wait_for(f"{STATE} === 'checked'")
        robot.write_text("robot_id: [")
        window.look(f"{BUTTON}.click()")
        window.wait_for(f"{ROWS}['robot.yaml']?.startsWith('failed: ') && {STATE} === 'checked'")


def test_the_page_asks_for_pushes(window: Page, tmp_path: Path, plug_in: Callable[..., PtyPort]) -> None:
    port, ticks = plug_in(tmp_path / "wheels"), [0, 0]
    robot = robot_yaml(tmp_path, f"{{encoder_port: {tmp_path / 'wheels'}}}")

    def feed(index: int) -> None:
        now_us = time.monotonic_ns() // 1000 % 2**32
        port.send(format_line(WheelLine(3, index, now_us, ticks[0], ticks[1], 0)))

    with repeat(feed, 100.0), open_check(window, robot, 390, "--push"):
        for prompt, by in (
            ("Push the robot 1 m", (2000, 2010)),
            ("Now turn it on the spot to its left", (2000, -2000)),
        ):
            asks = f"{ROWS}.now?.startsWith('{prompt}')"
            window.wait_for(asks)
            while window.look(asks):  # the program may not listen yet when it asks
                ticks[:] = [before + more for before, more in zip(ticks, by, strict=True)]
                time.sleep(1.0)
        window.wait_for(f"{STATE} === 'checked'")
        rows = window.look(ROWS)
        assert "wiring" in rows, rows
        assert "encoders_exchanged: true" in rows["wiring"]
        assert rows["now"].startswith("2 checks failed: wiring, ticks")


def test_a_check_that_was_interrupted_has_not_passed(monkeypatch: pytest.MonkeyPatch) -> None:
    link = create_autospec(PageLink)
    monkeypatch.setattr(checking, "PageLink", lambda *_: link)
    page = checking.CheckPage(create_autospec(Endpoint), print)
    page.begin(None)
    page.add(DeviceCheck("disk", True, "9.0 GB free"))
    page.close()
    (state,) = link.offer_state.call_args.args
    assert (state.name, state.rows[0]) == ("done", ("now", "ended before all was checked", "bad"))
