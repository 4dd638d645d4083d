"""Writer of the log of a run: MCAP files that can each be read alone, with the same bytes for the same messages."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Final, NamedTuple, Protocol

from google.protobuf.message import Message

from groundsbot.onboard.errors import LogError, MessageRefusedError
from groundsbot.onboard.log.messages import (
    TOPICS,
    EventKind,
    LogHead,
    Severity,
    camera_names_in,
    head_messages,
    is_picture_topic,
    topic_of,
    topics_of_cameras,
)
from groundsbot.onboard.log.writing.file import Record
from groundsbot.onboard.log.writing.segments import (
    LogSegments,
    SegmentLimits,
    files_of_run,
    is_unfinished,
    single_file,
)
from groundsbot.onboard.log.writing.storage import Disk, Storage

_FLUSH_PERIOD_NS: Final = 500_000_000  # in log time; older messages are in the file
_TIME_LIMIT_NS: Final = 1 << 63
_KNOWN: Final = f"a log holds {', '.join(TOPICS)}"
LARGEST_MESSAGE_BYTES: Final = 32 << 20  # readers refuse chunks above twice this


class LogNote(NamedTuple):
    """A note of a writer for the log's `/events`."""

    kind: EventKind
    severity: "Severity | int"
    text: str
    lost: Mapping[str, int]  # number of lost messages, by topic


class RunLog(Protocol):
    """Log of a recorder."""

    @property
    def last_log_time_ns(self) -> int:
        """Log time of the newest message."""

    @property
    def written(self) -> Mapping[str, int]:
        """Number of messages on the disk, by topic, without the heads of files."""

    def write(self, topic: str, message: Message, log_time_ns: int, publish_time_ns: int) -> bool:
        """Accept one message, or return False if there is no space for it; a note follows."""

    def take_notes(self) -> Sequence[LogNote]:
        """Return the notes since the last call."""

    def close(self) -> None:
        """Finish the files. A second call does nothing."""


class LogWriter:
    """Write the messages of one run to MCAP files, in the caller's thread.

    Messages are to be written in order of log time. They are buffered: a message is in the file, and on the disk if
    `durable`, once a message with a log time half a second later has been written. A crash loses the rest.
    """

    def __init__(
        self,
        path: Path,
        head: LogHead,
        start_ns: int,
        *,
        keep_pictures: bool = False,
        durable: bool = True,
        limits: SegmentLimits | None = None,
        storage: Storage | None = None,
    ) -> None:
        """Open the files and write their heads.

        Args:
            path: a run folder, made if missing, for `0000.core.mcap` and, with `keep_pictures`, `0000.camera.mcap`; or
                one file, whose name ends in `.mcap`, for all topics.
            head: messages repeated at the beginning of every file, by topic, so that each file can be read alone:
                `/run`, and calibration and mount of each camera if known. The cameras whose calibration it has by name
                are those of which messages can be written.
            start_ns: log time of the head, on the run's clock.
            keep_pictures: whether pictures will be written.
            durable: call fsync at every flush. Simulators that write thousands of logs switch it off.
            limits: duration and size after which new files, `0001.core.mcap` and so on, begin; None: no limits.
            storage: file system to write to; None: the computer's.

        Raises:
            LogError: the head has no `/run`, a file exists already, or a file cannot be written.
        """
        self._path = path
        self._last_ns = self._flushed_ns = start_ns
        self._keeps_pictures = keep_pictures or path.suffix == ".mcap"
        store = storage or Disk(durable)
        cameras = camera_names_in(head)
        self._topics = frozenset(topics_of_cameras(cameras))
        if path.suffix == ".mcap":
            files = single_file(store, path, cameras)
        else:
            files = files_of_run(store, path, cameras, keep_pictures)
        self._segments = LogSegments(store, files, head_records(path, head, start_ns), limits)
        with self._report_errors():
            try:
                self._segments.open(start_ns)
                self._segments.sync()
            except OSError:
                self._segments.discard()
                raise

    def write(self, topic: str, message: Message, log_time_ns: int, publish_time_ns: int) -> bool:
        """Append one message.

        Args:
            topic: one of `groundsbot.onboard.log.messages.TOPICS`, or of a camera that the head names.
            message: a message of the topic's schema.
            log_time_ns: time of reception on the run's clock, not before that of the last message.
            publish_time_ns: best estimate of the time of measurement, on the run's clock.

        Returns:
            Always True.

        Raises:
            MessageRefusedError: a time is out of range or the message is too large. The log stays valid.
            LogError: the topic is unknown, the schema is another, the log time decreases, or the disk fails.
        """
        record = checked_record(topic, message, log_time_ns, publish_time_ns, self._last_ns)
        if topic not in self._topics:
            raise LogError(f"{topic}: this log's head has no calibration of that camera; give it one")
        if not self._keeps_pictures and is_picture_topic(topic):
            raise LogError(f"{topic}: this log keeps no pictures; open it with keep_pictures")
        self._last_ns = log_time_ns
        with self._report_errors():
            self._segments.append(record)
            if log_time_ns - self._flushed_ns >= _FLUSH_PERIOD_NS:
                self._flush()
        return True

    @property
    def last_log_time_ns(self) -> int:
        """Log time of the newest message."""
        return self._last_ns

    @property
    def written(self) -> Mapping[str, int]:
        """Number of messages in the files, by topic, without the heads."""
        return self._segments.written

    def take_notes(self) -> Sequence[LogNote]:
        """Return no notes, as errors are raised."""
        return ()

    def flush(self) -> None:
        """Write all messages so far to the files."""
        with self._report_errors():
            self._flush()

    def close(self) -> None:
        """Finish the files and rename them. A second call does nothing."""
        with self._report_errors():
            self._segments.finish()

    def discard(self) -> None:
        """Remove the unfinished files of a log that is given up."""
        self._segments.discard()

    def __enter__(self) -> "LogWriter":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _flush(self) -> None:
        self._flushed_ns = self._last_ns
        self._segments.commit()
        self._segments.sync()
        while self._segments.has_full:
            self._segments.finish_a_full_one()

    @contextmanager
    def _report_errors(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise describe_os_error(self._path, error) from error


LogOpener = Callable[[Path, LogHead, int, bool], RunLog]


def head_records(path: Path, head: LogHead, start_ns: int) -> list[Record]:
    """Return the records at the head of every file of a log.

    Raises:
        LogError: `/run` is missing, a topic is unknown, or a message has another schema than its topic's.
    """
    if "/run" not in head:
        raise LogError(f"{path}: a log cannot start without /run; give a RunInfo in its head")
    unknown = head.keys() - topics_of_cameras(camera_names_in(head))
    if unknown:
        raise LogError(f"{path}: a head cannot have {min(unknown)}, as {_KNOWN}")
    return [checked_record(name, message, start_ns, start_ns, start_ns) for name, message in head_messages(head)]


def checked_record(topic: str, message: Message, log_time_ns: int, publish_time_ns: int, last_ns: int) -> Record:
    """Check and serialise one message before it reaches a chunk, which a later failure would corrupt.

    Raises:
        MessageRefusedError: a time is out of range or the message is too large.
        LogError: the topic is unknown, the schema is another, or the log time is before `last_ns`.
    """
    known = topic_of(topic)
    if known is None:
        raise LogError(f"{topic}: no such topic; {_KNOWN}")
    if not isinstance(message, known.schema):
        raise LogError(f"{topic}: holds {known.schema.DESCRIPTOR.full_name}, not {message.DESCRIPTOR.full_name}")
    for name, value in (("log_time_ns", log_time_ns), ("publish_time_ns", publish_time_ns)):
        if not 0 <= value < _TIME_LIMIT_NS:
            raise MessageRefusedError(f"{topic}: {name} is {value}, must lie in 0 to 2^63 - 1; message refused")
    if log_time_ns < last_ns:
        raise LogError(f"{topic}: log_time_ns {log_time_ns} lies before the last message's {last_ns}; sort first")
    data = message.SerializeToString(deterministic=True)
    if len(data) > LARGEST_MESSAGE_BYTES:
        raise MessageRefusedError(f"{topic}: {len(data)} bytes, at most {LARGEST_MESSAGE_BYTES}; message refused")
    return Record(topic, data, log_time_ns, publish_time_ns)


def describe_os_error(path: Path, error: OSError) -> LogError:
    """Return a failure of the disk as an error of one line."""
    where = Path(error.filename or path)
    exists = isinstance(error, FileExistsError)
    if exists and is_unfinished(where):
        return LogError(f"{where}: a recording is running here or was cut short; choose another place")
    if exists and where.suffix == ".mcap":
        return LogError(f"{where}: exists already; a log is never overwritten, choose another place or remove it")
    return LogError(f"{where}: cannot write a log here: {error.strerror or error}; make room or choose another place")
