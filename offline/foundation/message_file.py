"""Writes protobuf messages as an MCAP file with their schemas, for viewers and other tools."""

from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from google.protobuf.message import Message
from mcap.well_known import MessageEncoding
from mcap.writer import CompressionType, Writer
from mcap_protobuf.schema import register_schema

from groundsbot.calib.foundation import atomic_write


class TimedMessage(NamedTuple):
    """One message of a topic; ordered by time, then topic."""

    stamp_ns: int
    topic: str
    message: Message


def write_messages(messages: Iterable[TimedMessage], path: Path) -> None:
    """Write messages in their order, whole or not at all; the same messages give the same bytes.

    Raises:
        OSError: it cannot be written.
    """
    with atomic_write(path) as partial, partial.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.ZSTD)
        writer.start(profile="", library="groundsbot")
        channels: dict[str, int] = {}
        for number, (stamp_ns, topic, message) in enumerate(messages):
            if topic not in channels:
                schema = register_schema(writer, type(message))
                channels[topic] = writer.register_channel(topic, MessageEncoding.Protobuf, schema)
            data = message.SerializeToString(deterministic=True)
            writer.add_message(channels[topic], stamp_ns, data, stamp_ns, sequence=number)
        writer.finish()  # type: ignore[no-untyped-call]  # mcap leaves it unannotated
