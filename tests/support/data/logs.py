"""Logs for the tests of faults, and what is in each of their chunks, read by the plain MCAP library."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from google.protobuf.message import Message
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk
from mcap.records import Message as McapMessage
from mcap.stream_reader import StreamReader, breakup_chunk

from groundsbot.calib.camera.model import CameraModel
from groundsbot.calib.robot.robot_yaml import parse_robot_yaml
from groundsbot.onboard.log.head import log_head
from groundsbot.onboard.log.losses import LogLosses
from groundsbot.onboard.log.messages import (
    ClockAnchor,
    CompressedImage,
    Event,
    RunInfo,
    TagDetection,
    TagDetections,
    WheelEncoders,
    timestamp,
)
from groundsbot.onboard.log.reading.reader import read_head, read_log
from groundsbot.onboard.log.reading.record_bytes import RECORD_HEAD
from groundsbot.onboard.log.writing.writer import LogWriter

START_NS = 1_800_000_000_000_000_000
MS = 1_000_000
ROBOT_YAML = """
robot_id: gb1
wheels: {radius_left_m: 0.05, radius_right_m: 0.05, track_m: 0.3, ticks_per_turn: 1024}
tags: [{default_size_m: 0.16}]
"""
CAMERA = CameraModel("camera", 64, 48, 60.0, 60.0, 31.5, 23.5, "plumb_bob", (0.0,) * 5)

HEADS = ("/run", "/camera/calibration", "/tf")

# What can be read of a message without our classes: topic, times, bytes.
Seen = tuple[str, int, int, bytes]


class Entry(NamedTuple):
    """One message to be written."""

    topic: str
    message: Message
    log_time_ns: int
    publish_time_ns: int


def head(run_id: str = "run1") -> dict[str, Message | Sequence[Message]]:
    return log_head(parse_robot_yaml(ROBOT_YAML, "robot.yaml"), ROBOT_YAML, CAMERA, run_id, START_NS, 5)


def wheel_entry(index: int, at_ns: int) -> Entry:
    message = WheelEncoders(stamp_ns=at_ns, sequence=index, ticks_left=7 * index, ticks_right=7 * index, boot_id=3)
    return Entry("/wheels", message, at_ns + MS, at_ns)


def picture_entry(at_ns: int, jpeg: bytes) -> Entry:
    message = CompressedImage(timestamp=timestamp(at_ns), frame_id="camera", data=jpeg, format="jpeg")
    return Entry("/camera/image", message, at_ns + 2 * MS, at_ns)


def drive(seconds: float, wheel_hz: int = 100, picture_hz: int = 0, picture_bytes: int = 3000) -> list[Entry]:
    """A drive's messages in order of log time."""
    rng = np.random.default_rng(5)
    entries = [
        wheel_entry(index, START_NS + index * 1000 * MS // wheel_hz) for index in range(round(seconds * wheel_hz))
    ]
    for index in range(round(seconds * 10)):
        at_ns = START_NS + index * 100 * MS + 5 * MS
        tag = TagDetection(family="tag36h11", tag_id=index % 7, corners_px=rng.uniform(0, 60, 8).tolist())
        found = TagDetections(stamp_ns=at_ns, frame_sequence=index, width_px=64, height_px=48, detections=[tag])
        entries.append(Entry("/tags/detections", found, at_ns + 3 * MS, at_ns))
    for index in range(round(seconds)):
        at_ns = START_NS + index * 1000 * MS
        entries.append(Entry("/clock", ClockAnchor(stamp_ns=at_ns, monotonic_ns=5), at_ns, at_ns))
    entries.append(Entry("/events", Event(stamp_ns=START_NS, kind="recording_started"), START_NS, START_NS))
    for index in range(round(seconds * picture_hz)):
        jpeg = b"\xff\xd8\xff" + rng.bytes(picture_bytes) + b"\xff\xd9"
        entries.append(picture_entry(START_NS + index * 1000 * MS // picture_hz + 5 * MS, jpeg))
    return sorted(entries, key=lambda entry: entry.log_time_ns)


def write_log(path: Path, entries: Sequence[Entry], run_id: str = "run1", finished: bool = True) -> Path:
    """Writes a run folder or one file; an unfinished one is left as a kill would leave it."""
    pictures = any(entry.topic == "/camera/image" for entry in entries)
    writer = LogWriter(path, head(run_id), START_NS, keep_pictures=pictures, durable=False)
    for entry in entries:
        writer.write(*entry)
    if finished:
        writer.close()
    else:
        writer.flush()
    return path


def facts(entries: Sequence[Entry]) -> list[Seen]:
    return [(each[0], each[2], each[3], each[1].SerializeToString(deterministic=True)) for each in entries]


def read_all(path: Path) -> tuple[list[Seen], LogLosses]:
    """What the reader gives of a log, its head left out."""
    losses = LogLosses()
    found = [
        (each.topic, each.log_time_ns, each.publish_time_ns, each.message.SerializeToString(deterministic=True))
        for each in read_log(path, losses=losses)
        if each.topic not in HEADS
    ]
    return found, losses


class ChunkPlace(NamedTuple):
    """One chunk of a file."""

    start: int
    end: int
    messages: list[Seen]


def chunks_of(file: Path) -> list[ChunkPlace]:
    """A whole file's chunks, by the plain library; the head's messages left out."""
    with file.open("rb") as stream:
        records = [record for record in StreamReader(stream, emit_chunks=True).records if isinstance(record, Chunk)]
    topics: dict[int, str] = {}
    contents = []
    for record in records:
        messages = []
        for inner in breakup_chunk(record):
            if isinstance(inner, Channel):
                topics[inner.id] = inner.topic
            elif isinstance(inner, McapMessage) and topics[inner.channel_id] not in HEADS:
                messages.append((topics[inner.channel_id], inner.log_time, inner.publish_time, inner.data))
        contents.append(messages)
    return [ChunkPlace(*place, messages) for place, messages in zip(_places(file.read_bytes()), contents, strict=True)]


def _places(data: bytes) -> Iterator[tuple[int, int]]:
    position = 8
    while True:
        opcode, length = RECORD_HEAD.unpack_from(data, position)
        end = position + RECORD_HEAD.size + length
        if opcode == Opcode.CHUNK:
            yield position, end
        if opcode == Opcode.DATA_END:
            return
        position = end


def run_info_of(log: Path) -> RunInfo:
    """The `/run` message of a log file or run folder, damaged or not."""
    info = read_head(log)["/run"]
    assert isinstance(info, RunInfo)
    return info
