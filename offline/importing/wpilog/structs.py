"""Payloads of WPILib's structs and number arrays -> numpy arrays."""

from typing import Final

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.importing.wpilog.reader import WpiLog, WpiTopic

# Numbers in one struct, and its schema where nested schemas are written out (all numbers are doubles).
_WIDTHS: Final = {
    "ChassisSpeeds": 3,
    "SwerveModuleState": 2,
    "SwerveModulePosition": 2,
    "Pose2d": 3,
    "Rotation2d": 1,
    "Rotation3d": 4,
    "Transform3d": 7,
}
_SCHEMAS: Final = {
    "ChassisSpeeds": "double vx;double vy;double omega",
    "SwerveModuleState": "double speed;Rotation2d angle",
    "SwerveModulePosition": "double distance;Rotation2d angle",
    "Pose2d": "Translation2d translation;Rotation2d rotation",
    "Rotation2d": "double value",
    "Rotation3d": "Quaternion q",
    "Transform3d": "Translation3d translation;Rotation3d rotation",
}


def struct_name(topic: WpiTopic) -> str:
    """Return the name of a topic's struct, without `[]`; empty where it is none that is known."""
    name = topic.type.removeprefix("struct:").removesuffix("[]")
    return name if topic.type.startswith("struct:") and name in _WIDTHS else ""


def is_array(topic: WpiTopic) -> bool:
    """Whether each record holds any number of structs."""
    return topic.type.endswith("[]")


def read_numbers(log: WpiLog, topic: WpiTopic) -> tuple[IntArray, FloatArray]:
    """Return stamps in ns (N,), ascending, and the numbers (N, K) of each record; older than the clock left out.

    Of records with one stamp the last one counts: it is the value that stayed.

    Raises:
        OfflineError: a record's length does not fit its type or differs from the others', a number is not finite, or
            the schema in the log is another one.
    """
    name = struct_name(topic)
    _check_schema(log, topic, name)
    rows: dict[int, memoryview] = {}
    for stamp_us, payload in log.records(topic):
        size = 8 * _WIDTHS.get(name, 1)
        if (len(payload) != size and not is_array(topic)) or len(payload) % size:
            must = f"a multiple of {size}" if is_array(topic) else str(size)
            raise _record_error(log, topic, stamp_us, f"has {len(payload)} bytes, must have {must}")
        if stamp_us >= 0:
            rows[stamp_us] = payload
    if not rows:
        raise OfflineError(f"{log.path}: {topic.name}: has no record after the robot's start; choose another topic")
    stamps = sorted(rows)
    width = len(rows[stamps[0]])
    for stamp_us in stamps:
        if len(rows[stamp_us]) != width:
            said = f"has {len(rows[stamp_us]) // 8} numbers, the first one has {width // 8}"
            raise _record_error(log, topic, stamp_us, said)
    values = np.frombuffer(b"".join(rows[stamp] for stamp in stamps), dtype="<f8").reshape(len(stamps), width // 8)
    wrong = np.flatnonzero(~np.isfinite(values).all(axis=1))
    if len(wrong):
        raise _record_error(log, topic, stamps[int(wrong[0])], "has a number that is not finite")
    return np.array(stamps, dtype=np.int64) * 1000, values.astype(np.float64)


def last_numbers(log: WpiLog, name: str) -> FloatArray | None:
    """Return the numbers of the last record of a double[] or double topic; None if there is none."""
    topic = log.find(name, "double[]") or log.find(name, "double")
    if topic is None:
        return None
    *_, record = log.records(topic)
    if len(record.payload) % 8:
        raise _record_error(log, topic, record.stamp_us, f"has {len(record.payload)} bytes, must be a multiple of 8")
    return np.frombuffer(record.payload, dtype="<f8").astype(np.float64)


def _check_schema(log: WpiLog, topic: WpiTopic, name: str) -> None:
    schema = log.schema(name) if name else None
    if schema is not None and _normal(schema) != _normal(_SCHEMAS[name]):
        raise OfflineError(
            f"{log.path}: {topic.name}: the log's {name} is {schema[:100]!r}, known is {_SCHEMAS[name]!r}; choose a "
            "topic of another type"
        )


def _normal(schema: str) -> str:
    return ";".join(" ".join(part.split()) for part in schema.split(";") if part.strip())


def _record_error(log: WpiLog, topic: WpiTopic, stamp_us: int, what: str) -> OfflineError:
    return OfflineError(
        f"{log.path}: {topic.name}: the record at {stamp_us * 1e-6:.3f} s {what}; is the log damaged? choose another "
        "topic, or copy it from the robot again"
    )
