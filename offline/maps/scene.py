"""Messages that show a map in Foxglove, Lichtblick and Rerun: tags, drives, and where robots are."""

import itertools
from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

import numpy as np
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.CylinderPrimitive_pb2 import CylinderPrimitive
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.KeyValuePair_pb2 import KeyValuePair
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.Point3_pb2 import Point3
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from foxglove_schemas_protobuf.SpherePrimitive_pb2 import SpherePrimitive
from foxglove_schemas_protobuf.TextPrimitive_pb2 import TextPrimitive
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3

from groundsbot.calib.foundation import FloatArray
from groundsbot.offline.foundation import TimedMessage
from groundsbot.offline.maps.result import Component, MapResult, RunResult, TagResult
from groundsbot.offline.maps.shape import SIGMAS_95, drawn_covariances, shape_of
from groundsbot.onboard.log import FrameTransform, RunFrames, timestamp

TRANSFORMS_TOPIC: Final = "/map/tf"
TAGS_TOPIC: Final = "/map/tags"
RUNS_TOPIC: Final = "/map/runs"

_TAG_DIAMETER_M: Final = 0.1
_ELLIPSE_THICKNESS_M: Final = 0.002
_LINE_PX: Final = 2.0
_TEXT_M: Final = 0.2
_TAG_COLOR: Final = Color(r=0.9, g=0.6, b=0.0, a=1.0)
_ELLIPSE_COLOR: Final = Color(r=0.9, g=0.6, b=0.0, a=0.35)
# Okabe and Ito's, distinguishable with any colour vision, on light and dark.
_RUN_COLORS: Final = tuple(
    Color(r=r / 255.0, g=g / 255.0, b=b / 255.0, a=1.0)
    for r, g, b in ((0, 114, 178), (213, 94, 0), (0, 158, 115), (204, 121, 167), (86, 180, 233), (240, 228, 66))
)


class RobotPose(NamedTuple):
    """Where a robot is in a map.

    Attributes:
        run: name of the robot's run, robot id and run id joined by `_`.
        frame: frame of the map, from `frame_of`.
        stamp_ns: time on the run's clock.
        T_map_base: (3,) x_m, y_m, theta_rad.
    """

    run: str
    frame: str
    stamp_ns: int
    T_map_base: FloatArray


def frame_of(component: int) -> str:
    """Return the frame of a component: `map`; others, with no transform to it, have `map2`, `map3`, ..."""
    return "map" if component == 0 else f"map{component + 1}"


def scene_messages(result: MapResult, stamp_ns: int) -> Iterator[TimedMessage]:
    """Yield tags and driven lines of each component."""
    colors = itertools.cycle(_RUN_COLORS)
    for index, component in enumerate(result.components):
        frame = frame_of(index)
        suffix = "" if index == 0 else f"/{frame}"
        yield TimedMessage(stamp_ns, TAGS_TOPIC + suffix, _tags_scene(component, frame, stamp_ns))
        lines = [_line(run, frame, stamp_ns, color) for run, color in zip(component.runs, colors, strict=False)]
        yield TimedMessage(stamp_ns, RUNS_TOPIC + suffix, SceneUpdate(entities=lines))


def robot_messages(robots: Sequence[RobotPose]) -> Iterator[TimedMessage]:
    """Yield the transforms from the map to robots, and the pose of each; one robot at least."""
    transforms = [
        transform_to(each.frame, RunFrames.of(each.run).base, each.stamp_ns, each.T_map_base) for each in robots
    ]
    newest_ns = max(each.stamp_ns for each in robots)
    yield TimedMessage(newest_ns, TRANSFORMS_TOPIC, FrameTransforms(transforms=transforms))
    for each in robots:
        message = PoseInFrame(
            timestamp=timestamp(each.stamp_ns), frame_id=each.frame, pose=planar_pose(*each.T_map_base.tolist())
        )
        yield TimedMessage(each.stamp_ns, f"/map/{each.run}/pose", message)


def transform_to(parent: str, child: str, stamp_ns: int, T_parent_child: FloatArray) -> FrameTransform:
    """Return the transform of a planar pose (3,)."""
    x_m, y_m, theta_rad = T_parent_child.tolist()
    return FrameTransform(
        timestamp=timestamp(stamp_ns),
        parent_frame_id=parent,
        child_frame_id=child,
        translation=Vector3(x=x_m, y=y_m, z=0.0),
        rotation=rotation_about_z(theta_rad),
    )


def _line(run: RunResult, frame: str, stamp_ns: int, color: Color) -> SceneEntity:
    line = LinePrimitive(
        type=LinePrimitive.LINE_STRIP,
        pose=planar_pose(0.0, 0.0, 0.0),
        thickness=_LINE_PX,
        scale_invariant=True,
        color=color,
    )
    line.points.extend(Point3(x=x, y=y, z=0.0) for x, y in run.T_map_base[:, :2].tolist())
    said = {"run": run.name, "robot": run.robot_id, "distance_m": f"{run.distance_m:.3f}"}
    entity = _entity(run.name, frame, stamp_ns, said)
    entity.lines.append(line)
    return entity


def _tags_scene(component: Component, frame: str, stamp_ns: int) -> SceneUpdate:
    is_shape = shape_of(component) is not None
    relative_to = "the other tags" if is_shape else component.frame_name
    drawn = drawn_covariances(component)
    return SceneUpdate(
        entities=[
            _tag(tag, covariance, relative_to, frame, stamp_ns)
            for tag, covariance in zip(component.tags, drawn, strict=True)
        ]
    )


def _tag(tag: TagResult, drawn: FloatArray, relative_to: str, frame: str, stamp_ns: int) -> SceneEntity:
    """Return a ball, its 95 % ellipse on the floor plan, and its id; at z = 0 if the map has no height."""
    x, y = tag.position_m.tolist()
    z_m = 0.0 if tag.pose is None else tag.pose.height_m
    ball = SpherePrimitive(
        pose=Pose(position=Vector3(x=x, y=y, z=z_m), orientation=_orientation(tag)),
        size=Vector3(x=_TAG_DIAMETER_M, y=_TAG_DIAMETER_M, z=_TAG_DIAMETER_M),
        color=_TAG_COLOR,
    )
    text = TextPrimitive(
        pose=Pose(position=Vector3(x=x, y=y, z=z_m + _TAG_DIAMETER_M), orientation=rotation_about_z(0.0)),
        billboard=True,
        font_size=_TEXT_M,
        color=_TAG_COLOR,
        text=tag.label,
    )
    sigma_x_m, sigma_y_m = np.sqrt(np.diag(tag.covariance)).tolist()
    drawn_x_m, drawn_y_m = np.sqrt(np.maximum(np.diag(drawn), 0.0)).tolist()
    said = {
        "family": tag.family,
        "tag_id": str(tag.tag_id),
        "instance": tag.instance,
        "sigma_x_m": f"{sigma_x_m:.4f}",
        "sigma_y_m": f"{sigma_y_m:.4f}",
        "ellipse": f"95 %, relative to {relative_to}",
        "ellipse_sigma_x_m": f"{drawn_x_m:.4f}",
        "ellipse_sigma_y_m": f"{drawn_y_m:.4f}",
        "n_observations": str(tag.n_observations),
        "runs": " ".join(tag.runs),
    }
    entity = _entity(tag.full_label, frame, stamp_ns, said)
    if tag.pose is not None:
        entity.metadata.append(KeyValuePair(key="height_m", value=f"{tag.pose.height_m:.4f}"))
    entity.spheres.append(ball)
    entity.texts.append(text)
    if np.isfinite(drawn).all():
        entity.cylinders.append(_ellipse(tag, drawn))
    return entity


def _orientation(tag: TagResult) -> Quaternion:
    """Return R_map_tag, z out of the face; identity if the map has none."""
    if tag.pose is None:
        return rotation_about_z(0.0)
    x, y, z, w = tag.pose.quaternion_xyzw.tolist()
    return Quaternion(x=x, y=y, z=z, w=w)


def _ellipse(tag: TagResult, covariance: FloatArray) -> CylinderPrimitive:
    """Return the 95 % ellipse as a flat cylinder."""
    variances, axes = np.linalg.eigh(covariance)
    minor_m, major_m = (2.0 * SIGMAS_95 * np.sqrt(np.maximum(variances, 0.0))).tolist()
    x, y = tag.position_m.tolist()
    return CylinderPrimitive(
        pose=planar_pose(x, y, float(np.arctan2(axes[1, 1], axes[0, 1]))),
        size=Vector3(x=major_m, y=minor_m, z=_ELLIPSE_THICKNESS_M),
        bottom_scale=1.0,
        top_scale=1.0,
        color=_ELLIPSE_COLOR,
    )


def _entity(name: str, frame: str, stamp_ns: int, said: dict[str, str]) -> SceneEntity:
    """Return an entity without primitives that never expires (lifetime zero)."""
    metadata = [KeyValuePair(key=key, value=value) for key, value in said.items()]
    return SceneEntity(timestamp=timestamp(stamp_ns), frame_id=frame, id=name, metadata=metadata)


def planar_pose(x_m: float, y_m: float, theta_rad: float) -> Pose:
    """Return a pose on the floor."""
    return Pose(position=Vector3(x=x_m, y=y_m, z=0.0), orientation=rotation_about_z(theta_rad))


def rotation_about_z(theta_rad: float) -> Quaternion:
    """Return a rotation about z."""
    half = 0.5 * theta_rad
    return Quaternion(x=0.0, y=0.0, z=float(np.sin(half)), w=float(np.cos(half)))
