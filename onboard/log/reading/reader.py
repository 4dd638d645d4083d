"""Reading of run logs, with one chunk in memory at a time and every checksum checked."""

import heapq
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import suppress
from itertools import chain
from operator import attrgetter
from os import PathLike
from pathlib import Path
from typing import Final

from google.protobuf.message import Message

from groundsbot.calib.foundation import StrPath
from groundsbot.onboard.errors import LogError
from groundsbot.onboard.log.losses import LogLosses, NoLosses
from groundsbot.onboard.log.messages import FrameTransform, RunInfo, is_head_topic, is_picture_topic
from groundsbot.onboard.log.reading.allowance import Allowance
from groundsbot.onboard.log.reading.chunks import ChunkReader
from groundsbot.onboard.log.reading.decoder import LogMessage, MessageDecoder
from groundsbot.onboard.log.writing.file import ACTIVE_SUFFIX
from groundsbot.onboard.log.writing.segments import of_pictures

SMALLEST_RECORD_BYTES: Final = (
    4  # those of this project compress to 14 bytes at best; a hostile file may contain millions in a few kB
)


def find_logs(paths: StrPath | Iterable[StrPath]) -> list[Path]:
    """Return the logs of LOG arguments.

    Args:
        paths: files, run folders, or folders that contain run folders at any depth; or one of these.

    Returns:
        Files and run folders, sorted by name for each argument, including runs whose recording was cut short.

    Raises:
        LogError: a path is missing, or a folder contains no log.
    """
    logs: list[Path] = []
    for path in map(Path, [paths] if isinstance(paths, str | PathLike) else paths):
        if path.is_dir():
            logs += _logs_below(path)
        elif path.exists():
            logs.append(path)
        else:
            raise LogError(f"{path}: no such log; give a .mcap file, a run folder or a folder of runs")
    return logs


def read_log(
    path: Path,
    topics: Collection[str] | None = None,
    losses: LogLosses | None = None,
    allowance: Allowance | None = None,
) -> Iterator[LogMessage]:
    """Iterate over the messages of one run.

    Args:
        path: one file, or one run folder, whose files are joined.
        topics: topics to return; None for all. Those of a single camera (as `/tags/detections`) stand for those of all
            cameras by name, too. Picture files are opened only if `/camera/image` or that of a camera is among them.
        losses: collects what cannot be read, and reading continues after it. None makes every loss an error.
        allowance: limits beyond the shares of the log's size, shared with other logs; a new one if None.

    Yields:
        Messages in order of log time. Messages repeated at the head of every file (`/run` and so on) come once.

    Raises:
        LogError: (while iterating) the log is missing, empty, of another kind, or its files belong to different runs.
            Without `losses`, also if the log is damaged or unfinished.
    """
    core, pictures = _files_of(path)
    if topics is not None and core and not any(map(is_picture_topic, topics)):
        pictures = []
    allowance = allowance or Allowance()
    if path.is_dir():
        core, pictures = _usable(core, losses, allowance), _usable(pictures, losses, allowance)
        if not core and not pictures:
            raise LogError(f"{path}: no file in it can be read: {_reasons(losses)}")
    _check_same_run([*core[:1], *pictures[:1]], allowance)
    streams = [_join_files(files, topics, losses, allowance) for files in (core, pictures) if files]
    for messages in _heads_once(streams[0] if len(streams) == 1 else _merge(streams)):
        yield from messages


def files_of(path: Path) -> list[Path]:
    """Return the files of a log: the file itself, or the finished and unfinished files of a run folder.

    Raises:
        LogError: the log has no files.
    """
    core, pictures = _files_of(path)
    return sorted([*core, *pictures])


def read_head(path: Path) -> dict[str, Message | Sequence[Message]]:
    """Return the head messages of a log by topic, each from the first file that contains it.

    With several cameras `/tf` has several messages, one of each.

    Raises:
        LogError: `path` is missing, contains no log, or is a file of another kind.
    """
    head: dict[str, list[Message]] = {}
    seen: set[tuple[str, str]] = set()
    allowance, files = Allowance(), files_of(path)
    if not path.is_dir():
        _check_kind(path, allowance)
    for file in files:
        for each in _beginning(file, allowance):
            if is_head_topic(each.topic) and _head_key(each) not in seen:
                seen.add(_head_key(each))
                head.setdefault(each.topic, []).append(each.message)
    return {topic: messages if len(messages) > 1 else messages[0] for topic, messages in head.items()}


def size_bytes(log: Path) -> int:
    """Return the total size of a log's files; zero where there is no such log."""
    files = log.iterdir() if log.is_dir() else [log]
    return sum(path.stat().st_size for path in files if path.is_file())


def _logs_below(folder: Path) -> list[Path]:
    if _files_in(folder):
        return [folder]
    patterns = ("*.mcap", f"*.mcap{ACTIVE_SUFFIX}")
    logs = sorted({file.parent for pattern in patterns for file in folder.rglob(pattern)})
    if not logs:
        raise LogError(
            f"{folder}: holds no .mcap file; give a log, a run folder or a folder of runs "
            "(files of other programs become logs by `groundsbot-offline import`)"
        )
    return logs


def _files_in(folder: Path) -> list[Path]:
    return sorted([*folder.glob("*.mcap"), *folder.glob(f"*.mcap{ACTIVE_SUFFIX}")])


def _files_of(path: Path) -> tuple[list[Path], list[Path]]:
    """Return the files of one run: those with measurements and those with pictures."""
    if not path.is_dir():
        if not path.exists():
            raise LogError(f"{path}: no such log; give a .mcap file or a run folder")
        return [path], []
    files = _files_in(path)
    if not files:
        raise LogError(f"{path}: holds no .mcap file; give a .mcap file or a run folder")
    pictures = of_pictures(files)
    return [file for file in files if file not in pictures], pictures


def _usable(files: list[Path], losses: LogLosses | None, allowance: Allowance) -> list[Path]:
    """Return the files with content; a killed run may leave an empty one."""
    if losses is None:
        return files
    usable = []
    for file in files:
        try:
            _check_kind(file, allowance)
        except LogError as error:
            losses.unusable[file] = str(error).removeprefix(f"{file}: ")
        else:
            usable.append(file)
    return usable


def _check_kind(file: Path, allowance: Allowance) -> None:
    """Raise LogError if a file cannot be read, is empty or not MCAP."""
    try:
        with file.open("rb") as stream:
            ChunkReader(stream, file, lambda _: None, allowance)
    except OSError as error:
        raise LogError(
            f"{file}: cannot be read: {error.strerror or error}; check the path and its permissions"
        ) from error


def _reasons(losses: LogLosses | None) -> str:
    return "; ".join((losses or LogLosses()).lines())


def _join_files(
    files: list[Path], topics: Collection[str] | None, losses: LogLosses | None, allowance: Allowance
) -> Iterator[list[LogMessage]]:
    """Yield the messages of successive files, without those that a failed disk left in two files."""
    _check_same_run(files, allowance)
    seam: set[bytes] = set()
    for index, file in enumerate(files):
        following_ns = _first_time_ns(files[index + 1], allowance) if index + 1 < len(files) else None
        before, seam = seam, set()
        for messages in _read_file(file, topics, losses, allowance):
            if before:
                messages = [each for each in messages if is_head_topic(each.topic) or _identity(each) not in before]
            if following_ns is not None:
                late = [each for each in messages if each.log_time_ns >= following_ns and not is_head_topic(each.topic)]
                seam.update(map(_identity, late))
            if messages:
                yield messages


def _merge(streams: list[Iterator[list[LogMessage]]]) -> Iterator[list[LogMessage]]:
    """Yield the messages of several streams in order of log time."""
    for each in heapq.merge(*map(chain.from_iterable, streams), key=attrgetter("log_time_ns")):
        yield [each]


def _heads_once(lists: Iterator[list[LogMessage]]) -> Iterator[list[LogMessage]]:
    """Yield lists of messages, in which only the last may be of a head topic, without repetitions of those."""
    seen: set[tuple[str, str]] = set()
    for messages in lists:
        if is_head_topic(messages[-1].topic):
            key = _head_key(messages[-1])
            if key in seen:
                messages.pop()
            seen.add(key)
        yield messages


def _head_key(each: LogMessage) -> tuple[str, str]:
    """Return what is the same for repetitions of a message at the head of files only; each camera has a mount."""
    return each.topic, each.message.child_frame_id if isinstance(each.message, FrameTransform) else ""


def _identity(each: LogMessage) -> bytes:
    return b"%s %d %d " % (each.topic.encode(), each.log_time_ns, each.publish_time_ns) + (
        each.message.SerializeToString(deterministic=True)
    )


def _first_time_ns(file: Path, allowance: Allowance) -> int | None:
    """Return the log time of the first message of a file, which is the time of the file's beginning."""
    return next((each.log_time_ns for each in _beginning(file, allowance)), None)


def _beginning(file: Path, allowance: Allowance) -> list[LogMessage]:
    """Return the messages of the first intact chunk of a file, which contains its head unless that is lost."""
    losses = LogLosses()
    found: list[LogMessage] = []
    with suppress(LogError, OSError), file.open("rb") as stream:
        reader = ChunkReader(stream, file, losses.add, allowance)
        for messages in _messages(reader, file, None, losses, allowance, only_first=True):
            found += messages
    return found


def _check_same_run(files: list[Path], allowance: Allowance) -> None:
    if len(files) < 2:
        return
    found = {file: _run_info(file, allowance) for file in files}
    run_ids = {info.run_id: file for file, info in found.items() if info is not None}
    if len(run_ids) > 1:
        (run_a, file_a), (run_b, file_b) = sorted(run_ids.items())[:2]
        raise LogError(
            f"{file_a.parent}: {file_a.name} belongs to run {run_a}, {file_b.name} to {run_b}; "
            "keep each run in a folder of its own"
        )


def _run_info(file: Path, allowance: Allowance) -> RunInfo | None:
    """Return the `/run` at the head of a file, or None if the head is damaged."""
    return next((each.message for each in _beginning(file, allowance) if isinstance(each.message, RunInfo)), None)


def _read_file(
    path: Path, topics: Collection[str] | None, losses: LogLosses | None, allowance: Allowance
) -> Iterator[list[LogMessage]]:
    """Yield the messages of one file; the first must be `/run`, unless it was lost."""
    found = NoLosses() if losses is None else losses
    try:
        with path.open("rb") as stream:
            reader = ChunkReader(stream, path, found.add, allowance)
            yield from _messages(reader, path, topics, found, allowance)
    except OSError as error:
        raise LogError(
            f"{path}: cannot be read: {error.strerror or error}; check the path and its permissions"
        ) from error


def _messages(
    reader: ChunkReader,
    path: Path,
    topics: Collection[str] | None,
    losses: LogLosses,
    allowance: Allowance,
    only_first: bool = False,
) -> Iterator[list[LogMessage]]:
    decoder = MessageDecoder(path, topics, lambda reason: losses.add_undecodable(path, reason))
    n_damaged, drawn = losses.n_places, 0
    for chunk in reader:
        if reader.n_chunks == 1 and losses.n_places > n_damaged:
            decoder.begin_without_head(reader.summary.declarations if reader.summary else b"")
        share = reader.offset // SMALLEST_RECORD_BYTES
        decoder.allow(share + drawn + allowance.records)
        yield from decoder.messages(chunk)
        more = max(0, decoder.n_records - share - drawn)
        allowance.records, drawn = allowance.records - more, drawn + more
        if only_first:
            return
    if not reader.is_finished:
        losses.add_missing_end(path, reader.end_offset)
    elif reader.summary is not None and reader.summary.n_chunks is not None:
        losses.add_lost_chunks(path, reader.summary.n_chunks - reader.n_chunks)
    if reader.n_chunks == 0:
        losses.add_empty_file(path)
