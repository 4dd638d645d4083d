"""Logs put together record by record, as no writer would write them."""

import struct
import zlib
from collections.abc import Callable

import numpy as np
import zstandard
from google.protobuf.message import Message
from mcap.data_stream import RecordBuilder
from mcap.records import Channel, Chunk, DataEnd, Header, Schema
from mcap.writer import MCAP0_MAGIC

from groundsbot.onboard.log.messages import TOPICS, RunInfo
from tests.support.data.logs import ROBOT_YAML, START_NS

LIMIT_BYTES = 1 << 20
MS = 1_000_000
NUMBERS = {name: number for number, name in enumerate(TOPICS, 1)}
_MESSAGE = struct.Struct("<BQHIQQ")


def bytes_of(*records: object) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)  # type: ignore[attr-defined]  # every record has it
    return bytes(builder.end())  # type: ignore[no-untyped-call]  # mcap leaves it unannotated


def declare() -> bytes:
    schemas = [
        Schema(id=number, data=b"", encoding="protobuf", name=TOPICS[name].schema.DESCRIPTOR.full_name)
        for name, number in NUMBERS.items()
    ]
    channels = [
        Channel(id=number, topic=name, message_encoding="protobuf", metadata={}, schema_id=number)
        for name, number in NUMBERS.items()
    ]
    return bytes_of(*schemas, *channels)


def message(topic: str, content: Message | bytes, at_ns: int = START_NS) -> bytes:
    data = content if isinstance(content, bytes) else content.SerializeToString()
    head = _MESSAGE.pack(5, _MESSAGE.size - 9 + len(data), NUMBERS[topic], 0, at_ns, at_ns)
    return head + data


def run(robot_yaml: str = ROBOT_YAML, run_id: str = "r") -> bytes:
    return declare() + message("/run", RunInfo(run_id=run_id, robot_id="gb1", robot_yaml=robot_yaml))


def chunk(records: bytes, compressed: bool = True, claimed: int | None = None) -> bytes:
    data = zstandard.compress(records, 9) if compressed else records
    size = len(records) if claimed is None else claimed
    return bytes_of(Chunk("zstd" if compressed else "", data, START_NS, START_NS, zlib.crc32(records), size))


def log(*chunks: bytes) -> bytes:
    return MCAP0_MAGIC + bytes_of(Header("", "")) + b"".join(chunks) + bytes_of(DataEnd(0))


Content = tuple[str, Message | bytes, int]


def of_messages(*contents: Content, robot_yaml: str = ROBOT_YAML, size_bytes: int = 0, run_id: str = "r") -> bytes:
    """A log of these messages, padded to a little more than `size_bytes`, and as far as readers want it to be."""
    first, rest = run(run_id=run_id), b"".join(message(*each) for each in contents)
    hidden = chunk(first + rest)
    padding = random_bytes(max(len(first + rest) // 23, size_bytes) - len(hidden))
    private = struct.pack("<BQ", 0x80, len(padding)) + padding  # readers pass over it
    return log(chunk(run(robot_yaml, run_id)), chunk(private, compressed=False), hidden)


def random_bytes(count: int) -> bytes:
    return np.random.default_rng(0).bytes(max(0, count))


def full(make: Callable[[int], bytes], start: int = 10_000) -> bytes:
    """As large as the limit lets it be, but for some percent."""
    count, data = start, make(start)
    while not 0.95 * LIMIT_BYTES < len(data) <= LIMIT_BYTES and count < 1 << 22:
        count = int(0.98 * count * LIMIT_BYTES / len(data))
        data = make(count)
    return data
