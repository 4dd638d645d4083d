"""What a log holds: one table of topics, their schemas and the rates to expect.

A message's log time is when the host received it (or the log's newest time, where that is later: log times never run
backwards in a file); its publish time is the best estimate of when it was measured. The field-by-field description,
with frames, corner order and units, is in `groundsbot.proto`.
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
    "timestamp",
]

_NS_PER_S: Final = 1_000_000_000


@dataclass(frozen=True)
class Topic:
    """One topic of the log."""

    name: str
    schema: type[Message]
    expected_rate_hz: float | None  # None: now and then, or once a file
    every_file: bool = False  # repeated at the head of each file, so that it opens alone


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
    """What an `/events` message can be about."""

    RECORDING_STARTED = "recording_started"
    RECORDING_STOPPED = "recording_stopped"
    WHEEL_GAP = "wheel_gap"
    WHEEL_LINE_REJECTED = "wheel_line_rejected"
    WHEEL_RESET = "wheel_reset"
    WHEEL_SEQUENCE = "wheel_sequence"
    PORT_LOST = "port_lost"
    PORT_CONNECTED = "port_connected"
    NO_WHEEL_DATA = "no_wheel_data"
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
    SALVAGED = "salvaged"
    DETECTED_AGAIN = "detected_again"


def timestamp(stamp_ns: int) -> Timestamp:
    """Foxglove's stamp for one of ours."""
    return Timestamp(seconds=stamp_ns // _NS_PER_S, nanos=stamp_ns % _NS_PER_S)
