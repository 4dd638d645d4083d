"""Writes a run's log: MCAP files that each open alone, the same bytes for the same messages.

A file is called `<name>.active` until it is finished, so that nobody takes half a log for a whole one.
"""

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO, Final

from google.protobuf.message import Message
from mcap.well_known import MessageEncoding
from mcap.writer import CompressionType, IndexType, Writer
from mcap_protobuf.schema import register_schema

from onboard.errors import LogError, MessageRefusedError
from onboard.messages import TOPICS, Topic

CORE_FILE: Final = "0000.core.mcap"
CAMERA_FILE: Final = "0000.camera.mcap"
ACTIVE_SUFFIX: Final = ".active"
PICTURE_TOPIC: Final = "/camera/image"

_FLUSH_PERIOD_NS: Final = 500_000_000  # what is older than this on the log's own time is in the file
_TIME_LIMIT_NS: Final = 1 << 63


class LogWriter:
    """Writes the messages of one run.

    Log times never run backwards; what is written is in the file (and, if `durable`, on the disk) once the log time
    has moved on by half a second.
    """

    def __init__(
        self,
        path: Path,
        head: Mapping[str, Message],
        start_ns: int,
        *,
        keep_pictures: bool = False,
        durable: bool = True,
    ) -> None:
        """Opens the files and writes their heads.

        Args:
            path: a run folder, made if need be, which gets `0000.core.mcap` and, with `keep_pictures`,
                `0000.camera.mcap`; or one file, whose name ends in `.mcap`, for all topics.
            head: what stands at the head of every file, by topic: `/run`, and where known the calibration and mount.
            start_ns: log time of the head, on the run's clock.
            keep_pictures: whether pictures will be written.
            durable: wait for the disk at every flush. A simulator that writes thousands of logs need not.

        Raises:
            LogError: no `/run` in the head, a file exists already, or it cannot be written.
        """
        self._last_ns = start_ns
        self._files: list[_LogFile] = []
        if "/run" not in head:
            raise LogError(f"{path}: a log cannot start without /run; give a RunInfo in its head")
        one_file = path.suffix == ".mcap"
        folder = path.parent if one_file else path
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._core = self._open(path if one_file else path / CORE_FILE, durable)
            self._pictures: _LogFile | None = self._core if one_file else None
            if keep_pictures and not one_file:
                self._pictures = self._open(path / CAMERA_FILE, durable, CompressionType.NONE)
            for name in sorted(head, key=list(TOPICS).index):
                topic = _topic(name, head[name])
                data = head[name].SerializeToString(deterministic=True)
                for file in self._files:
                    file.write(topic, data, start_ns, start_ns)
            self.flush()
        except OSError as error:
            self.discard()
            raise LogError(f"{path}: cannot write a log here: {error.strerror or error}") from error
        except LogError:
            self.discard()
            raise

    def write(self, topic: str, message: Message, log_time_ns: int, publish_time_ns: int) -> None:
        """Appends one message.

        Args:
            topic: one of `onboard.messages.TOPICS`.
            message: of that topic's schema.
            log_time_ns: when the host received it, on the run's clock; not before the last one's.
            publish_time_ns: best estimate of when it was measured, on the run's clock.

        Raises:
            MessageRefusedError: a time out of range. The log stays whole.
            LogError: unknown topic, another schema, or log time backwards.
        """
        known = _topic(topic, message)
        for name, value in (("log_time_ns", log_time_ns), ("publish_time_ns", publish_time_ns)):
            if not 0 <= value < _TIME_LIMIT_NS:
                raise MessageRefusedError(f"{topic}: {name} is {value}, must lie in 0 to 2^63 - 1; message refused")
        if log_time_ns < self._last_ns:
            raise LogError(
                f"{topic}: log_time_ns {log_time_ns} lies before the last message's {self._last_ns}; sort first"
            )
        file = self._pictures if topic == PICTURE_TOPIC else self._core
        if file is None:
            raise LogError(f"{topic}: this log keeps no pictures; open it with keep_pictures")
        self._last_ns = log_time_ns
        file.write(known, message.SerializeToString(deterministic=True), log_time_ns, publish_time_ns)
        for other in self._files:
            other.flush_if_due(log_time_ns)

    @property
    def last_log_time_ns(self) -> int:
        """The newest log time written."""
        return self._last_ns

    def flush(self) -> None:
        """Puts everything written so far into the files."""
        for file in self._files:
            file.flush(self._last_ns)

    def close(self) -> None:
        """Finishes the files and gives them their names. A second call does nothing."""
        while self._files:
            self._files.pop().finish()

    def discard(self) -> None:
        """Removes the files of a log that shall not come to be."""
        while self._files:
            self._files.pop().discard()

    def __enter__(self) -> "LogWriter":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _open(self, path: Path, durable: bool, compression: CompressionType = CompressionType.ZSTD) -> "_LogFile":
        file = _LogFile(path, durable, compression)
        self._files.append(file)
        return file


def _topic(name: str, message: Message) -> Topic:
    topic = TOPICS.get(name)
    if topic is None:
        raise LogError(f"{name}: no such topic; a log holds {', '.join(TOPICS)}")
    if not isinstance(message, topic.schema):
        raise LogError(f"{name}: holds {topic.schema.DESCRIPTOR.full_name}, not {message.DESCRIPTOR.full_name}")
    return topic


class _LogFile:
    """One MCAP file."""

    def __init__(self, path: Path, durable: bool, compression: CompressionType) -> None:
        self._path = path
        self._active = path.with_name(path.name + ACTIVE_SUFFIX)
        self._durable = durable
        self._channels: dict[str, int] = {}
        self._flushed_ns = 0
        self._dirty = False
        if path.exists():
            raise LogError(f"{path}: exists already; a log is never overwritten, choose another place or remove it")
        try:
            self._sink: BinaryIO = self._active.open("xb")
        except FileExistsError:
            raise LogError(
                f"{self._active}: a recording is running here or was cut short; choose another place"
            ) from None
        self._writer = Writer(self._sink, compression=compression, index_types=IndexType.ALL, enable_crcs=True)
        self._writer.start(profile="", library="groundsbot")

    def write(self, topic: Topic, data: bytes, log_time_ns: int, publish_time_ns: int) -> None:
        channel = self._channels.get(topic.name)
        if channel is None:
            schema = register_schema(self._writer, topic.schema)
            channel = self._writer.register_channel(topic.name, MessageEncoding.Protobuf, schema)
            self._channels[topic.name] = channel
        self._dirty = True
        try:  # spelt out: this is called for every message
            self._writer.add_message(channel, log_time_ns, data, publish_time_ns)
        except OSError as error:
            raise self._told(error) from error

    def flush_if_due(self, log_time_ns: int) -> None:
        if log_time_ns - self._flushed_ns >= _FLUSH_PERIOD_NS:
            self.flush(log_time_ns)

    def flush(self, log_time_ns: int) -> None:
        self._flushed_ns = log_time_ns
        if not self._dirty:
            return
        self._dirty = False
        with self._told_errors():
            self._writer.flush()  # type: ignore[no-untyped-call]  # mcap leaves it unannotated
            if self._durable:
                os.fdatasync(self._sink.fileno())

    def finish(self) -> None:
        with self._told_errors():
            self._writer.finish()  # type: ignore[no-untyped-call]  # mcap leaves it unannotated
            self._sink.flush()
            if self._durable:
                os.fsync(self._sink.fileno())
            self._sink.close()
            self._active.rename(self._path)
            if self._durable:
                _sync_folder(self._path.parent)

    def discard(self) -> None:
        self._sink.close()
        self._active.unlink(missing_ok=True)

    @contextmanager
    def _told_errors(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise self._told(error) from error

    def _told(self, error: OSError) -> LogError:
        return LogError(f"{self._active}: cannot be written: {error.strerror or error}; make room")


def _sync_folder(folder: Path) -> None:
    """Without this the new name may be gone after a power cut."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
