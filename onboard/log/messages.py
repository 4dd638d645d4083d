"""The topics of a log, with their schemas and expected rates.

The log time of a message is the time at which the host received it, or the newest log time of the file if that is
later, so that log times never decrease. The publish time is the best estimate of the time of measurement. The fields,
with frames, corner order and units, are described in `groundsbot.proto`.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import lru_cache
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
    "CALIBRATION_TOPIC",
    "DETECTIONS_TOPIC",
    "PICTURE_TOPIC",
    "TOPICS",
    "CameraCalibration",
    "ClockAnchor",
    "CompressedImage",
    "Event",
    "EventKind",
    "FrameTransform",
    "Gyro",
    "LogHead",
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
    "camera_names_in",
    "camera_of",
    "camera_topic",
    "head_messages",
    "is_head_topic",
    "is_picture_topic",
    "timestamp",
    "topic_of",
    "topics_of_cameras",
]

CALIBRATION_TOPIC: Final = "/camera/calibration"
PICTURE_TOPIC: Final = "/camera/image"
DETECTIONS_TOPIC: Final = "/tags/detections"

_NS_PER_S: Final = 1_000_000_000


@dataclass(frozen=True)
class Topic:
    """A topic of the log.

    Attributes:
        name: its name.
        schema: class of its messages.
        every_file: repeated at the head of each file, so that the file can be read alone.
        camera: name of the camera; empty for a robot with one camera, and for other topics.
        kind: name of the topic in the log of a robot with one camera.
    """

    name: str
    schema: type[Message]
    every_file: bool = False
    camera: str = ""
    kind: str = ""

    def __post_init__(self) -> None:
        if not self.kind:
            object.__setattr__(self, "kind", self.name)


TOPICS: Final[dict[str, Topic]] = {
    topic.name: topic
    for topic in (
        Topic("/run", RunInfo, every_file=True),
        Topic(CALIBRATION_TOPIC, CameraCalibration, every_file=True),
        Topic("/tf", FrameTransform, every_file=True),
        Topic("/wheels", WheelEncoders),
        Topic("/gyro", Gyro),
        Topic(DETECTIONS_TOPIC, TagDetections),
        Topic(PICTURE_TOPIC, CompressedImage),
        Topic("/clock", ClockAnchor),
        Topic("/events", Event),
        Topic("/odometry", PlanarOdometry),
        Topic("/tags/observations", TagObservations),
    )
}

_OF_CAMERA: Final = (CALIBRATION_TOPIC, DETECTIONS_TOPIC, PICTURE_TOPIC)
_LONGEST_NAME: Final = 64
_OF_NAMED_CAMERA: Final = re.compile(r"(/camera|/tags)/([a-z][a-z0-9_]{0,15})(/[a-z]+)")

# Messages at the head of each file, by topic; several of a topic where each camera has its own, as on /tf.
LogHead = Mapping[str, Message | Sequence[Message]]


def topic_of(name: str) -> Topic | None:
    """Return the topic with this name, of a log with any names of cameras; None if a log has no such topic."""
    return _topic_of(name) if len(name) <= _LONGEST_NAME else None  # a hostile file may have endless ones


@lru_cache(256)
def _topic_of(name: str) -> Topic | None:
    found = _OF_NAMED_CAMERA.fullmatch(name)
    if found is None:
        return TOPICS.get(name)
    before, camera, after = found.groups()
    kind = before + after
    return replace(TOPICS[kind], name=name, camera=camera, kind=kind) if kind in _OF_CAMERA else None


def camera_topic(kind: str, camera: str) -> str:
    """Return the name of a topic of one camera.

    Args:
        kind: its name in the log of a robot with one camera.
        camera: name of the camera, one of `Robot.camera_names`.
    """
    before, _, after = kind.rpartition("/")
    return f"{before}/{camera}/{after}" if camera else kind


def camera_of(name: str) -> str:
    """Return the name of the camera of a topic; empty for the only camera, and for topics of no camera."""
    topic = topic_of(name)
    return "" if topic is None else topic.camera


@lru_cache(256)
def is_head_topic(name: str) -> bool:
    """Return whether the messages of a topic are repeated at the head of each file."""
    topic = topic_of(name)
    return topic is not None and topic.every_file


@lru_cache(256)
def is_picture_topic(name: str) -> bool:
    """Return whether the messages of a topic are pictures."""
    topic = topic_of(name)
    return topic is not None and topic.kind == PICTURE_TOPIC


def topics_of_cameras(cameras: Sequence[str]) -> tuple[str, ...]:
    """Return the names of the topics of a log, in order; those of TOPICS if no camera has a name."""
    each = [name for name in cameras if name] or [""]
    return tuple(
        name
        for kind in TOPICS
        for name in ([camera_topic(kind, camera) for camera in each] if kind in _OF_CAMERA else [kind])
    )


def camera_names_in(head: LogHead) -> tuple[str, ...]:
    """Return the names of the cameras of a log, in order; one empty name for a robot with one camera, or none."""
    found = [topic_of(name) for name in head]
    return tuple(each.camera for each in found if each is not None and each.camera) or ("",)


def head_messages(head: LogHead) -> Iterator[tuple[str, Message]]:
    """Yield the messages of a head with their topics, in the order of the topics in a log."""
    for topic in topics_of_cameras(camera_names_in(head)):
        messages = head.get(topic, ())
        for message in [messages] if isinstance(messages, Message) else messages:
            yield topic, message


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
