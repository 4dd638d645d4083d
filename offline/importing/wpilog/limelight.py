"""Limelight's raw fiducials, with the latency and the mount that it publishes beside them.

A record has seven numbers a tag: id, the two angles of its centre in degrees (to the right, and up), area, distance to
camera and to robot in metres, ambiguity. From Limelight's NetworkTables documentation.
"""

from typing import Final

import numpy as np

from groundsbot.calib.foundation import FloatArray
from groundsbot.calib.robot import Mount
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.importing.wpilog.reader import WpiLog, WpiTopic
from groundsbot.offline.importing.wpilog.structs import last_numbers

_NAME: Final = "rawfiducials"
_NUMBERS: Final = 7
_ID, _RIGHT_DEG, _UP_DEG, _DISTANCE_M = 0, 1, 2, 4
_MOST_DISTANCE_M: Final = 100.0
_MOUNT_NUMBERS: Final = 6
# The mount was entered into the Limelight by hand, from a drawing or a ruler.
_TYPED_SIGMA_M: Final = 0.02
_TYPED_SIGMA_RAD: Final = float(np.radians(1.0))
_LONGEST_LATENCY_MS: Final = 1000.0
Fiducials = list[tuple[int, FloatArray]]  # id, and forward, left, up in m


def is_fiducials(topic: WpiTopic) -> bool:
    """Whether a topic holds raw fiducials."""
    return topic.type == "double[]" and topic.last == _NAME


def read_fiducials(log: WpiLog, topic: WpiTopic) -> tuple[dict[int, Fiducials], bool]:
    """Return the tags of each picture by its stamp in ns, and whether the log has latencies to make stamps of.

    Raises:
        OfflineError: a record does not have the form of raw fiducials.
    """
    latencies = _Latencies(log, topic)
    frames: dict[int, Fiducials] = {}
    for record in log.records(topic):
        if len(record.payload) % (8 * _NUMBERS):
            raise _record_error(
                log, topic, record.stamp_us, f"has {len(record.payload) / 8:g} numbers, must have 7 a tag"
            )
        rows = np.frombuffer(record.payload, dtype="<f8").reshape(-1, _NUMBERS)
        stamp_ns = record.stamp_us * 1000 - latencies.at(record.stamp_us)
        if stamp_ns >= 0:
            frames.setdefault(stamp_ns, [_fiducial(log, topic, record.stamp_us, row) for row in rows])
    return dict(sorted(frames.items())), latencies.are_known


def limelight_mount(log: WpiLog, topic: WpiTopic) -> Mount | None:
    """Return the camera's pose that was typed into the Limelight; None where none was.

    Limelight's robot space has x ahead, y to the right, z up; its pitch is positive upwards.
    """
    typed = last_numbers(log, f"{topic.parent}/camerapose_robotspace")
    if typed is None or len(typed) != _MOUNT_NUMBERS or not np.isfinite(typed).all() or not typed.any():
        return None
    if np.abs(typed[:3]).max() > 10.0 or np.abs(typed[3:]).max() > 360.0:
        return None
    x_m, right_m, z_m = typed[:3].tolist()
    roll_rad, up_rad, yaw_rad = np.radians(typed[3:]).tolist()
    place = {f"{axis}_m_sigma": _TYPED_SIGMA_M for axis in "xyz"}
    turn = {f"{axis}_rad_sigma": _TYPED_SIGMA_RAD for axis in ("roll", "pitch", "yaw")}
    pose = {"x_m": x_m, "y_m": -right_m, "z_m": z_m, "roll_rad": roll_rad, "pitch_rad": -up_rad, "yaw_rad": yaw_rad}
    return Mount(**pose, **place, **turn)


class _Latencies:
    """Latencies of a Limelight: of its pipeline (`tl`) by record, and of its capture (`cl`), which hardly changes."""

    def __init__(self, log: WpiLog, topic: WpiTopic) -> None:
        self._stamps_us, self._pipeline_ms = _series(log, f"{topic.parent}/tl")
        _, capture_ms = _series(log, f"{topic.parent}/cl")
        self._capture_ms = float(capture_ms[-1]) if len(capture_ms) else 0.0
        self.are_known = len(self._pipeline_ms) > 0

    def at(self, stamp_us: int) -> int:
        """Return the latency in ns of a record: the pipeline's nearest in time, as it is published beside."""
        if not self.are_known:
            return 0
        after = int(np.searchsorted(self._stamps_us, stamp_us))
        around = [i for i in (after - 1, after) if 0 <= i < len(self._stamps_us)]
        nearest = min(around, key=lambda i: abs(int(self._stamps_us[i]) - stamp_us))
        return round((float(self._pipeline_ms[nearest]) + self._capture_ms) * 1e6)


def _series(log: WpiLog, name: str) -> tuple[FloatArray, FloatArray]:
    """Return stamps in us, ascending, and values of a double topic; both empty where it has none that can be used."""
    topic = log.find(name, "double")
    pairs = {
        record.stamp_us: float(np.frombuffer(record.payload, dtype="<f8")[0])
        for record in (() if topic is None else log.records(topic))
        if len(record.payload) == 8
    }
    sane = [(at, value) for at, value in sorted(pairs.items()) if 0.0 <= value <= _LONGEST_LATENCY_MS]
    return np.array([at for at, _ in sane], dtype=np.float64), np.array([value for _, value in sane])


def _fiducial(log: WpiLog, topic: WpiTopic, stamp_us: int, row: FloatArray) -> tuple[int, FloatArray]:
    right, up, distance_m = np.radians(row[_RIGHT_DEG]), np.radians(row[_UP_DEG]), row[_DISTANCE_M]
    fits = np.isfinite(row[: _DISTANCE_M + 1]).all() and max(abs(right), abs(up)) < np.pi / 2
    if not fits or not 0.0 < distance_m <= _MOST_DISTANCE_M or row[_ID] != int(row[_ID]):
        raise _record_error(log, topic, stamp_us, f"has a tag {row[: _DISTANCE_M + 1].tolist()}, which is impossible")
    ray = np.array([1.0, -np.tan(right), np.tan(up)])
    return int(row[_ID]), ray * (distance_m / np.linalg.norm(ray))


def _record_error(log: WpiLog, topic: WpiTopic, stamp_us: int, what: str) -> OfflineError:
    return OfflineError(
        f"{log.path}: {topic.name}: the record at {stamp_us * 1e-6:.3f} s {what}; is the log damaged? choose another "
        "topic with --tags-topic"
    )
