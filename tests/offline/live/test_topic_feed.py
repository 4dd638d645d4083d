"""Live topics of a recorder as the source of a run: the same measurements as from its log."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from groundsbot.calib.web.page_address import PageAddress
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.live.topic_feed import TopicFeed
from groundsbot.offline.measurements.growing_run import GrowingRun
from groundsbot.offline.measurements.run import ALONE, load_run
from groundsbot.offline.measurements.run_messages import MEASURED_TOPICS
from groundsbot.onboard.log.messages import RunInfo
from groundsbot.onboard.log.reading.decoder import LogMessage
from groundsbot.onboard.log.reading.reader import find_logs, read_head, read_log
from groundsbot.onboard.page.viewer import LiveMessage, Viewer, live_message, serialise_head
from tests.support.devices.live_recording import until
from tests.support.hostile.page_attacks import free_port

pytest.importorskip("foxglove", reason="no foxglove-sdk: `make setup` installs it")


class Recorder:
    """The topics of a recorder, which are published when a test says so."""

    def __init__(self, port: int) -> None:
        self._topics: frozenset[str] = frozenset()
        self._viewer = Viewer(PageAddress("127.0.0.1", port), "gb1", ("",), self._take)

    def _take(self, topics: frozenset[str]) -> None:
        self._topics = topics

    def begin(self, log: Path) -> None:
        self._viewer.publish_head(serialise_head(read_head(log), 0))
        until(lambda: {"/wheels", "/tags/detections"} <= self._topics, "the subscription")

    def publish(self, messages: list[LiveMessage]) -> None:
        for each in messages:
            self._viewer.publish([each])

    def close(self) -> None:
        self._viewer._server.stop()


@contextmanager
def recorder(port: int) -> Iterator[Recorder]:
    served = Recorder(port)
    try:
        yield served
    finally:
        served.close()


def messages_of(log: Path) -> list[LogMessage]:
    return [each for each in read_log(log, ("/wheels", "/tags/detections")) if each.log_time_ns]


def test_the_measurements_are_those_of_the_log(room: Path) -> None:
    (log,) = find_logs([room / "c"])
    messages = messages_of(log)[:150]  # fewer than the server keeps for a client
    port, arrived = free_port(), threading.Event()
    growing = GrowingRun(TopicFeed(f"ws://127.0.0.1:{port}", MEASURED_TOPICS, arrived))
    with recorder(port) as served:
        served.begin(log)
        served.publish([live_message(each.topic, each.message, each.log_time_ns) for each in messages])
        until(lambda: _read(growing) >= len(messages), "the messages")
    found, whole = growing.measurements(ALONE), load_run(log)
    assert found.name == whole.name
    n = len(found.wheel_segments[0].stamps_ns)
    assert n > 50
    assert (found.wheel_segments[0].stamps_ns == whole.wheel_segments[0].stamps_ns[:n]).all()
    m = len(found.detections.corners_px)
    assert m > 0
    assert (found.detections.corners_px == whole.detections.corners_px[:m]).all()


def _read(growing: GrowingRun) -> int:
    with suppress(OfflineError):  # no connection yet
        growing.read()
    return growing.n_messages


def test_another_run_begins_anew(room: Path) -> None:
    port = free_port()
    growing = GrowingRun(TopicFeed(f"ws://127.0.0.1:{port}", MEASURED_TOPICS, threading.Event()))
    with recorder(port) as served:
        for robot in ("a", "c"):
            (log,) = find_logs([room / robot])
            served.begin(log)
            until(lambda: _read(growing) > 0 and _robot(growing) == robot, f"the run of {robot}")  # noqa: B023


def _robot(growing: GrowingRun) -> str:
    info = growing._collected.info
    return info.robot_id if isinstance(info, RunInfo) else ""


def test_a_recorder_that_is_not_there_or_goes_is_said_and_found_again(room: Path) -> None:
    (log,) = find_logs([room / "c"])
    port, arrived = free_port(), threading.Event()
    feed = TopicFeed(f"ws://127.0.0.1:{port}", MEASURED_TOPICS, arrived)
    assert arrived.wait(30.0)
    with pytest.raises(OfflineError, match=rf"127.0.0.1:{port}: no connection \(.*refused.*\); it is tried again"):
        feed.read()
    for _ in range(2):
        with recorder(port) as served:
            served.begin(log)
            until(lambda: any(isinstance(each.message, RunInfo) for each in feed.read() or []), "the head")
        until(lambda: _is_away(feed), "the end of the connection")


def _is_away(feed: TopicFeed) -> bool:
    try:
        feed.read()
    except OfflineError:
        return True
    return False


@pytest.mark.parametrize("url", ["http://robot:8765", "ws://robot", "ws://:1", "ws://robot:x", "ws://robot:1/path"])
def test_an_address_that_is_none_is_refused(url: str) -> None:
    with pytest.raises(OfflineError, match=r"give ws://HOST:PORT"):
        TopicFeed(url, MEASURED_TOPICS, threading.Event())
