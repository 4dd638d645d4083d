"""The newest status and picture, and the browsers that watch them."""

import asyncio
import itertools
import json
import threading
import time
from collections.abc import AsyncIterator, Sequence
from multiprocessing.connection import Connection
from typing import Final

from groundsbot.calib.foundation import printable
from groundsbot.onboard.errors import OnboardError
from groundsbot.onboard.page.messages import (
    Acknowledgement,
    Answer,
    Command,
    Notice,
    PageState,
    Report,
    Subscribed,
    ToPage,
    report_bytes,
)
from groundsbot.onboard.page.preview import FRESH_S, Preview
from groundsbot.onboard.page.viewer import LiveMessage, Viewer

MOST_WATCHERS: Final = 8
_MOST_COMMANDS: Final = 8  # without an answer
_KEEPALIVE_S: Final = 1.0  # a browser takes longer silence for a lost connection
_ANSWER_LIMIT_S: Final = 5.0
_RUN_STATES: Final = ("recording", "stopping", "stopped")
_ROW_ORDER: Final = {"wrong now": 0, "recorder": 2, "run": 2}  # of rows; 1 for all others

Row = tuple[str, str, str]  # label, text and rating of a line


class Hub:
    """State of the page. All but the reports is called in the event loop.

    Attributes:
        picture: the newest picture as JPEG, and its number; None before the first.
        battery_rows: label, text and rating for each battery, set from any thread.
    """

    def __init__(self, connection: Connection) -> None:
        self.picture: tuple[bytes, int] | None = None
        self.battery_rows: tuple[Row, ...] = ()
        self._connection = connection
        self._sending = threading.Lock()
        self._state: PageState | None = None
        self._trouble = ""
        self._preview: Preview | None = None
        self._previewed_s = 0.0
        self._viewer: Viewer | None = None
        self._head: Sequence[LiveMessage] | None = None
        self._watchers: set[asyncio.Event] = set()
        self._numbers = itertools.count(1)
        self._answers: dict[int, asyncio.Future[str]] = {}

    def register(self) -> asyncio.Event | None:
        """Return the event of one more browser that watches, for `states`; None if as many watch as may."""
        if len(self._watchers) >= MOST_WATCHERS:
            return None
        changed = asyncio.Event()
        self._watchers.add(changed)
        return changed

    def take(self, message: ToPage, preview: Preview | None) -> None:
        """Take the newest state from the recorder, and ask for more."""
        self._state, self._trouble = message.state, message.trouble
        if preview is not None:
            self.picture = preview.jpeg, self.picture[1] + 1 if self.picture else 1
            self._preview, self._previewed_s = preview, time.monotonic()
        for each in self._watchers:
            each.set()
        self._report(Acknowledgement(True, len(self._watchers)))

    def take_answer(self, answer: Answer) -> None:
        """Take the result of a command."""
        waiting = self._answers.get(answer.number)
        if waiting is not None and not waiting.done():
            waiting.set_result(answer.refusal)

    def report_watchers(self) -> None:
        """Report the number of browsers to the recorder; called from any thread."""
        self._report(Acknowledgement(False, len(self._watchers)))

    async def states(self, changed: asyncio.Event) -> AsyncIterator[str]:
        """Yield the state as JSON when it changes, and once a second, for a browser's event from `register`."""
        self.report_watchers()
        try:
            while True:
                yield self._state_json()
                try:
                    async with asyncio.timeout(_KEEPALIVE_S):
                        await changed.wait()
                except TimeoutError:
                    pass
                changed.clear()
        finally:
            self._watchers.discard(changed)
            self.report_watchers()

    async def command(self, act: str, text: str) -> str:
        """Have the recorder carry out a command, and return why it is refused, or an empty text.

        Raises:
            OnboardError: the recorder does not answer.
        """
        if len(self._answers) >= _MOST_COMMANDS:
            return "too many commands: wait a second"
        number = next(self._numbers)
        self._answers[number] = waiting = asyncio.get_running_loop().create_future()
        try:
            self._report(Command(number, act, text))  # type: ignore[arg-type] # checked by command_of
            async with asyncio.timeout(_ANSWER_LIMIT_S):
                return str(await waiting)
        except TimeoutError:
            raise OnboardError("the recorder does not answer") from None
        finally:
            del self._answers[number]

    def _state_json(self) -> str:
        now = self._state
        is_fresh = time.monotonic() - self._previewed_s < FRESH_S
        is_live = is_fresh and now is not None and now.name in ("recording", "capturing")
        preview = self._preview if is_live or (now is not None and now.keeps_picture) else None
        state = {
            "state": now.name if now is not None else "",
            "trouble": printable(self._trouble),
            "fresh": preview is not None,
            "picture": self.picture[1] if self.picture is not None else 0,
            "warnings": preview.warnings if preview is not None else (),
            "rows": [] if now is None else self._rows(now, preview),
        }
        return json.dumps(state)

    def _rows(self, now: PageState, preview: Preview | None) -> list[Row]:
        """Return label, text and rating of each line, problems first and what stays the same last."""
        found = [(each, printable(text), how) for each, text, how in now.rows]
        if preview is not None and preview.blur_px is not None:
            sharpness = "sharpness", f"tags' edges blurred by {preview.blur_px:.1f} px", ""
            _insert_after(found, "tags in view", [sharpness])
        if now.name in _RUN_STATES:
            _insert_after(found, "disk", self.battery_rows)
        return sorted(found, key=lambda row: _ROW_ORDER.get(row[0], 1))

    def set_viewer(self, viewer: Viewer) -> None:
        """Have viewers served, too; called from any thread."""
        with self._sending:
            self._viewer, head = viewer, self._head
        if head is not None:
            viewer.publish_head(head)

    def publish(self, head: Sequence[LiveMessage] | None, messages: Sequence[LiveMessage]) -> None:
        """Publish messages, and the head of a new run, to viewers; called from any thread."""
        with self._sending:
            self._head = head if head is not None else self._head
            viewer = self._viewer
        if viewer is not None:
            if head is not None:
                viewer.publish_head(head)
            viewer.publish(messages)

    def publish_preview(self, preview: Preview, camera: str) -> None:
        """Publish the page's picture of a camera to viewers; called from any thread."""
        if self._viewer is not None:
            self._viewer.publish_preview(preview.jpeg, time.time_ns(), camera)

    def report_notice(self, text: str) -> None:
        """Have the recorder print a line; called from any thread."""
        self._report(Notice(text))

    def report_topics(self, topics: frozenset[str]) -> None:
        """Report the topics that viewers are subscribed to; called from any thread."""
        self._report(Subscribed(tuple(sorted(topics))))

    def _report(self, report: Report) -> None:
        with self._sending:
            self._connection.send_bytes(report_bytes(report))


def _insert_after(rows: list[Row], label: str, more: Sequence[Row]) -> None:
    """Insert rows behind the one with a label, or at the end if there is none."""
    labels = [row[0] for row in rows]
    after = labels.index(label) + 1 if label in labels else len(labels)
    rows[after:after] = more
