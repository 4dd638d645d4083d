"""The recorder's side of the page: a thread that starts its process, feeds it, and takes its commands.

The recording never waits for it: what is offered replaces what the page has not taken yet.
"""

import multiprocessing
import os
import socket
import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from typing import Final

from google.protobuf.message import Message

from groundsbot.calib.web import Endpoint
from groundsbot.onboard.detection import Detection
from groundsbot.onboard.errors import OnboardError
from groundsbot.onboard.log import LogHead, Picture, camera_topic
from groundsbot.onboard.monitoring import Status, rows
from groundsbot.onboard.page.child import serve_page
from groundsbot.onboard.page.messages import (
    MOST_REPORT_BYTES,
    Acknowledgement,
    Answer,
    Command,
    Notice,
    PageSettings,
    PageState,
    Report,
    Subscribed,
    ToPage,
    parse_report,
)
from groundsbot.onboard.page.preview import Preview
from groundsbot.onboard.page.viewer import PREVIEW_TOPIC, LiveMessage, live_message, serialise_head
from groundsbot.onboard.process import kill_child, signals_held_back

_PICTURE_PERIOD_S: Final = 0.2
_ANSWER_LIMIT_S: Final = 10.0
_START_LIMIT_S: Final = 60.0  # its priority is low
_POLL_S: Final = 1.0
_LIVE_S: Final = 0.005  # between two batches of messages for viewers; poses made from them are this much older
_MOST_LIVE_BYTES: Final = 8 << 20
_MOST_LIVE: Final = 4096
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 1.0, 60.0  # before its process is started again
_COMMANDS: Final = 10  # at once; one more each second
_END_LIMIT_S: Final = 1.0
_WATCHERS_POLL_S: Final = 0.05


class PageLink:
    """The page's process, which is started again if it ends or does not respond."""

    def __init__(
        self,
        endpoint: Endpoint | None,
        settings: PageSettings,
        on_command: Callable[[Command], str],
        on_notice: Callable[[str], None],
    ) -> None:
        """Start the thread, which starts the process.

        Args:
            endpoint: where the page is served; None: only viewers are.
            settings: settings of the process.
            on_command: called from the thread with each command; returns why it is refused, or an empty text.
            on_notice: called with a line each time that the process ended.
        """
        self._endpoint = endpoint
        self._settings = settings
        self._on_command = on_command
        self._on_notice = on_notice
        self._lock = threading.Lock()  # of what waits for the page
        self._state: PageState | None = None
        self._trouble = ""
        self._pictures: dict[str, tuple[Picture, Sequence[Detection]] | Preview] = {}  # by camera
        self._head: tuple[LiveMessage, ...] | None = None
        self._is_new, self._is_head_new = False, False
        self._messages = LiveMessages()
        self._topics: frozenset[str] = frozenset()
        self._watchers = 0
        self._next_picture_s = dict.fromkeys(settings.cameras, 0.0)
        self._sent_s: float | None = None  # when the page was sent what it has not taken yet
        self._batched_s = 0.0  # when messages for viewers were last taken
        self._n_commands, self._counted_s = 0.0, time.monotonic()
        self._process: SpawnProcess | None = None
        self._closing = threading.Event()
        self._woken, self._waking = os.pipe()
        for each in (self._woken, self._waking):
            os.set_blocking(each, False)
        self._thread = threading.Thread(target=self._work, name="page", daemon=True)
        self._thread.start()

    def offer_status(self, status: Status) -> None:
        """Offer the newest status of a recording; called from any thread."""
        self.offer_state(PageState(status.state, tuple(rows(status))))

    def offer_state(self, state: PageState) -> None:
        """Offer the newest state; called from any thread."""
        with self._lock:
            self._state, self._trouble, self._is_new = state, "", True
        self._wake()

    def report_trouble(self, text: str) -> None:
        """Have the page say why no run could be started."""
        with self._lock:
            self._trouble, self._is_new = text, True
        self._wake()

    def offer_head(self, head: LogHead, log_time_ns: int) -> None:
        """Offer the head of a run's log."""
        with self._lock:
            self._head, self._is_head_new = serialise_head(head, log_time_ns), True
        self._wake()

    def offer_message(self, topic: str, message: Message, log_time_ns: int) -> None:
        """Offer a message of the log; it is dropped unless a viewer is subscribed to its topic."""
        if topic in self._topics:
            with self._lock:
                is_first = self._messages.add(live_message(topic, message, log_time_ns))
            if is_first:
                self._wake()

    def offer_picture(self, picture: Picture, detections: Sequence[Detection], camera: str = "") -> None:
        """Offer a picture of a camera; it is dropped unless `wants_picture`."""
        if self.wants_picture(camera):
            self._offer((picture, detections), camera)

    def offer_preview(self, preview: Preview) -> None:
        """Offer a picture that is small already; see `wants_picture`."""
        self._offer(preview, "")

    def wants_picture(self, camera: str = "") -> bool:
        """Return whether a browser or viewer is there, the last picture was taken, and the camera's time has come.

        All cameras together have a picture each 0.2 s.
        """
        is_watched = self._watchers > 0 or camera_topic(PREVIEW_TOPIC, camera) in self._topics
        return is_watched and self._sent_s is None and time.monotonic() >= self._next_picture_s[camera]

    def _offer(self, picture: tuple[Picture, Sequence[Detection]] | Preview, camera: str) -> None:
        self._next_picture_s[camera] = time.monotonic() + _PICTURE_PERIOD_S * len(self._next_picture_s)
        with self._lock:
            self._pictures[camera], self._is_new = picture, True
        self._wake()

    def wait_for_watchers(self, limit_s: float) -> None:
        """Wait until no browser watches, as each leaves when it shows "done", but no longer than the limit."""
        end_s = time.monotonic() + limit_s
        while self._watchers and time.monotonic() < end_s:
            time.sleep(_WATCHERS_POLL_S)

    def close(self) -> None:
        """End the process and stop listening."""
        self._closing.set()
        self._wake()
        self._thread.join(_END_LIMIT_S)
        if self._process is not None:
            kill_child(self._process)
        self._thread.join(_END_LIMIT_S)
        if self._endpoint is not None:
            self._endpoint.listener.close()

    def _wake(self) -> None:
        with suppress(BlockingIOError):
            os.write(self._waking, b"\0")

    # --- in the thread

    def _work(self) -> None:
        pause_s = _FIRST_PAUSE_S
        while True:
            begun_s = time.monotonic()
            try:
                self._start_child()
                self._talk()
                reason = ""
            except (EOFError, ConnectionError):
                reason = "it ended"
            except Exception as error:  # an unexpected error must not end the page for good
                reason = str(error) or repr(error)
            self._end_child()
            if self._closing.is_set():
                return
            if time.monotonic() - begun_s > _LONGEST_PAUSE_S:
                pause_s = _FIRST_PAUSE_S
            self._on_notice(f"page: {reason}; its process is started again in {pause_s:g} s")
            self._closing.wait(pause_s)
            pause_s = min(2.0 * pause_s, _LONGEST_PAUSE_S)

    def _start_child(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._connection, theirs = context.Pipe()
        _limit_sending(self._connection, _ANSWER_LIMIT_S)
        self._process = context.Process(
            target=serve_page,
            args=(theirs, self._endpoint.listener if self._endpoint is not None else None, self._settings),
            name="groundsbot-page",
            daemon=True,
        )
        with signals_held_back():
            self._process.start()
        theirs.close()
        if not self._connection.poll(_START_LIMIT_S):
            raise OnboardError(f"its process did not start within {_START_LIMIT_S:g} s")
        self._sent_s = None
        with self._lock:
            self._is_new, self._is_head_new = self._state is not None, self._head is not None

    def _end_child(self) -> None:
        self._watchers, self._topics = 0, frozenset()
        self._connection.close()
        with suppress(ValueError, AttributeError, AssertionError):  # it was not started
            assert self._process is not None
            self._process.kill()
            self._process.join()
            self._process.close()

    def _talk(self) -> None:
        while not self._closing.is_set():
            ready = wait([self._connection, self._woken], _POLL_S)
            if self._woken in ready:
                os.read(self._woken, 4096)
            if self._connection in ready:
                self._take(parse_report(self._connection.recv_bytes(MOST_REPORT_BYTES)))
            if self._sent_s is None:
                self._send_newest()
            elif time.monotonic() - self._sent_s > _ANSWER_LIMIT_S:
                raise OnboardError(f"its process gave no answer for {_ANSWER_LIMIT_S:g} s")

    def _send_newest(self) -> None:
        if self._topics:
            time.sleep(max(0.0, self._batched_s + _LIVE_S - time.monotonic()))
            self._batched_s = time.monotonic()
        with self._lock:
            messages = self._messages.take()
            if not (self._is_new or self._is_head_new or messages):
                return
            head = self._head if self._is_head_new else None
            message = ToPage(self._state, self._trouble, self._pictures, head, messages)
            self._pictures, self._is_new, self._is_head_new = {}, False, False
        self._sent_s = time.monotonic()
        self._connection.send(message)

    def _take(self, report: Report) -> None:
        if isinstance(report, Notice):
            if not self._is_too_often():
                self._on_notice(report.text)
            return
        if isinstance(report, Subscribed):
            self._topics = frozenset(report.topics)
            return
        if isinstance(report, Acknowledgement):
            self._watchers = report.watchers
            if report.is_answer:
                self._sent_s = None
            return
        refusal = "too many commands: wait a second" if self._is_too_often() else self._on_command(report)
        self._connection.send(Answer(report.number, refusal))

    def _is_too_often(self) -> bool:
        now_s = time.monotonic()
        self._n_commands = max(0.0, self._n_commands - (now_s - self._counted_s))
        self._counted_s = now_s
        if self._n_commands > _COMMANDS - 1:
            return True
        self._n_commands += 1.0
        return False


class LiveMessages:
    """Messages that wait for the page: the newest ones, up to a limit of bytes. It is not thread-safe."""

    def __init__(self) -> None:
        self._waiting: deque[LiveMessage] = deque()
        self._n_bytes = 0

    def add(self, message: LiveMessage) -> bool:
        """Add a message, in place of the oldest ones if there is no room, and return whether it is the only one."""
        self._waiting.append(message)
        self._n_bytes += len(message.data)
        while self._n_bytes > _MOST_LIVE_BYTES or len(self._waiting) > _MOST_LIVE:
            self._n_bytes -= len(self._waiting.popleft().data)
        return len(self._waiting) == 1

    def take(self) -> tuple[LiveMessage, ...]:
        """Return all, and begin anew."""
        taken = tuple(self._waiting)
        self._waiting.clear()
        self._n_bytes = 0
        return taken


def _limit_sending(connection: Connection, limit_s: float) -> None:
    """Let `send` raise an OSError instead of waiting for longer, as for a process that is stopped."""
    with socket.socket(fileno=os.dup(connection.fileno())) as end:
        end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, struct.pack("ll", int(limit_s), 0))
