"""The finished map as an MCAP file, in which Foxglove, Lichtblick and Rerun show it and replay the drives.

Stamps are those of the run logs, so a log opened beside it shares the time line. Topics differ from those of a log,
since one topic has one schema.
"""

import heapq
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3

from groundsbot.calib.foundation import FloatArray
from groundsbot.calib.geometry import chain_motions, se2
from groundsbot.offline.foundation import TimedMessage, write_messages
from groundsbot.offline.maps.archive import ArchivedSegment
from groundsbot.offline.maps.result import MapResult, RunResult
from groundsbot.offline.maps.scene import TRANSFORMS_TOPIC, frame_of, scene_messages, transform_to
from groundsbot.onboard.log import FrameTransform, RunFrames, timestamp

MAP_FILE: Final = "map.mcap"
_ODOM: Final = "odom"  # of a run: by the wheels (and gyro) alone, from its start


def write_mcap(result: MapResult, path: Path) -> None:
    """Write tags, trajectories and transforms of all components; the same map gives the same bytes.

    Constant content has the first stamp of all runs; each keyframe moves its run's frame at its own stamp.

    Raises:
        OSError: it cannot be written.
    """
    write_messages(_entries(result), path)


def _entries(result: MapResult) -> Iterator[TimedMessage]:
    """Yield all messages in order of time."""
    first_ns = min(int(run.stamps_ns[0]) for run in result.runs)
    yield from scene_messages(result, first_ns)
    for index, component in enumerate(result.components):
        for run in component.runs:
            yield TimedMessage(first_ns, f"/map/{run.name}/keyframes", _keyframes(run, frame_of(index), first_ns))
    archived = {each.name: each for each in result.archived_segments}
    moving = [
        _transforms(run, frame_of(index), archived.get(run.name))
        for index, component in enumerate(result.components)
        for run in component.runs
    ]
    yield from heapq.merge(*moving, key=lambda entry: entry.stamp_ns)


def _transforms(run: RunResult, frame: str, archived: ArchivedSegment | None) -> Iterator[TimedMessage]:
    """Yield map to odom, odom to base and base to camera at each keyframe; map to base without odometry.

    The frames of base and camera are those of the run's log. The camera is repeated because each file of a log begins
    with its pose by robot.yaml. It is one message, which changes with the next keyframe: new ones would take most of
    the time of writing a map.
    """
    name = f"{run.robot_id}_{run.run_id}"
    frames = RunFrames.of(name)
    mounts = {"": run.T_base_camera} if run.T_base_camera is not None else {}
    cameras = {RunFrames.of(name, camera): mount for camera, mount in (run.T_base_cameras or mounts).items()}
    parts = {(frame, frames.base): run.T_map_base}
    if archived is not None:
        odom = f"{run.run}/{_ODOM}"
        T_odom_base = chain_motions(archived.motion, np.zeros(3))
        T_map_odom = se2.compose(run.T_map_base, se2.inverse(T_odom_base))
        parts = {(frame, odom): T_map_odom, (odom, frames.base): T_odom_base}
    still = [transform_to(parent, child, 0, np.zeros(3)) for parent, child in parts]
    message = FrameTransforms(transforms=still + [_camera(mount, frames) for frames, mount in cameras.items()])
    stamps = [each.timestamp for each in message.transforms]
    moving = [(each.translation, each.rotation) for each in message.transforms[: len(parts)]]
    values = _places_and_turns(np.stack([*parts.values()], axis=1))
    for stamp_ns, of_parts in zip(run.stamps_ns.tolist(), values.tolist(), strict=True):
        seconds, nanos = divmod(stamp_ns, 1_000_000_000)
        for stamp in stamps:
            stamp.seconds, stamp.nanos = seconds, nanos
        for (translation, rotation), (x, y, sin, cos) in zip(moving, of_parts, strict=True):
            translation.x, translation.y, rotation.z, rotation.w = x, y, sin, cos
        yield TimedMessage(stamp_ns, TRANSFORMS_TOPIC, message)


def _camera(T_base_camera: FloatArray, frames: RunFrames) -> FrameTransform:
    """Return the transform of a camera's mount, without a stamp."""
    x, y, z, qx, qy, qz, qw = T_base_camera.tolist()
    return FrameTransform(
        timestamp=timestamp(0),
        parent_frame_id=frames.base,
        child_frame_id=frames.camera,
        translation=Vector3(x=x, y=y, z=z),
        rotation=Quaternion(x=qx, y=qy, z=qz, w=qw),
    )


def _keyframes(run: RunResult, frame: str, stamp_ns: int) -> PosesInFrame:
    message = PosesInFrame(timestamp=timestamp(stamp_ns), frame_id=frame)
    for x, y, sin, cos in _places_and_turns(run.T_map_base).tolist():
        pose = message.poses.add()
        place, turn = pose.position, pose.orientation
        place.x, place.y, turn.z, turn.w = x, y, sin, cos
    return message


def _places_and_turns(poses: FloatArray) -> FloatArray:
    """Return (..., 4) x and y of poses (..., 3), and z and w of the quaternions of their headings."""
    half = 0.5 * poses[..., 2]
    return np.stack([poses[..., 0], poses[..., 1], np.sin(half), np.cos(half)], axis=-1)
