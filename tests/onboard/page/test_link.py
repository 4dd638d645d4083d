"""The recorder's side of the page, with the page's real process."""

import http.client
import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np
import pytest

from groundsbot.calib.web.endpoint import open_page
from groundsbot.calib.web.page_address import PageAddress
from groundsbot.onboard.errors import OnboardError
from groundsbot.onboard.page import link as linking
from groundsbot.onboard.page.link import PageLink
from groundsbot.onboard.page.messages import (
    TOKEN_NAME,
    Acknowledgement,
    Command,
    Notice,
    PageSettings,
    PageState,
    Subscribed,
    parse_report,
    report_bytes,
)
from tests.support.devices.live_recording import PATIENCE_S, until
from tests.support.hostile.page_attacks import free_port


@contextmanager
def linked(notices: list[str], folder: Path) -> Iterator[PageLink]:
    endpoint = open_page(PageAddress("127.0.0.1", free_port()), folder / TOKEN_NAME, "robot", notices.append, qr=False)
    notices.clear()
    settings = PageSettings("gb1", endpoint.access("gb1"), None, None)
    with closing(PageLink(endpoint, settings, lambda _: "", notices.append)) as link:
        wait_for_page(endpoint.address.port)
        yield link


def pid_of(link: PageLink) -> int:
    assert link._process is not None
    assert link._process.pid is not None
    return link._process.pid


def wait_for_page(port: int) -> None:
    asking = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE_S)
    asking.request("GET", "/")
    assert asking.getresponse().status == 403
    asking.close()


def test_a_process_that_does_not_respond_is_replaced(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(linking, "_ANSWER_LIMIT_S", 1.0)
    notices: list[str] = []
    with linked(notices, tmp_path) as link:
        first = pid_of(link)
        os.kill(first, signal.SIGSTOP)
        link.report_trouble("no room")  # something to take
        until(lambda: len(notices) > 0, "a notice")
        assert notices[0] == "page: its process gave no answer for 1 s; its process is started again in 1 s"
        assert link._endpoint is not None
        wait_for_page(link._endpoint.address.port)


def test_a_recording_never_waits_for_the_page(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    notices: list[str] = []
    with linked(notices, tmp_path) as link:
        link._watchers = 1
        os.kill(pid_of(link), signal.SIGSTOP)
        picture = np.zeros((720, 1280, 3), np.uint8)
        begin_s = time.process_time()
        for _ in range(1000):
            link.offer_picture(picture, ())
            link.report_trouble("no room")
        assert time.process_time() - begin_s < 5.0  # a thousand pictures sent would be gigabytes
        assert notices == []


def test_the_process_stays_until_browsers_have_shown_the_last_state(tmp_path: Path) -> None:
    with linked([], tmp_path) as link:
        assert link._endpoint is not None
        asking = http.client.HTTPConnection("127.0.0.1", link._endpoint.address.port, timeout=PATIENCE_S)
        asking.request("GET", "/states", headers={"Cookie": f"groundsbot_gb1={link._endpoint.token}"})
        states = asking.getresponse()
        until(lambda: link._watchers == 1, "a watcher")
        link.offer_state(PageState("done", ()))
        waiting = threading.Thread(target=link.wait_for_watchers, args=(PATIENCE_S,))
        waiting.start()
        assert any(b'"done"' in line for line in iter(states.readline, b""))
        waiting.join(1.0)
        assert waiting.is_alive()
        states.close()
        asking.close()
        waiting.join(PATIENCE_S / 2.0)
        assert not waiting.is_alive()


@pytest.mark.parametrize(
    "data",
    [
        b"\x80\x05pickled",
        b"[]",
        b'["Command", "1", "note", "x"]',
        b'["Command", 1, "reboot", ""]',
        b'["Acknowledgement", 1, 2]',
        b'["Subscribed", ["/secret"]]',
        b'["Subscribed", [[]]]',
        b"[" * 5000,
    ],
)
def test_what_a_page_reports_is_checked(data: bytes) -> None:
    with pytest.raises(OnboardError, match=r"not a report|must be one of"):
        parse_report(data)


def test_reports_are_read_as_they_were_written() -> None:
    reports = (
        Command(3, "note", "door 3 closed"),
        Acknowledgement(True, 2),
        Subscribed(("/gyro", "/wheels")),
        Notice("busy"),
    )
    for report in reports:
        assert parse_report(report_bytes(report)) == report
