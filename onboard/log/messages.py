"""The topics of a log, with their schemas and expected rates.

The log time of a message is the time at which the host received it, or the newest log time of the file if that is
later, so that log times never decrease. The publish time is the best estimate of the time of measurement. The fields,
with frames, corner order and units, are described in `groundsbot.proto`.
"""

from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from google.protobuf.message import Message
from google.protobuf.timestamp_pb2 import Timestamp

from groundsbot.onboard.groundsbot_pb2 import (
    ClockAnchor,
    Event,
    Gyro,
    PlanarOdometry,
    RunInfo,
    Severity,
    StampSource,
    TagDetection,
    TagDetections,
    TagObservation,
    TagObservations,
    WheelEncoders,
    WheelSpeeds,
)

__all__ = [
    "TOPICS",
    "CameraCalibration",
    "ClockAnchor",
    "CompressedImage",
    "Event",
    "EventKind",
    "FrameTransform",
    "Gyro",
    "PlanarOdometry",
    "RunInfo",
    "Severity",
    "StampSource",
    "TagDetection",
    "TagDetections",
    "TagObservation",
    "TagObservations",
    "Topic",
    "WheelEncoders",
    "WheelSpeeds",
    "timestamp",
]

_NS_PER_S: Final = 1_000_000_000


@dataclass(frozen=True)
class Topic:
    """A topic of the log."""

    name: str
    schema: type[Message]
    expected_rate_hz: float | None  # None: irregular, or once per file
    every_file: bool = False  # repeated at the head of each file, so that the file can be read alone


TOPICS: Final[dict[str, Topic]] = {
    topic.name: topic
    for topic in (
        Topic("/run", RunInfo, None, every_file=True),
        Topic("/camera/calibration", CameraCalibration, None, every_file=True),
        Topic("/tf", FrameTransform, None, every_file=True),
        Topic("/wheels", WheelEncoders, 100.0),
        Topic("/gyro", Gyro, None),
        Topic("/tags/detections", TagDetections, 15.0),
        Topic("/camera/image", CompressedImage, None),
        Topic("/clock", ClockAnchor, 1.0),
        Topic("/events", Event, None),
        Topic("/odometry", PlanarOdometry, None),
        Topic("/tags/observations", TagObservations, None),
    )
}


class EventKind(StrEnum):
    """Kinds of `/events` messages."""

    RECORDING_STARTED = "recording_started"
    RECORDING_STOPPED = "recording_stopped"
    WHEEL_GAP = "wheel_gap"
    WHEEL_LINE_REJECTED = "wheel_line_rejected"
    WHEEL_RESET = "wheel_reset"
    WHEEL_SEQUENCE = "wheel_sequence"
    PORT_LOST = "port_lost"
    PORT_CONNECTED = "port_connected"
    NO_WHEEL_DATA = "no_wheel_data"
    GYRO_GAP = "gyro_gap"
    GYRO_SEQUENCE = "gyro_sequence"
    GYRO_SATURATED = "gyro_saturated"
    GYRO_UNREADABLE = "gyro_unreadable"
    GYRO_FROZEN = "gyro_frozen"
    NO_GYRO_DATA = "no_gyro_data"
    CAMERA_LOST = "camera_lost"
    CAMERA_CONNECTED = "camera_connected"
    CAMERA_SETTING = "camera_setting"
    CAMERA_STAMP = "camera_stamp"
    NO_PICTURES = "no_pictures"
    FRAME_DROPPED = "frame_dropped"
    FRAME_UNUSABLE = "frame_unusable"
    FRAME_SIZE = "frame_size"
    DETECTOR_RESTARTED = "detector_restarted"
    CLOCK_STEP = "clock_step"
    MESSAGE_REFUSED = "message_refused"
    DISK = "disk"
    NOTE = "note"
    SALVAGED = "salvaged"
    DETECTED_AGAIN = "detected_again"


def timestamp(stamp_ns: int) -> Timestamp:
    """Return a stamp in ns as a protobuf timestamp."""
    return Timestamp(seconds=stamp_ns // _NS_PER_S, nanos=stamp_ns % _NS_PER_S)
