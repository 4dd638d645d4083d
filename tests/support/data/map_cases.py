"""Logs for `map`: two short drives past four tags, and copies of them in which something is changed."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from google.protobuf.message import Message

from groundsbot.onboard.log.messages import LogHead, TagDetections
from groundsbot.onboard.log.reading.reader import read_log
from groundsbot.onboard.log.writing.writer import LogWriter
from tests.support.data.drives import START_NS, MadeTag, make_drive, make_robot, write_drive

TAGS = [
    MadeTag(0, (6.0, 1.0, 0.5), np.pi),
    MadeTag(1, (6.0, 2.0, 0.4), np.pi),
    MadeTag(2, (6.0, -1.0, 0.6), np.pi - 0.2),
    MadeTag(3, (5.0, 3.0, 0.45), -2.2),
]
AHEAD = [(0.0, 0.0, 0.5), (0.5, 0.52, 3.0), (0.5, 0.44, 2.0)]
DRIVES = {"a": make_drive([0.0, 0.0, 0.2], AHEAD), "b": make_drive([0.5, 1.0, -0.1], AHEAD)}


def make_logs(folder: Path) -> dict[str, Path]:
    """Both drives, by robot."""
    return {name: write_drive(folder, drive, TAGS, make_robot(name)) for name, drive in DRIVES.items()}


def rewritten(log: Path, folder: Path, change: Callable[[Message], object], head: LogHead | None = None) -> Path:
    """A copy of a log with each message changed in place; those for which `change` is False are left out."""
    entries = list(read_log(log))
    heads: dict[str, Message | Sequence[Message]] = {}
    for entry in entries:
        if change(entry.message) is not False and entry.topic in ("/run", "/camera/calibration", "/tf"):
            heads[entry.topic] = entry.message
    copy = folder / log.name
    with LogWriter(copy, heads | dict(head or {}), START_NS, durable=False) as writer:
        for entry in entries:
            if entry.topic not in heads and change(entry.message) is not False:
                writer.write(entry.topic, entry.message, entry.log_time_ns, entry.publish_time_ns)
    return copy


def splice(parts: list[Path], folder: Path) -> Path:
    """Pictures in turn from several versions of one drive: something in them moves."""
    per_part = [list(read_log(part)) for part in parts]
    pictures = [i for i, entry in enumerate(per_part[0]) if isinstance(entry.message, TagDetections)]
    entries = list(per_part[0])
    for n, i in enumerate(pictures):
        entries[i] = per_part[n * len(parts) // len(pictures)][i]
    heads = {entry.topic: entry.message for entry in entries if entry.topic in ("/run", "/camera/calibration", "/tf")}
    log = folder / "one"
    with LogWriter(log, heads, START_NS, durable=False) as writer:
        for entry in entries:
            if entry.topic not in heads:
                writer.write(entry.topic, entry.message, entry.log_time_ns, entry.publish_time_ns)
    return log
