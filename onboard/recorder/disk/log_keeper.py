"""Writing of a log to a disk that may be slow, full or failing: the recorder never waits, and writing is retried.

While the disk works, data older than a second are on it. While it does not, readings wait in memory and pictures are
dropped first. Final losses are counted and reported in the log.
"""

import threading
from collections import Counter, deque
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final, NamedTuple

from google.protobuf.message import Message

from groundsbot.onboard.log import (
    EventKind,
    LogHead,
    LogNote,
    LogSegments,
    Record,
    SegmentLimits,
    Severity,
    Storage,
    camera_names_in,
    checked_record,
    files_of_run,
    head_records,
    is_picture_topic,
)
from groundsbot.onboard.recorder.disk.room import NO_ROOM, DiskRoom

_PICTURES_LIMIT_BYTES: Final = 16 << 20  # waiting data beyond which new pictures are dropped
_LIMIT_BYTES: Final = 64 << 20  # waiting data beyond which the oldest tenth is dropped
_RECORD_BYTES: Final = 200  # overhead of a waiting record in memory
_RETRY_S: Final = 2.0
_LOOK_AT_ROOM_S: Final = 10.0
_LAST_TRIES: Final = 3  # without progress
_PORTION_BYTES: Final = 2 << 20  # of a backlog, written and synced at once
_LEAST_PORTION_BYTES: Final = 64 << 10
_LITTLE_SPACE: Final = "little space left"


class LogStatus(NamedTuple):
    """Status of the log."""

    problem: str | None  # None without a problem
    written: Mapping[str, int]  # messages by topic that are on the disk
    waiting_bytes: int  # in memory, not yet on the disk
    synced_s: float  # monotonic time of the last sync of all data accepted before
    lost: Mapping[str, int]  # messages by topic, since the start
    files: str  # names of the files being written


class LogKeeper:
    """The log of one run. The recorder calls `write` and `take_notes`, the disk's thread `step` and `finish`."""

    def __init__(
        self,
        folder: Path,
        head: LogHead,
        start_ns: int,
        storage: Storage,
        room: DiskRoom,
        *,
        keep_pictures: bool,
        limits: SegmentLimits,
    ) -> None:
        """Prepare; no file is opened yet, because a full disk may have space later.

        Args:
            folder: the run's folder, made with the first file.
            head: messages at the head of every file, by topic.
            start_ns: log time of the head.
            storage: the disk.
            room: management of the space on the disk.
            keep_pictures: whether pictures will be written.
            limits: when new files begin.

        Raises:
            LogError: the head has no `/run`.
        """
        self._room = room
        self._last_ns = start_ns
        files = files_of_run(storage, folder, camera_names_in(head), keep_pictures)
        self._segments = LogSegments(storage, files, head_records(folder, head, start_ns), limits)
        self._lock = threading.Lock()
        self._waiting: deque[Record] = deque()
        self._waiting_bytes = 0
        self._lost: Counter[str] = Counter()
        self._lost_reported: Counter[str] = Counter()
        self._notes: deque[LogNote] = deque()
        self._keep_pictures = keep_pictures
        self._pictures_pause = False
        self._problem: str | None = None
        self._problem_since_s = self._retry_at_s = self._synced_s = float("-inf")
        self._next_look_s = float("-inf")

    # --- the recorder's side

    @property
    def last_log_time_ns(self) -> int:
        """Log time of the newest message."""
        return self._last_ns

    def write(self, topic: str, message: Message, log_time_ns: int, publish_time_ns: int) -> bool:
        """Accept one message without waiting for the disk. Call it from one thread only.

        Returns:
            False for a picture that is dropped for lack of space.

        Raises:
            MessageRefusedError: a time is out of range or the message is too large.
            LogError: the topic is unknown, the schema is another, or the log time decreases.
        """
        record = checked_record(topic, message, log_time_ns, publish_time_ns, self._last_ns)
        self._last_ns = log_time_ns
        with self._lock:
            if is_picture_topic(topic) and (self._pictures_pause or self._waiting_bytes > _PICTURES_LIMIT_BYTES):
                self._lost[topic] += 1
                return False
            self._waiting.append(record)
            self._waiting_bytes += _size(record)
            self._forget_oldest()
        return True

    def take_notes(self) -> Sequence[LogNote]:
        """Return the notes since the last call."""
        return [self._notes.popleft() for _ in range(len(self._notes))]

    @property
    def status(self) -> LogStatus:
        """The present status."""
        with self._lock:
            lost = dict(self._lost)
        problem = self._problem or (self._low_text if self._pictures_pause else None)
        written = dict(self._segments.written)
        return LogStatus(problem, written, self._waiting_bytes, self._synced_s, lost, self._segments.names)

    @property
    def written(self) -> Mapping[str, int]:
        """Number of messages on the disk, by topic."""
        return self._segments.written

    @property
    def _low_text(self) -> str:
        return f"{_LITTLE_SPACE}: pictures are not kept" if self._keep_pictures else _LITTLE_SPACE

    # --- the disk's side

    def step(self, now_s: float) -> None:
        """Write the messages since the last step to the disk. Call it at least every half second.

        Args:
            now_s: monotonic time. The call takes as long as the disk.
        """
        self._check_room(now_s)
        if self._problem is None or now_s >= self._retry_at_s:
            with self._lock:
                batch, self._waiting, self._waiting_bytes = self._waiting, deque(), 0
            self._put_on_disk(batch, now_s)
        self._report_losses()

    def finish(self, now_s: float) -> None:
        """Write the waiting messages and finish the files; a note reports messages that cannot be written."""
        tries, n_before = _LAST_TRIES, len(self._waiting)
        while tries:
            self._retry_at_s = now_s
            self.step(now_s)
            try:
                self._segments.finish()
            except Exception as error:
                self._fail(error, (), now_s)
            if not self._waiting:
                break
            tries -= len(self._waiting) >= n_before  # on a full disk each file takes half of the space that is left
            n_before = len(self._waiting)
        self.give_up()
        self._room.drop_ballast()

    def give_up(self) -> None:
        """Count the waiting messages as lost, and add a note."""
        with self._lock:
            self._lost.update(record.topic for record in self._waiting)
            self._waiting, self._waiting_bytes = deque(), 0
        self._report_losses()

    def _put_on_disk(self, batch: deque[Record], now_s: float) -> None:
        try:
            if not self._segments.is_open:
                if self._problem is not None and not batch:
                    return
                self._open(batch[0].log_time_ns if batch else self._last_ns, now_s)
            begun_before = self._segments.has_full
            self._write_and_sync(batch)
            if begun_before:  # one per step, and not in a step that began a segment
                self._segments.finish_a_full_one()
        except Exception as error:  # also unexpected errors, as writing to a new file may succeed
            self._fail(error, batch, now_s)
        else:
            self._synced_s = now_s

    def _write_and_sync(self, batch: deque[Record]) -> None:
        while True:
            self._append_portion(batch)
            self._segments.commit()
            self._segments.sync()
            if not batch:
                return

    def _append_portion(self, batch: deque[Record]) -> None:
        """Append the first records of a batch, as many as fit into the ballast's space together with an index."""
        limit_bytes = _PORTION_BYTES
        if self._pictures_pause:
            limit_bytes = max(_LEAST_PORTION_BYTES, min(limit_bytes, self._room.ballast_bytes // 2))
        while batch and limit_bytes > 0:
            limit_bytes -= _size(batch[0])
            self._append_first(batch)

    def _append_first(self, batch: deque[Record]) -> None:
        try:
            self._segments.append(batch[0])
        except OSError:
            raise
        except Exception:  # the record cannot be written to any file and must not block the others
            with self._lock:
                self._lost[batch.popleft().topic] += 1
            raise
        batch.popleft()

    def _open(self, start_ns: int, now_s: float) -> None:
        self._room.take_ballast()
        if self._room.is_short:
            self._set_pictures_pause(True)
        self._segments.open(start_ns)
        if self._problem is not None:
            text = f"recording again, in {self._segments.names}, after {now_s - self._problem_since_s:.1f} s"
            self._notes.append(LogNote(EventKind.DISK, Severity.SEVERITY_INFO, text, {}))
            self._problem = None
            self._next_look_s = float("-inf")  # pictures may be kept again

    def _fail(self, error: Exception, batch: Iterable[Record], now_s: float) -> None:
        """Keep data that are not on the disk in memory, and close the files so that they can be read."""
        number, file, what = None, None, repr(error)
        if isinstance(error, OSError):
            number, file, what = error.errno, error.filename, error.strerror or str(error)
        text = f"{self._segments.names or file or 'log'}: {what}"
        pictures_go = False
        if number in NO_ROOM:
            pictures_go = not self._remove_old_pictures()
            self._room.drop_ballast()
            with suppress(OSError):  # appended data that remain are returned by `abandon`
                self._segments.finish()
        unsafe = self._segments.abandon()
        with self._lock:
            self._waiting.extendleft(reversed([*unsafe, *batch]))
            self._waiting_bytes = sum(map(_size, self._waiting))
            if pictures_go:  # the space left is for measurements
                self._forget_pictures()
            self._forget_oldest()
        if pictures_go:
            self._set_pictures_pause(True)
        if self._problem is None:
            self._problem_since_s = now_s
            self._retry_at_s = now_s  # writing to a new file may succeed at once
            note = f"{text}; readings wait in memory, and pictures are dropped first, until a new file can be written"
            self._notes.append(LogNote(EventKind.DISK, Severity.SEVERITY_ERROR, note, {}))
        else:
            self._retry_at_s = now_s + _RETRY_S
        self._problem = text

    def _check_room(self, now_s: float) -> None:
        if now_s < self._next_look_s:
            return
        self._next_look_s = now_s + _LOOK_AT_ROOM_S
        low = self._room.is_low()
        if low and self._remove_old_pictures():
            low = self._room.is_low()
        if (self._segments.is_open or self._problem is not None) and self._room.is_short:
            with suppress(OSError):  # there is no space, or the disk fails
                self._room.take_ballast()
            low = low or self._room.is_short
        self._set_pictures_pause(low)

    def _set_pictures_pause(self, low: bool) -> None:
        if low != self._pictures_pause:
            self._pictures_pause = low
            again = "space again: pictures are kept" if self._keep_pictures else "space again"
            text = self._low_text if low else again
            self._notes.append(LogNote(EventKind.DISK, Severity.SEVERITY_WARNING, text, {}))

    def _remove_old_pictures(self) -> int:
        """Remove old pictures if that is allowed, add a note, and return the number of files removed."""
        removed = self._room.remove_old_pictures()
        if removed:
            text = f"removed {len(removed)} old files of pictures for lack of space, from {removed[0]} on"
            self._notes.append(LogNote(EventKind.DISK, Severity.SEVERITY_WARNING, text, {}))
        return len(removed)

    def _report_losses(self) -> None:
        with self._lock:
            new = self._lost - self._lost_reported
            self._lost_reported.update(new)
        if new:
            text = ", ".join(f"{count} of {topic}" for topic, count in sorted(new.items()))
            self._notes.append(LogNote(EventKind.DISK, Severity.SEVERITY_ERROR, f"not in the log: {text}", new))

    def _forget_oldest(self) -> None:
        """Limit the waiting data, pictures first. The caller holds the lock."""
        if self._waiting_bytes <= _LIMIT_BYTES:
            return
        self._forget_pictures()
        excess, oldest = self._waiting_bytes - _LIMIT_BYTES * 9 // 10, []
        for record in self._waiting:
            if excess <= 0:
                break
            oldest.append(record)
            excess -= _size(record)
        self._forget(oldest)

    def _forget_pictures(self) -> None:
        self._forget([record for record in self._waiting if is_picture_topic(record.topic)])

    def _forget(self, records: list[Record]) -> None:
        if not records:
            return
        gone = set(map(id, records))
        self._waiting = deque(record for record in self._waiting if id(record) not in gone)
        self._waiting_bytes -= sum(map(_size, records))
        self._lost.update(record.topic for record in records)


def _size(record: Record) -> int:
    return len(record.data) + _RECORD_BYTES
