"""Packed results of PhotonVision, of 2024 and of 2025 and later, with the camera's calibration beside them.

2024 (and 2023): big-endian; latency, targets, and what the multi-tag solution found, in a packet of fixed length. From
2025 on: little-endian, with the stamps of capture and publication, under a type `photonstruct:PhotonPipelineResult:…`.
From the sources of PhotonVision (photon-targeting, Packet and its serdes).

Each target's camera-to-target is of one tag's corners where it is the picture's only one. Where several are seen,
PhotonVision may compute it from the field layout: it is then no measurement of these tags.
"""

import struct
from dataclasses import dataclass
from struct import Struct
from typing import Final

import numpy as np

from groundsbot.calib.foundation import FloatArray
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.importing.wpilog.reader import WpiLog, WpiRecord, WpiTopic

_STRUCT: Final = "photonstruct:PhotonPipelineResult"
_RAW: Final = ("rawBytes", "raw")
_RAW_NAME: Final = "rawbytes"
_OLD_HEAD: Final = Struct(">dB")
# yaw, pitch, area, skew; id; best and alternative camera-to-target; ambiguity; the smallest rectangle
_OLD_TARGET: Final = Struct(">4di7d7dd8d")
_NEW_HEADS: Final = (Struct("<4q"), Struct("<3q"))  # sequence, capture, publication; since late 2024 the time sync
_NEW_TARGET: Final = Struct("<4diif7d7dd")
_PNP: Final = Struct("<17d")
_ID, _BEST = 4, 5
_LATENCIES_MS: Final = (0.0, 10_000.0)
_N_CORNERS: Final = 4
_FARTHEST_PX: Final = 20_000.0  # beyond any picture


@dataclass(frozen=True)
class PhotonTarget:
    """One tag: its corners (4, 2) as PhotonVision has them, where there are four, and its place in the camera's frame.

    Attributes:
        forward_left_up_m: position of its centre; zeros where PhotonVision did not solve for it.
    """

    tag_id: int
    corners_px: FloatArray | None
    forward_left_up_m: FloatArray


@dataclass(frozen=True)
class PhotonFrame:
    """One picture; `stamp_ns` is when it was taken."""

    stamp_ns: int
    targets: tuple[PhotonTarget, ...]


def is_photon(topic: WpiTopic) -> bool:
    """Whether a topic holds PhotonVision's packed results."""
    return topic.type.startswith(_STRUCT) or (topic.type in _RAW and topic.last == _RAW_NAME)


def read_photon(log: WpiLog, topic: WpiTopic) -> list[PhotonFrame]:
    """Return the pictures in order of time; of two of one time the first, and none from before the robot's start.

    Raises:
        OfflineError: a packet does not have PhotonVision's form.
    """
    is_new = topic.type.startswith(_STRUCT)
    frames: dict[int, PhotonFrame] = {}
    for record in log.records(topic):
        try:
            latency_ms, targets = _new_packet(record.payload) if is_new else _old_packet(record.payload)
        except (struct.error, ValueError) as error:
            raise _packet_error(log, topic, record, f"has no form of PhotonVision's results ({error})") from error
        least, most = _LATENCIES_MS
        if not least <= latency_ms <= most:
            raise _packet_error(log, topic, record, f"claims a latency of {latency_ms:.4g} ms, limit {most:g}")
        stamp_ns = record.stamp_us * 1000 - round(latency_ms * 1e6)
        if stamp_ns >= 0:
            frames.setdefault(stamp_ns, PhotonFrame(stamp_ns, targets))
    return [frames[stamp] for stamp in sorted(frames)]


def _old_packet(data: memoryview) -> tuple[float, tuple[PhotonTarget, ...]]:
    latency_ms, n_targets = _OLD_HEAD.unpack_from(data)
    at, targets = _OLD_HEAD.size, []
    for _ in range(n_targets):
        values = _OLD_TARGET.unpack_from(data, at)
        corners, at = _corners(data, at + _OLD_TARGET.size, ">f8")
        targets.append(_target(values[_ID], values[_BEST : _BEST + 3], corners))
    return latency_ms, tuple(targets)  # the multi-tag solution, and the packet's empty rest, are not read


def _new_packet(data: memoryview) -> tuple[float, tuple[PhotonTarget, ...]]:
    """Read a packet with either head; the right one leaves no bytes unread."""
    error: Exception = ValueError("no head fits")
    for head in _NEW_HEADS:
        try:
            return _new_packet_after(head, data)
        except (struct.error, ValueError) as each:
            error = each
    raise ValueError(str(error))


def _new_packet_after(head: Struct, data: memoryview) -> tuple[float, tuple[PhotonTarget, ...]]:
    _, capture_us, publication_us, *_ = head.unpack_from(data)
    at, targets = head.size + 1, []
    for _ in range(_count(data, head.size)):
        values = _NEW_TARGET.unpack_from(data, at)
        _, at = _corners(data, at + _NEW_TARGET.size, "<f8")
        corners, at = _corners(data, at, "<f8")
        targets.append(_target(values[_ID], values[_BEST + 2 : _BEST + 5], corners))
    if _count(data, at):  # a multi-tag solution follows
        at += _PNP.size + 1
        at += 1 + 2 * _count(data, at)
    else:
        at += 1
    if at != len(data):
        raise ValueError(f"{len(data)} bytes, {at} expected")
    return (publication_us - capture_us) * 1e-3, tuple(targets)


def _count(data: memoryview, at: int) -> int:
    if at >= len(data):
        raise ValueError("it ends too early")
    return data[at]


def _corners(data: memoryview, at: int, kind: str) -> tuple[FloatArray, int]:
    n = _count(data, at)
    end = at + 1 + 16 * n
    if end > len(data):
        raise ValueError("it ends too early")
    return np.frombuffer(data[at + 1 : end], dtype=kind).astype(np.float64).reshape(n, 2), end


def _target(tag_id: int, place_m: tuple[float, ...], corners_px: FloatArray) -> PhotonTarget:
    has_corners = len(corners_px) == _N_CORNERS and bool((np.abs(corners_px) < _FARTHEST_PX).all())
    return PhotonTarget(tag_id, corners_px if has_corners else None, np.array(place_m))


def _packet_error(log: WpiLog, topic: WpiTopic, record: WpiRecord, what: str) -> OfflineError:
    return OfflineError(
        f"{log.path}: {topic.name}: the packet at {record.stamp_us * 1e-6:.3f} s {what}; known are those of 2024 and "
        "later, choose another topic with --tags-topic"
    )
