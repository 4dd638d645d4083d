"""The sequence of files of a run: a new pair begins after a time or size, each with the head of the run.

Measurements and pictures are in separate files, so that pictures can be removed first if the disk is nearly full.
"""

import heapq
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from operator import attrgetter
from pathlib import Path
from typing import Final, NamedTuple

from groundsbot.calib.robot import Robot
from groundsbot.onboard.log.messages import PICTURE_TOPIC, topic_of, topics_of_cameras
from groundsbot.onboard.log.writing.file import ACTIVE_SUFFIX, LogFile, Record
from groundsbot.onboard.log.writing.storage import Storage

CORE_SUFFIX: Final = ".core.mcap"
CAMERA_SUFFIX: Final = ".camera.mcap"

_NS_PER_S: Final = 1_000_000_000


class SegmentLimits(NamedTuple):
    """Limits after which new files begin."""

    duration_ns: int = 600 * _NS_PER_S  # of log time
    size_bytes: int = 512 << 20  # of one file


def segment_limits(robot: Robot) -> SegmentLimits:
    """Return the limits of robot.yaml."""
    return SegmentLimits(round(robot.recorder.segment_s * _NS_PER_S), robot.recorder.segment_mb * 1_000_000)


class LogSegments:
    """Writer of records into segments of files. After an OSError it can continue in new files.

    Attributes:
        names: names of the files being written, as text. It is replaced atomically, so other threads may read it.
        written: number of messages on the disk, by topic, without the heads.
    """

    def __init__(
        self,
        storage: Storage,
        files_of: Callable[[int], Sequence[tuple[Path, tuple[str, ...]]]],
        head: Sequence[Record],
        limits: SegmentLimits | None,
    ) -> None:
        """Prepare; no file is created yet.

        Args:
            storage: the disk.
            files_of: returns the files of a segment, by its number, with their topics.
            head: records at the head of every file.
            limits: when a new segment begins; None for a single segment.
        """
        self.names = ""
        self.written: Counter[str] = Counter()
        self._storage = storage
        self._files_of = files_of
        self._head = head
        self._limits = limits
        self._next = 0
        self._start_ns = 0
        self._files: dict[Path, LogFile] = {}
        self._by_topic: dict[str, LogFile] = {}
        self._full: list[LogFile] = []  # files of earlier segments, complete but not finished yet
        self._new_in: set[Path] = set()  # folders whose new entries are not on the disk yet

    @property
    def is_open(self) -> bool:
        """Whether a segment is open for writing."""
        return bool(self._files)

    @property
    def has_full(self) -> bool:
        """Whether files of earlier segments remain to be finished."""
        return bool(self._full)

    def open(self, start_ns: int) -> None:
        """Begin the next segment: create its files and write `/run` and the like into each; `sync` makes them durable.

        Raises:
            OSError: a file exists already or cannot be written; the segment's files are then removed.
        """
        self._start_ns = start_ns
        try:
            for path, topics in self._files_of(self._next):
                compressed = not path.name.endswith(CAMERA_SUFFIX)
                file = LogFile(self._storage, path, topics, self.written, compressed=compressed)
                self._files[path] = file
                self._by_topic |= dict.fromkeys(topics, file)
                for record in self._head:
                    file.append(record._replace(log_time_ns=start_ns))
                file.unsafe.clear()  # the head is repeated in every file
                file.commit()
                self._new_in.add(path.parent)
        except OSError as error:
            self._close(LogFile.discard, self._files.values())
            self._replace_files({})
            if isinstance(error, FileExistsError):  # an earlier failure may have left a file of this name
                self._next += 1
            raise
        self._replace_files(self._files)
        self._next += 1

    def append(self, record: Record) -> None:
        """Append a record, beginning a new segment before it if one is due."""
        if self._limits is not None and self._is_full(record.log_time_ns, self._limits):
            # Finishing a file waits for the disk, so it is deferred to keep up with new readings.
            self._full += self._files.values()
            self._replace_files({})
            self.open(record.log_time_ns)
        self._by_topic[record.topic].append(record)

    def commit(self) -> None:
        """Write all appended records, in complete chunks."""
        for file in self._unfinished_files():
            file.commit()

    def sync(self) -> None:
        """Wait until all committed data and the names of the files are on the disk."""
        while self._new_in:
            self._storage.sync_folder(next(iter(self._new_in)))
            self._new_in.pop()
        for file in self._unfinished_files():
            file.sync()

    def finish_a_full_one(self) -> None:
        """Finish one file of an earlier segment. It can be repeated after an error."""
        self._full[0].finish()
        del self._full[0]

    def finish(self) -> None:
        """Finish all files and rename them. It can be repeated after an error."""
        self._full += self._files.values()
        self._replace_files({})
        while self._full:
            self.finish_a_full_one()

    def abandon(self) -> list[Record]:
        """Close the files unfinished, and return the records that are not on the disk."""
        unsafe = list(heapq.merge(*(file.unsafe for file in self._unfinished_files()), key=attrgetter("log_time_ns")))
        self._close_all(LogFile.abandon)
        return unsafe

    def discard(self) -> None:
        """Remove the unfinished files."""
        self._close_all(LogFile.discard)

    def _close_all(self, close: Callable[[LogFile], None]) -> None:
        self._close(close, self._unfinished_files())
        self._full, self._new_in = [], set()
        self._replace_files({})

    def _close(self, close: Callable[[LogFile], None], files: Iterable[LogFile]) -> None:
        for file in files:
            with suppress(OSError):
                close(file)

    def _unfinished_files(self) -> list[LogFile]:
        return [*self._full, *self._files.values()]

    def _replace_files(self, files: dict[Path, LogFile]) -> None:
        self._files = files
        self.names = ", ".join(path.name for path in files)
        if not files:
            self._by_topic = {}

    def _is_full(self, log_time_ns: int, limits: SegmentLimits) -> bool:
        return log_time_ns - self._start_ns >= limits.duration_ns or any(
            file.size_bytes >= limits.size_bytes for file in self._files.values()
        )


def files_of_run(
    storage: Storage, folder: Path, cameras: Sequence[str], keep_pictures: bool
) -> Callable[[int], Sequence[tuple[Path, tuple[str, ...]]]]:
    """Return a function that gives `0000.core.mcap` and, with pictures, `0000.camera.mcap`, by segment number.

    Args:
        storage: the disk.
        folder: the run's folder.
        cameras: names of the cameras, by `camera_names_in`.
        keep_pictures: whether there are files of pictures.
    """
    topics = [topic for name in topics_of_cameras(cameras) if (topic := topic_of(name)) is not None]
    of_core = tuple(topic.name for topic in topics if topic.kind != PICTURE_TOPIC)
    of_camera = tuple(topic.name for topic in topics if topic.kind == PICTURE_TOPIC or topic.every_file)

    def of(number: int) -> Sequence[tuple[Path, tuple[str, ...]]]:
        storage.make_folder(folder)
        core = folder / f"{number:04d}{CORE_SUFFIX}", of_core
        return [core, (folder / f"{number:04d}{CAMERA_SUFFIX}", of_camera)] if keep_pictures else [core]

    return of


def single_file(
    storage: Storage, path: Path, cameras: Sequence[str]
) -> Callable[[int], Sequence[tuple[Path, tuple[str, ...]]]]:
    """Return a function that gives one file for all topics; the arguments are those of `files_of_run`."""
    topics = topics_of_cameras(cameras)

    def of(_number: int) -> Sequence[tuple[Path, tuple[str, ...]]]:
        storage.make_folder(path.parent)
        return [(path, topics)]

    return of


def is_unfinished(path: Path) -> bool:
    """Return whether a file is still being written or its writing was cut short."""
    return path.name.endswith(ACTIVE_SUFFIX)


def of_pictures(files: Iterable[Path]) -> list[Path]:
    """Return the files with pictures."""
    return [path for path in files if finished_name(path).endswith(CAMERA_SUFFIX)]


def finished_name(path: Path) -> str:
    """Return the name of a file once it is finished."""
    return path.name.removesuffix(ACTIVE_SUFFIX)
