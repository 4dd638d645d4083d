"""What Foxglove and Lichtblick show of a run beside its log and map.mcap: outlines of tags, wheel speeds, a layout.

docs/formats.md describes topics and frames.
"""

import heapq
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path
from typing import Final

import numpy as np
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from foxglove_schemas_protobuf.Point2_pb2 import Point2
from foxglove_schemas_protobuf.PointsAnnotation_pb2 import PointsAnnotation
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.TextAnnotation_pb2 import TextAnnotation
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3

from groundsbot.offline.errors import OfflineError
from groundsbot.offline.foundation import TimedMessage, write_messages
from groundsbot.offline.maps import Component, RunResult
from groundsbot.offline.measurements import load_run
from groundsbot.onboard.log import (
    FrameTransform,
    LogLosses,
    RunFrames,
    TagDetections,
    WheelSpeeds,
    read_head,
    read_log,
    timestamp,
)

LAYOUT_FILE: Final = "foxglove_layout.json"
OUTLINES_TOPIC: Final = "/view/tags"
SPEEDS_TOPIC: Final = "/view/wheels"
TRANSFORMS_TOPIC: Final = "/view/tf"

_SPEED_STEP_NS: Final = 100_000_000
# Foxglove's pixel coordinates begin at the edge of the first pixel, those of a log in its middle.
_PIXEL_CENTRE_PX: Final = 0.5
_CORNERS: Final = 4
_COLOR: Final = Color(r=0.0, g=0.9, b=0.4, a=1.0)
_BACKGROUND: Final = Color(r=0.0, g=0.0, b=0.0, a=0.6)
_LINE_PX: Final = 2.0
_TEXT_PX: Final = 18.0


def write_foxglove(component: Component, folder: Path) -> None:
    """Write `<run>.mcap` for each run, from its log, and the layout of panels, into an existing folder.

    Raises:
        GroundsbotError: a log is not where it was when the map was made, or cannot be read.
        OSError: a file cannot be written.
    """
    layout = files("groundsbot.offline.export.assets") / LAYOUT_FILE
    (folder / LAYOUT_FILE).write_bytes(layout.read_bytes())
    for run in {each.run: each for each in component.runs}.values():
        if not run.log.exists():
            raise OfflineError(
                f"--format foxglove: {run.log}: no such log, of which run {run.run} was mapped; run `export` in the "
                "folder in which `map` ran, with the log where it was"
            )
        messages = heapq.merge(_links(run), _outlines(run), _speeds(run), key=lambda each: each.stamp_ns)
        write_messages(messages, folder / f"{run.run}.mcap")


def _links(run: RunResult) -> Iterator[TimedMessage]:
    """Yield the identity from the log's frame of the base to the map's, where an older program wrote another."""
    mount = read_head(run.log).get("/tf")
    base = RunFrames.of(run.run).base
    if isinstance(mount, FrameTransform) and mount.parent_frame_id != base:
        link = FrameTransform(
            timestamp=mount.timestamp,
            parent_frame_id=base,
            child_frame_id=mount.parent_frame_id,
            translation=Vector3(),
            rotation=Quaternion(w=1.0),
        )
        yield TimedMessage(mount.timestamp.ToNanoseconds(), TRANSFORMS_TOPIC, FrameTransforms(transforms=[link]))


def _outlines(run: RunResult) -> Iterator[TimedMessage]:
    """Yield the outlines of the tags in each picture; none where it saw none, which removes those before."""
    # What is lost of a log is said by `map`.
    for each in read_log(run.log, topics=["/tags/detections"], losses=LogLosses()):
        if isinstance(each.message, TagDetections):
            yield TimedMessage(each.log_time_ns, OUTLINES_TOPIC, _annotations(each.message))


def _annotations(picture: TagDetections) -> ImageAnnotations:
    stamp = timestamp(picture.stamp_ns)  # equal to the picture's: viewers match both by it
    message = ImageAnnotations(timestamp=stamp)
    for tag in picture.detections:
        if len(tag.corners_px) != 2 * _CORNERS:  # as `map` reads it
            continue
        corners = np.reshape(tag.corners_px, (_CORNERS, 2)) + _PIXEL_CENTRE_PX
        points = [Point2(x=x, y=y) for x, y in corners.tolist()]
        message.points.append(
            PointsAnnotation(
                timestamp=stamp,
                type=PointsAnnotation.LINE_LOOP,
                points=points,
                outline_color=_COLOR,
                thickness=_LINE_PX,
            )
        )
        message.texts.append(
            TextAnnotation(
                timestamp=stamp,
                position=max(points, key=lambda point: point.y),
                text=str(tag.tag_id),
                font_size=_TEXT_PX,
                text_color=_COLOR,
                background_color=_BACKGROUND,
            )
        )
    return message


def _speeds(run: RunResult) -> Iterator[TimedMessage]:
    """Yield the mean speeds of the wheels over steps of 0.1 s."""
    for segment in load_run(run.log).wheel_segments:
        stamps_ns = np.arange(segment.stamps_ns[0], segment.stamps_ns[-1] + 1, _SPEED_STEP_NS)
        speeds_m_s = np.diff(np.stack(segment.at(stamps_ns)), axis=-1) * (1e9 / _SPEED_STEP_NS)
        for stamp_ns, left, right in zip(stamps_ns[1:].tolist(), *speeds_m_s.tolist(), strict=True):
            message = WheelSpeeds(stamp_ns=stamp_ns, left_m_s=left, right_m_s=right)
            yield TimedMessage(stamp_ns, SPEEDS_TOPIC, message)
