"""Reading of a log while it is being written: each time the messages that were added since the last."""

import heapq
from collections.abc import Collection
from operator import attrgetter
from pathlib import Path
from typing import BinaryIO, Final

from mcap.writer import MCAP0_MAGIC

from groundsbot.onboard.errors import LogError
from groundsbot.onboard.log.losses import Damage, LogLosses
from groundsbot.onboard.log.messages import is_picture_topic
from groundsbot.onboard.log.reading.allowance import Allowance
from groundsbot.onboard.log.reading.chunks import ChunkReader
from groundsbot.onboard.log.reading.decoder import LogMessage, MessageDecoder
from groundsbot.onboard.log.reading.reader import SMALLEST_RECORD_BYTES, files_of
from groundsbot.onboard.log.writing.file import ACTIVE_SUFFIX
from groundsbot.onboard.log.writing.segments import finished_name, is_unfinished, of_pictures

# Holds the checksum of the first chunk, which has the run's id, and that of the camera.
_BEGINNING_BYTES: Final = 256


class LogFollower:
    """Reader of a log that grows.

    Only complete chunks are read. A file that gets its final name is continued, and so is a log that was not readable
    for some time.

    Attributes:
        log: the log, by its final name.
        is_finished: whether no file of the log was being written at the last `read`.
        n_bytes: size of its files at the last `read`, without those of pictures unless these are wanted.
        losses: what could not be read up to now. The end of an unfinished file is no loss.
    """

    def __init__(self, log: Path, topics: Collection[str] | None = None) -> None:
        """Start without reading.

        Args:
            log: a file, by its present or its final name, or a run folder. It need not exist yet.
            topics: topics to return; None for all, as for `read_log`.
        """
        self.log = log.with_name(finished_name(log)) if is_unfinished(log) else log
        self.is_finished = False
        self.n_bytes = 0
        self.losses = LogLosses()
        self._topics = topics
        self._allowance = Allowance()
        self._files: dict[str, _GrowingFile] = {}  # by final name
        self._new: list[list[LogMessage]] = []  # by file; those before an error wait for the next call

    def read(self) -> list[LogMessage] | None:
        """Return the new messages in order of log time; None if the log was replaced and is to be read anew.

        Raises:
            LogError: the log is not there, or a file of it cannot be read or is of another kind. What was read before
                stays; the next call continues.
        """
        paths = self._paths()
        try:
            for path in paths:
                self._new.append(self._file(path).read(path, self.losses, self._allowance))
        except _ReplacedError:
            self._files, self._new, self.losses, self.is_finished = {}, [], LogLosses(), False
            return None
        except OSError as error:
            raise LogError(
                f"{self.log}: cannot be read: {error.strerror or error}; check the path and its permissions"
            ) from error
        self.n_bytes = sum(each.n_bytes for each in self._files.values())
        self.is_finished = not any(map(is_unfinished, paths))
        new, self._new = self._new, []
        return list(heapq.merge(*new, key=attrgetter("log_time_ns")))

    def _paths(self) -> list[Path]:
        """Return the files to read; those of pictures only if pictures are wanted."""
        active = self.log.with_name(self.log.name + ACTIVE_SUFFIX)
        try:
            files = files_of(self.log if self.log.exists() or not active.exists() else active)
        except OSError as error:
            raise LogError(
                f"{self.log}: cannot be read: {error.strerror or error}; check the path and its permissions"
            ) from error
        if self._topics is None or any(map(is_picture_topic, self._topics)):
            return files
        return [file for file in files if file not in of_pictures(files)] or files

    def _file(self, path: Path) -> "_GrowingFile":
        name = finished_name(path)
        if name not in self._files:
            self._files[name] = _GrowingFile(path, self._topics, self.losses)
        return self._files[name]


class _ReplacedError(Exception):
    """Error: a file is not the one that was read before."""


class _GrowingFile:
    """One file of a log, and the offset up to which it was read."""

    def __init__(self, path: Path, topics: Collection[str] | None, losses: LogLosses) -> None:
        self.n_bytes = 0
        self._beginning = b""
        self._offset = 0
        self._decoder = MessageDecoder(path, topics, lambda reason: losses.add_undecodable(path, reason))

    def read(self, path: Path, losses: LogLosses, allowance: Allowance) -> list[LogMessage]:
        with path.open("rb") as stream:
            beginning = stream.read(_BEGINNING_BYTES)
            self.n_bytes = stream.seek(0, 2)
            if self.n_bytes < self._offset or (self._offset and beginning != self._beginning):
                raise _ReplacedError
            self._beginning = beginning
            if self.n_bytes < len(MCAP0_MAGIC):  # its writer has just begun
                return []
            return self._read(stream, path, losses, allowance)

    def _read(self, stream: BinaryIO, path: Path, losses: LogLosses, allowance: Allowance) -> list[LogMessage]:
        found: list[LogMessage] = []
        damages: list[Damage] = []
        is_beginning = not self._offset
        reader = ChunkReader(stream, path, damages.append, allowance, self._offset)
        for chunk in reader:
            if is_beginning and damages:
                self._decoder.begin_without_head(reader.summary.declarations if reader.summary else b"")
            is_beginning = False
            self._decoder.allow(reader.offset // SMALLEST_RECORD_BYTES + allowance.records)
            for messages in self._decoder.messages(chunk):
                found += messages
            self._offset = reader.offset
        # Damage behind the last chunk may be a chunk that is being written.
        for damage in damages:
            if damage.offset < self._offset:
                losses.add(damage)
        return found
