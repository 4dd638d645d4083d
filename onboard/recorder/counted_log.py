"""A run's log that counts what was written and what was lost, and tells of it by events in the log."""

from collections import Counter
from collections.abc import Callable

from google.protobuf.message import Message

from groundsbot.onboard.errors import MessageRefusedError
from groundsbot.onboard.log import PICTURE_TOPIC, Event, EventKind, LogNote, RunLog, Severity


class CountedLog:
    """Writes messages and events.

    Attributes:
        counts: messages written, by topic.
        losses: what is missing from the log, by a word for it.
        newest_ns: when the newest message arrived, by topic.
    """

    def __init__(self, writer: RunLog, on_event: Callable[[Event], None] | None) -> None:
        """Takes an open log; `on_event` is told of each event as it is written."""
        self.counts: Counter[str] = Counter()
        self.losses: Counter[str] = Counter()
        self.newest_ns: dict[str, int] = {}
        self._writer = writer
        self._on_event = on_event

    def write(self, topic: str, message: Message, receive_ns: int, stamp_ns: int) -> None:
        """Writes one message, not before the log's newest time; one that the log refuses becomes an event."""
        log_time_ns = max(receive_ns, self._writer.last_log_time_ns)
        try:
            taken = self._writer.write(topic, message, log_time_ns, stamp_ns)
        except MessageRefusedError as error:
            self.refuse(str(error))
            return
        self.counts[topic] += taken
        self.newest_ns[topic] = receive_ns

    def event(self, kind: EventKind, severity: "Severity | int", text: str, host_ns: int, count: int = 0) -> None:
        """Writes one event."""
        message = Event(stamp_ns=host_ns, severity=Severity.Name(severity), kind=kind, text=text, count=count)
        self.write("/events", message, host_ns, host_ns)
        if self._on_event is not None:
            self._on_event(message)

    def refuse(self, reason: str) -> None:
        """Counts and tells of a message that cannot be written."""
        self.losses["messages refused"] += 1
        self.event(EventKind.MESSAGE_REFUSED, Severity.SEVERITY_ERROR, reason, self._writer.last_log_time_ns, 1)

    def report_notes(self, now_ns: int) -> None:
        """Writes what the log's disk has to say."""
        for note in self._writer.take_notes():
            self._count(note)
            self.event(note.kind, note.severity, note.text, now_ns, sum(note.lost.values()))

    def close(self) -> None:
        """Finishes the files."""
        self._writer.close()
        for note in self._writer.take_notes():  # too late for the log
            self._count(note)

    def _count(self, note: LogNote) -> None:
        for topic, count in note.lost.items():
            self.losses["pictures" if topic == PICTURE_TOPIC else topic] += count
