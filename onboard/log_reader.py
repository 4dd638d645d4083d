"""Reads run logs: one chunk in memory at a time, every checksum checked, each message of its topic's own class."""

import heapq
import struct
import zlib
from collections.abc import Collection, Iterable, Iterator
from operator import attrgetter
from pathlib import Path
from typing import BinaryIO, Final, NamedTuple

import zstandard
from google.protobuf.message import DecodeError, Message
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC

from onboard.errors import LogError
from onboard.log_file import ACTIVE_SUFFIX
from onboard.log_segments import PICTURE_TOPIC
from onboard.messages import TOPICS, RunInfo

# A hostile or damaged file may claim any length. Our chunks hold a mebibyte and one picture.
_RECORD_LIMIT_BYTES: Final = 64 << 20
_RECORD_HEAD: Final = struct.Struct("<BQ")
_MESSAGE_HEAD: Final = struct.Struct("<BQHIQQ")
_MESSAGE_FIXED_BYTES: Final = _MESSAGE_HEAD.size - _RECORD_HEAD.size
_CHUNK_HEAD: Final = struct.Struct("<QQQI")
_U16: Final = struct.Struct("<H")
_U32: Final = struct.Struct("<I")
_U64: Final = struct.Struct("<Q")


class LogMessage(NamedTuple):
    """One message of a log; times in ns on the run's clock."""

    topic: str
    message: Message
    log_time_ns: int
    publish_time_ns: int


def find_logs(paths: Iterable[Path]) -> list[Path]:
    """The logs that some LOG arguments mean: files as they are, and every run folder in or below a folder.

    Args:
        paths: each one file, one run folder, or a folder of runs at any depth.

    Returns:
        Files and run folders, for each argument sorted by name.

    Raises:
        LogError: a path is missing, or a folder holds no finished log.
    """
    logs: list[Path] = []
    for path in paths:
        if path.is_dir():
            logs += _logs_below(path)
        elif path.exists():
            logs.append(path)
        else:
            raise LogError(f"{path}: no such log; give a .mcap file, a run folder or a folder of runs")
    return logs


def read_log(path: Path, topics: Collection[str] | None = None) -> Iterator[LogMessage]:
    """Iterates over one run's messages.

    Args:
        path: one file, or one run folder, whose files are joined.
        topics: only these; files of pictures are not opened unless `/camera/image` is among them. None: all.

    Yields:
        Messages in order of log time. What every file repeats at its head (`/run` and so on) comes once.

    Raises:
        LogError: (while iterating) the log is missing, empty, damaged, unfinished, of another kind, or its files
            belong to different runs.
    """
    core, pictures = _files_of(path)
    if topics is not None and PICTURE_TOPIC not in topics and core:
        pictures = []
    streams = [_joined(files, topics) for files in (core, pictures) if files]
    if len(streams) == 1:
        yield from streams[0]
        return
    _check_same_run([core[0], pictures[0]])
    repeated = {name for name, topic in TOPICS.items() if topic.every_file}
    without_heads = (each for each in streams[1] if each.topic not in repeated)
    yield from heapq.merge(streams[0], without_heads, key=attrgetter("log_time_ns"))


def read_run_info(path: Path) -> RunInfo:
    """The `/run` message of a log file or run folder.

    Raises:
        LogError: as `read_log`.
    """
    core, pictures = _files_of(path)
    return _run_info(next(iter(core or pictures)))


def _logs_below(folder: Path) -> list[Path]:
    if _finished(folder):
        return [folder]
    logs = sorted({file.parent for file in folder.rglob("*.mcap")})
    if not logs:
        unfinished = next(folder.rglob(f"*.mcap{ACTIVE_SUFFIX}"), None)
        if unfinished is not None:
            raise LogError(
                f"{unfinished}: its recording runs still or was cut short; wait for its end or choose another"
            )
        raise LogError(f"{folder}: holds no .mcap file; give a log, a run folder or a folder of runs")
    return logs


def _finished(folder: Path) -> list[Path]:
    return sorted(folder.glob("*.mcap"))


def _files_of(path: Path) -> tuple[list[Path], list[Path]]:
    """The files of one run: those with the measurements and those with the pictures."""
    if not path.is_dir():
        if not path.exists():
            raise LogError(f"{path}: no such log; give a .mcap file or a run folder")
        return [path], []
    files = _finished(path)
    if not files:
        raise LogError(f"{path}: holds no finished .mcap file; give a .mcap file or a run folder")
    pictures = [file for file in files if file.name.endswith(".camera.mcap")]
    return [file for file in files if file not in pictures], pictures


def _joined(files: list[Path], topics: Collection[str] | None) -> Iterator[LogMessage]:
    _check_same_run(files)
    repeated = {name for name, topic in TOPICS.items() if topic.every_file}
    for index, file in enumerate(files):
        for each in _read_file(file, topics):
            if index == 0 or each.topic not in repeated:
                yield each


def _check_same_run(files: list[Path]) -> None:
    if len(files) < 2:
        return
    run_ids = {_run_info(file).run_id: file for file in files}
    if len(run_ids) > 1:
        (run_a, file_a), (run_b, file_b) = sorted(run_ids.items())[:2]
        raise LogError(
            f"{file_a.parent}: {file_a.name} belongs to run {run_a}, {file_b.name} to {run_b}; "
            "keep each run in a folder of its own"
        )


def _run_info(file: Path) -> RunInfo:
    first = next(_read_file(file, None))
    if not isinstance(first.message, RunInfo):  # _read_file has made sure of it
        raise LogError(f"{file}: does not begin with /run")
    return first.message


def _read_file(path: Path, topics: Collection[str] | None) -> Iterator[LogMessage]:
    """One file's messages; the first must be `/run`."""
    try:
        with path.open("rb") as stream:
            reader = _FileReader(path, topics)
            for chunk in _chunks(stream, path, path.stat().st_size):
                yield from reader.messages(chunk)
            if not reader.seen_run:
                raise LogError(f"{path}: holds no /run, so it is not a groundsbot log; import it or choose another")
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror or error}") from error


def _chunks(stream: BinaryIO, path: Path, size: int) -> Iterator[bytes]:
    """The uncompressed contents of a file's chunks, checked, up to the end of its data."""
    magic = stream.read(len(MCAP0_MAGIC))
    if not magic:
        raise LogError(f"{path}: is empty (0 bytes); choose another log")
    if magic != MCAP0_MAGIC:
        raise LogError(f"{path}: is not an MCAP file; a log ends in .mcap and is written by record, simulate or import")
    while True:
        offset = stream.tell()
        head = stream.read(_RECORD_HEAD.size)
        if len(head) < _RECORD_HEAD.size:
            raise LogError(f"{path}: ends at byte {offset} before its end mark: cut short or never finished")
        opcode, length = _RECORD_HEAD.unpack(head)
        if length > size - offset:
            raise LogError(f"{path}: damaged at byte {offset}: a record of {length} bytes does not fit in the file")
        if opcode == Opcode.DATA_END:
            return
        if opcode == Opcode.MESSAGE:
            raise LogError(
                f"{path}: message at byte {offset} outside a chunk carries no checksum; rewrite the log in chunks"
            )
        if opcode != Opcode.CHUNK:
            stream.seek(length, 1)
            continue
        if length > _RECORD_LIMIT_BYTES:
            raise LogError(
                f"{path}: chunk at byte {offset} has {length} bytes, limit {_RECORD_LIMIT_BYTES}; rewrite the log"
            )
        yield _uncompressed(stream.read(length), f"{path}: chunk at byte {offset}")


def _uncompressed(record: bytes, where: str) -> bytes:
    try:
        _, _, size, crc = _CHUNK_HEAD.unpack_from(record)
        compression, position = _text(record, _CHUNK_HEAD.size)
        (length,) = _U64.unpack_from(record, position)
        data = record[position + _U64.size : position + _U64.size + length]
        if size > _RECORD_LIMIT_BYTES or len(data) != length:
            raise LogError(f"{where} is damaged: {size} bytes uncompressed, limit {_RECORD_LIMIT_BYTES}")
        if compression == "zstd":
            if zstandard.frame_content_size(data) not in (size, -1):  # else a small chunk could unfold to anything
                raise LogError(f"{where} is damaged: its length is not the {size} bytes it claims")
            data = zstandard.ZstdDecompressor().decompress(data, max_output_size=size)
        elif compression:
            raise LogError(f"{where} is compressed by {compression}; rewrite the log with zstd")
    except (struct.error, UnicodeDecodeError, zstandard.ZstdError) as error:
        raise LogError(f"{where} is damaged: {error}") from error
    if len(data) != size or crc == 0 or zlib.crc32(data) != crc:
        raise LogError(f"{where} is damaged: its checksum does not fit")
    return data


def _text(data: bytes, position: int) -> tuple[str, int]:
    (length,) = _U32.unpack_from(data, position)
    start = position + _U32.size
    if start + length > len(data):
        raise struct.error("a text does not fit in its record")
    return data[start : start + length].decode(), start + length


class _FileReader:
    """Decodes the records of a file's chunks."""

    def __init__(self, path: Path, topics: Collection[str] | None) -> None:
        self._path = path
        self._topics = topics
        self._schemas: dict[int, str] = {}
        # By channel: topic and class, or None where the topic is not wanted.
        self._channels: dict[int, tuple[str, type[Message]] | None] = {}
        self._run_channel: int | None = None
        self.seen_run = False

    def messages(self, chunk: bytes) -> Iterator[LogMessage]:
        try:
            yield from self._messages(chunk)
        except (struct.error, UnicodeDecodeError, DecodeError) as error:
            raise LogError(f"{self._path}: a record cannot be decoded: {error}") from error

    def _messages(self, chunk: bytes) -> Iterator[LogMessage]:
        position, end = 0, len(chunk)
        message_head, head_size, fixed_size = _MESSAGE_HEAD.unpack_from, _MESSAGE_HEAD.size, _MESSAGE_FIXED_BYTES
        channels = self._channels
        while position < end:
            opcode, length = _RECORD_HEAD.unpack_from(chunk, position)
            following = position + _RECORD_HEAD.size + length
            if following > end:
                raise struct.error("a record does not fit in its chunk")
            if opcode == Opcode.MESSAGE:
                if length < fixed_size:
                    raise struct.error(f"a message of {length} bytes")
                _, _, channel, _, log_time_ns, publish_time_ns = message_head(chunk, position)
                if not self.seen_run:
                    self._check_first(channel)
                if channel not in channels:
                    raise LogError(f"{self._path}: damaged: a message on channel {channel}, which is not declared")
                target = channels[channel]
                if target is not None:
                    data = chunk[position + head_size : following]
                    yield LogMessage(target[0], target[1].FromString(data), log_time_ns, publish_time_ns)
            elif opcode == Opcode.SCHEMA:
                self._add_schema(chunk, position + _RECORD_HEAD.size)
            elif opcode == Opcode.CHANNEL:
                self._add_channel(chunk, position + _RECORD_HEAD.size)
            position = following

    def _check_first(self, channel: int) -> None:
        if channel != self._run_channel:
            raise LogError(
                f"{self._path}: does not begin with /run, so it is not a groundsbot log; import it or choose another"
            )
        self.seen_run = True

    def _add_schema(self, chunk: bytes, position: int) -> None:
        (identifier,) = _U16.unpack_from(chunk, position)
        self._schemas[identifier], _ = _text(chunk, position + _U16.size)

    def _add_channel(self, chunk: bytes, position: int) -> None:
        identifier, schema = _U16.unpack_from(chunk, position)[0], _U16.unpack_from(chunk, position + 2)[0]
        name, position = _text(chunk, position + 4)
        encoding, _ = _text(chunk, position)
        topic = TOPICS.get(name)
        if topic is None:  # somebody else's topic beside ours
            self._channels[identifier] = None
            return
        expected, found = topic.schema.DESCRIPTOR.full_name, self._schemas.get(schema, "nothing")
        if found != expected or encoding != "protobuf":
            raise LogError(f"{self._path}: topic {name} holds {found} in {encoding}, must be {expected} in protobuf")
        if name == "/run":
            self._run_channel = identifier
        wanted = self._topics is None or name in self._topics
        self._channels[identifier] = (name, topic.schema) if wanted else None
