"""Reader of WPILib's DataLog files: their topics, and the records of each.

The container is described in WPILib's wpiutil/doc/datalog.adoc: a header, then records of little-endian fields whose
lengths the first byte of each record gives. Records of entry 0 start and finish the other entries.
"""

import struct
from array import array
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Final, NamedTuple

from groundsbot.offline.errors import OfflineError

_MAGIC: Final = b"WPILOG"
_VERSION: Final = 0x0100
_HEADER_BYTES: Final = 12
_CONTROL, _START, _FINISH, _METADATA = 0, 0, 1, 2
# A robot that is switched off leaves at most a part of what WPILib writes at once (16 KiB, or one larger record).
_MOST_CUT_BYTES: Final = 1 << 16
# Stamps are microseconds since the robot's start; none is beyond ten years.
_MOST_STAMP_US: Final = 10 * 366 * 86400 * 1_000_000
_MOST_NAME_BYTES: Final = 1 << 12
_WAY_OUT: Final = "copy the log from the robot again"


class WpiTopic(NamedTuple):
    """A topic: its name, the type that the log states, and its number of records."""

    name: str
    type: str
    n_records: int

    @property
    def parent(self) -> str:
        """Name without its last part."""
        return self.name.rpartition("/")[0]

    @property
    def last(self) -> str:
        """Last part of the name, in small letters."""
        return self.name.rpartition("/")[2].lower()


class WpiRecord(NamedTuple):
    """One record: its stamp, negative where the value is older than the robot's clock, and its bytes."""

    stamp_us: int
    payload: memoryview


@dataclass
class _TopicRows:
    """Where the records of one topic are."""

    stamps_us: "array[int]" = field(default_factory=lambda: array("q"))
    offsets: "array[int]" = field(default_factory=lambda: array("q"))
    sizes: "array[int]" = field(default_factory=lambda: array("q"))


class WpiLog:
    """A whole log in memory.

    Attributes:
        path: path of the file.
        topics: those that have records, in order of their names.
        last_stamp_us: the last stamp of any topic.
        n_cut_bytes: bytes after the last whole record.
    """

    def __init__(self, path: Path) -> None:
        """Read a file.

        Raises:
            OfflineError: it is missing, or not a log of WPILib, or damaged other than at its end.
        """
        self.path = path
        self._data = memoryview(_read(path))
        self._rows: dict[tuple[str, str], _TopicRows] = {}
        self._open: dict[int, _TopicRows] = {}
        self.n_cut_bytes = 0
        self._read_records(self._header_end())
        self.topics = [WpiTopic(*key, len(rows.sizes)) for key, rows in sorted(self._rows.items()) if rows.sizes]
        self.last_stamp_us = max((max(rows.stamps_us) for rows in self._rows.values() if rows.sizes), default=0)

    def records(self, topic: WpiTopic) -> Iterator[WpiRecord]:
        """Yield the records of a topic in the order of the file."""
        rows = self._rows[topic.name, topic.type]
        for stamp_us, at, size in zip(rows.stamps_us, rows.offsets, rows.sizes, strict=True):
            yield WpiRecord(stamp_us, self._data[at : at + size])

    def beside(self, topic: WpiTopic, type_: str) -> list[WpiTopic]:
        """Return the topics of a type with the same parent."""
        return self._by_parent[topic.parent, type_]

    @cached_property
    def _by_parent(self) -> dict[tuple[str, str], list[WpiTopic]]:
        found: dict[tuple[str, str], list[WpiTopic]] = defaultdict(list)
        for topic in self.topics:
            found[topic.parent, topic.type].append(topic)
        return found

    def find(self, name: str, type_: str) -> WpiTopic | None:
        """Return the topic of a name and type; None if it has no records."""
        rows = self._rows.get((name, type_))
        return WpiTopic(name, type_, len(rows.sizes)) if rows is not None and rows.sizes else None

    def schema(self, type_name: str) -> str | None:
        """Return the text of a struct's schema as the log has it; None if it has none."""
        for prefix in ("/", "NT:/"):
            topic = self.find(f"{prefix}.schema/struct:{type_name}", "structschema")
            if topic is not None:
                return bytes(next(self.records(topic)).payload).decode("utf-8", "replace")
        return None

    def _header_end(self) -> int:
        data = self._data
        if not len(data):
            raise OfflineError(f"{self.path}: is empty; {_WAY_OUT}")
        if bytes(data[:6]) != _MAGIC[: len(data)]:
            raise OfflineError(
                f"{self.path}: does not begin with WPILOG, so it is not a WPILib data log; give a .wpilog file"
            )
        if len(data) < _HEADER_BYTES:
            raise OfflineError(f"{self.path}: ends within its header, after {len(data)} bytes; {_WAY_OUT}")
        version, extra = struct.unpack_from("<HI", data, len(_MAGIC))
        if version != _VERSION:
            raise OfflineError(
                f"{self.path}: is of DataLog version {version >> 8}.{version & 255}, only 1.0 is known; convert it "
                "with WPILib's DataLogTool"
            )
        if _HEADER_BYTES + extra > len(data):
            raise OfflineError(
                f"{self.path}: its header claims {extra} bytes of text, {len(data) - _HEADER_BYTES} follow; {_WAY_OUT}"
            )
        return _HEADER_BYTES + int(extra)

    def _read_records(self, at: int) -> None:
        data, end = self._data, len(self._data)
        while at < end:
            first = data[at]
            entry_at = at + 1
            size_at = entry_at + (first & 3) + 1
            stamp_at = size_at + (first >> 2 & 3) + 1
            payload_at = stamp_at + (first >> 4 & 7) + 1
            if payload_at > end:
                self._cut(at, "ends within the head of a record")
                return
            entry = int.from_bytes(data[entry_at:size_at], "little")
            size = int.from_bytes(data[size_at:stamp_at], "little")
            if payload_at + size > end:
                self._cut(at, f"claims {size} bytes, {end - payload_at} are left")
                return
            if entry == _CONTROL:
                if not self._control(at, data[payload_at : payload_at + size]):
                    return
            else:
                self._add(at, entry, int.from_bytes(data[stamp_at:payload_at], "little"), payload_at, size)
            at = payload_at + size

    def _add(self, at: int, entry: int, stamp_us: int, payload_at: int, size: int) -> None:
        rows = self._open.get(entry)
        if rows is None:
            raise self._damage(at, f"belongs to entry {entry}, which was never started")
        stamp_us = stamp_us - (1 << 64) if stamp_us >> 63 else stamp_us
        if abs(stamp_us) > _MOST_STAMP_US:
            raise self._damage(at, f"has the stamp {stamp_us * 1e-6:.4g} s, the limit is ten years")
        rows.stamps_us.append(stamp_us)
        rows.offsets.append(payload_at)
        rows.sizes.append(size)

    def _control(self, at: int, payload: memoryview) -> bool:
        """Take a control record; False where the rest of the file is empty space."""
        kind = payload[0] if len(payload) else -1
        if kind == _START:
            self._start(at, payload)
        elif kind == _FINISH and len(payload) == 5:
            self._open.pop(int.from_bytes(payload[1:5], "little"), None)
        elif kind != _METADATA:
            if not any(self._data[at:]):  # a file system that was not unmounted leaves zeros
                self.n_cut_bytes = len(self._data) - at
                return False
            raise self._damage(at, f"is a control record of kind {kind}, must be 0, 1 or 2")
        return True

    def _start(self, at: int, payload: memoryview) -> None:
        texts, place = [], 5
        for _ in range(3):
            length = int.from_bytes(payload[place : place + 4], "little")
            if place + 4 + length > len(payload):
                raise self._damage(at, "starts a topic, and is too short for the topic's name and type")
            texts.append(bytes(payload[place + 4 : place + 4 + length]))
            place += 4 + length
        name, type_, _ = texts
        if max(len(name), len(type_)) > _MOST_NAME_BYTES:
            raise self._damage(at, f"starts a topic whose name has {len(name)} bytes, limit {_MOST_NAME_BYTES}")
        key = (_text(name), _text(type_))
        self._open[int.from_bytes(payload[1:5], "little")] = self._rows.setdefault(key, _TopicRows())

    def _cut(self, at: int, what: str) -> None:
        """End the file before a record that is not whole.

        Raises:
            OfflineError: more is missing than a robot leaves that was switched off.
        """
        self.n_cut_bytes = len(self._data) - at
        if self.n_cut_bytes > _MOST_CUT_BYTES:
            raise self._damage(at, what)

    def _damage(self, at: int, what: str) -> OfflineError:
        return OfflineError(f"{self.path}: is damaged: the record at byte {at} {what}; {_WAY_OUT}")


def is_wpilog(path: Path) -> bool:
    """Whether this looks like a log of WPILib: by its suffix, or by its first bytes."""
    if path.suffix == ".wpilog":
        return True
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(len(_MAGIC)) == _MAGIC


def _read(path: Path) -> bytes:
    if path.is_dir():
        raise OfflineError(f"{path}: is a folder; give one .wpilog file, each is a run of its own")
    try:
        return path.read_bytes()
    except FileNotFoundError as error:
        raise OfflineError(f"{path}: does not exist; give a .wpilog file") from error
    except OSError as error:
        raise OfflineError(f"{path}: cannot be read: {error.strerror}; check the file and its permissions") from error


def _text(encoded: bytes) -> str:
    """Return a name that fits into one line."""
    text = encoded.decode("utf-8", "replace")
    return text if text.isprintable() else text.encode("unicode_escape").decode("ascii")
