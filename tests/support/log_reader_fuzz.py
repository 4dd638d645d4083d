"""What must hold for any file that is given as a log, judged by a second, slow search for whole chunks."""

import io
import random
import struct
import tempfile
import zlib
from collections import defaultdict
from pathlib import Path
from typing import NamedTuple

import zstandard
from google.protobuf.message import DecodeError
from mcap.writer import CompressionType, IndexType, Writer

from groundsbot.onboard.errors import LogError
from groundsbot.onboard.log import losses as log_losses
from groundsbot.onboard.log.losses import LogLosses
from groundsbot.onboard.log.messages import TOPICS, head_messages
from groundsbot.onboard.log.reading import chunks as chunk_reader
from groundsbot.onboard.log.reading import decoder, record_bytes, summary
from groundsbot.onboard.log.reading import reader as log_reader
from groundsbot.onboard.log.reading.decoder import LogMessage
from groundsbot.onboard.log.reading.reader import read_log
from tests.support.data.logs import Entry, drive, head
from tests.support.guided_fuzz import Target

_READER = (chunk_reader, log_losses, log_reader, summary, decoder, record_bytes)
_LIMIT_BYTES = 64 << 20
_CHUNK = struct.Struct("<BQQQQII")  # code, length, times, size, CRC-32, length of the compression's name


class WholeChunk(NamedTuple):
    """A chunk with the right checksum, wherever in a file it lies."""

    start: int
    end: int
    compression: bytes
    records: bytes


def small_log(entries: list[Entry], compression: CompressionType, *, flush_each: int, indexed: bool = True) -> bytes:
    """As the log writer makes it, but for the schemas, which are left empty to be small."""
    stream = io.BytesIO()
    kinds = IndexType.ALL if indexed else IndexType.NONE
    writer = Writer(stream, compression=compression, index_types=kinds, enable_data_crcs=True)
    writer.start()
    topics = ("/run", "/wheels", "/events", "/tags/detections")
    channels = {
        name: writer.register_channel(
            name, "protobuf", writer.register_schema(TOPICS[name].schema.DESCRIPTOR.full_name, "protobuf", b"")
        )
        for name in topics
    }
    writer.add_message(channels["/run"], 0, dict(head_messages(head()))["/run"].SerializeToString(), 0)
    writer.flush()  # type: ignore[no-untyped-call]  # mcap leaves it unannotated
    for index, entry in enumerate(each for each in entries if each.topic in topics):
        data = entry.message.SerializeToString()
        writer.add_message(channels[entry.topic], entry.log_time_ns, data, entry.publish_time_ns)
        if index % flush_each == flush_each - 1:
            writer.flush()  # type: ignore[no-untyped-call]  # as above
    writer.finish()  # type: ignore[no-untyped-call]  # as above
    return stream.getvalue()


def seeds() -> list[bytes]:
    """Whole and unfinished logs, with and without compression and indices, and what is none."""
    entries = drive(0.3)
    packed = small_log(entries, CompressionType.ZSTD, flush_each=8)
    plain = small_log(entries[:20], CompressionType.NONE, flush_each=5)
    bare = small_log(entries, CompressionType.ZSTD, flush_each=8, indexed=False)
    return [packed, plain, bare, packed[: len(packed) // 2], plain[:1200] + bytes(300), b"", packed[:8]]


def reseal(data: bytes, chance: random.Random) -> bytes:
    """Changes the records in a chunk and gives it a new checksum, so that the change gets past."""
    chunks = whole_chunks(data)
    if not chunks:
        return data
    chosen = chance.choice(chunks)
    records = bytearray(chosen.records)
    for _ in range(chance.randrange(1, 4)):
        at = chance.randrange(len(records) + 1)
        length = chance.choice((1, 1, 2, 8))
        records[at : at + chance.choice((0, length))] = chance.choice((chance.randbytes(length), b"\xff" * length, b""))
    return data[: chosen.start] + chunk_of(bytes(records), chosen.compression) + data[chosen.end :]


def chunk_of(records: bytes, compression: bytes) -> bytes:
    content = zstandard.compress(records) if compression else records
    tail = compression + struct.pack("<Q", len(content)) + content
    return _CHUNK.pack(6, _CHUNK.size - 9 + len(tail), 0, 0, len(records), zlib.crc32(records), len(compression)) + tail


def splice(data: bytes, chance: random.Random) -> bytes:
    """Puts a whole chunk somewhere else, once more, or away."""
    chunks = whole_chunks(data)
    if not chunks:
        return data
    chosen = chance.choice(chunks)
    piece = data[chosen.start : chosen.end]
    rest = data[: chosen.start] + data[chosen.end :] if chance.random() < 0.5 else data
    at = chance.choice([each.start for each in chunks] + [chance.randrange(len(rest) + 1)])
    return rest[:at] + piece * chance.randrange(3) + rest[at:]


def relengthen(data: bytes, chance: random.Random) -> bytes:
    """Changes a length of eight or four bytes, at or near the beginning of a chunk."""
    starts = [each.start for each in whole_chunks(data)] or [8]
    at = chance.choice(starts) + chance.choice((1, 1, 25, 33, 37, 41, 45))
    size = chance.choice((4, 8))
    (old,) = struct.unpack("<Q", data[at : at + size].ljust(8, b"\0"))
    new = chance.choice((old + 1, old - 1, old ^ 1 << chance.randrange(8 * size), 0, 1 << 62, len(data), 1 << 26))
    return data[:at] + struct.pack("<Q", new % (1 << 64))[:size] + data[at + size :]


def check(data: bytes) -> None:
    """Raises if the reader gives a message that no whole chunk holds, or fails in another way than it should."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log.mcap"
        path.write_bytes(data)
        losses = LogLosses()
        found, refused = _read(path, losses)
        strict, strictly_refused = _read(path, None)
    _check_right(found, whole_chunks(data))
    told = [_identity(each) for each in found]
    if strictly_refused is None:
        assert [_identity(each) for each in strict] == told
        assert not losses
    else:
        assert str(path) in strictly_refused
        assert "\n" not in strictly_refused.strip()
        assert losses or refused
    losses.lines()


def _read(path: Path, losses: LogLosses | None) -> tuple[list[LogMessage], str | None]:
    found: list[LogMessage] = []
    try:
        for each in read_log(path, losses=losses):
            found.append(each)
    except LogError as error:
        return found, str(error)
    return found, None


def _identity(each: LogMessage) -> tuple[str, int, int, bytes]:
    return each.topic, each.log_time_ns, each.publish_time_ns, each.message.SerializeToString(deterministic=True)


def _check_right(found: list[LogMessage], chunks: list[WholeChunk]) -> None:
    stored = defaultdict(list)
    for chunk in chunks:
        for times, data in _raw_messages(chunk.records):
            stored[times].append(data)
    for each in found:
        kind = TOPICS[each.topic].schema
        wanted = each.message.SerializeToString(deterministic=True)
        for data in stored[each.log_time_ns, each.publish_time_ns]:
            try:
                if kind.FromString(data).SerializeToString(deterministic=True) == wanted:
                    break
            except DecodeError:
                continue
        else:
            raise AssertionError(f"a message that no whole chunk holds: {each}")


def _raw_messages(records: bytes) -> list[tuple[tuple[int, int], bytes]]:
    messages, at = [], 0
    while at + 9 <= len(records):
        code, length = struct.unpack_from("<BQ", records, at)
        content = records[at + 9 : at + 9 + length]
        if code == 5 and len(content) >= 22:
            messages.append((struct.unpack_from("<QQ", content, 6), content[22:]))
        at += 9 + length
    return messages


def whole_chunks(data: bytes) -> list[WholeChunk]:
    """Every one, by trying every byte."""
    found = []
    at = data.find(b"\x06")
    while at >= 0:
        chunk = _chunk_at(data, at)
        if chunk is not None:
            found.append(chunk)
        at = data.find(b"\x06", at + 1)
    return found


def _chunk_at(data: bytes, at: int) -> WholeChunk | None:
    if at + _CHUNK.size > len(data):
        return None
    _, length, _, _, size, crc, n_name = _CHUNK.unpack_from(data, at)
    end, name_end = at + 9 + length, at + _CHUNK.size + n_name
    if end > len(data) or name_end + 8 > end or size > _LIMIT_BYTES:
        return None
    compression, content = data[at + _CHUNK.size : name_end], data[name_end + 8 : end]
    if struct.unpack_from("<Q", data, name_end)[0] != len(content):
        return None
    try:
        records = zstandard.ZstdDecompressor().decompress(content, max_output_size=size) if compression else content
    except zstandard.ZstdError:
        return None
    if compression not in (b"", b"zstd") or len(records) != size or zlib.crc32(records) != crc:
        return None
    return WholeChunk(at, end, compression, records)


TARGET = Target(check, seeds(), [each.__file__ for each in _READER], (reseal, splice, relengthen), longest=6000)
