"""Log of a run that counts messages written and lost, and writes events about them."""

from collections import Counter
from collections.abc import Callable, Mapping

from google.protobuf.message import Message

from groundsbot.onboard.errors import MessageRefusedError
from groundsbot.onboard.log import Event, EventKind, LogNote, RunLog, Severity, is_picture_topic, topic_of
from groundsbot.onboard.recorder.event_limits import EventLimits


class CountedLog:
    """Log with counts of its messages.

    Attributes:
        counts: number of messages accepted, by topic; those that wait for the disk included.
        losses: number of losses, by a description.
        newest_ns: arrival of the newest message, by topic.
    """

    def __init__(self, writer: RunLog, on_event: Callable[[Event], None] | None) -> None:
        """Wrap an open log; `on_event` is called with each event after it is written."""
        self.counts: Counter[str] = Counter()
        self.losses: Counter[str] = Counter()
        self.newest_ns: dict[str, int] = {}
        self._writer = writer
        self._on_event = on_event
        self._limits = EventLimits()

    @property
    def written(self) -> Mapping[str, int]:
        """Number of messages on the disk, by topic."""
        return self._writer.written

    def write(self, topic: str, message: Message, receive_ns: int, stamp_ns: int) -> None:
        """Write one message, with a log time not before the newest; a refused message becomes an event."""
        log_time_ns = max(receive_ns, self._writer.last_log_time_ns)
        try:
            taken = self._writer.write(topic, message, log_time_ns, stamp_ns)
        except MessageRefusedError as error:
            self.refuse(str(error))
            return
        self.counts[topic] += taken
        self.newest_ns[topic] = receive_ns

    def event(
        self, kind: EventKind, severity: "Severity | int", text: str, host_ns: int, count: int = 0, source: str = ""
    ) -> None:
        """Write an event, or count it for `report_excess` if there are too many of its kind and source, a camera."""
        if self._limits.allows(kind, severity, text, host_ns, count, source):
            self._write_event(kind, severity, text, host_ns, count)

    def report_excess(self, now_ns: int) -> None:
        """Write one event for each kind of which there were too many. Call it once per second."""
        for held in self._limits.take():
            text = f"{held.times} more such events, the last: {held.text}"
            self._write_event(held.kind, held.severity, text, now_ns, held.total or held.times)

    def _write_event(self, kind: EventKind, severity: "Severity | int", text: str, host_ns: int, count: int) -> None:
        message = Event(stamp_ns=host_ns, severity=Severity.Name(severity), kind=kind, text=text, count=count)
        self.write("/events", message, host_ns, host_ns)
        if self._on_event is not None:
            self._on_event(message)

    def refuse(self, reason: str) -> None:
        """Count a message that cannot be written, and write an event about it."""
        self.losses["messages refused"] += 1
        self.event(EventKind.MESSAGE_REFUSED, Severity.SEVERITY_ERROR, reason, self._writer.last_log_time_ns, 1)

    def report_notes(self, now_ns: int) -> None:
        """Write the notes of the log's writer as events."""
        for note in self._writer.take_notes():
            self._count(note)
            self.event(note.kind, note.severity, note.text, now_ns, sum(note.lost.values()))

    def close(self) -> None:
        """Finish the files."""
        self._writer.close()
        for note in self._writer.take_notes():  # the log is closed, so they are only counted
            self._count(note)

    def _count(self, note: LogNote) -> None:
        for topic, count in note.lost.items():
            self.losses[_what_of(topic)] += count


def pictures_of(camera: str) -> str:
    """Return how lost pictures of a camera are called; a single camera has an empty name."""
    return f"pictures of {camera}" if camera else "pictures"


def _what_of(topic: str) -> str:
    found = topic_of(topic)
    return pictures_of(found.camera) if found is not None and is_picture_topic(topic) else topic
