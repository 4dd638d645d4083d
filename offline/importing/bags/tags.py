"""Tag detections of three ROS packages, converted to one form with our order of corners.

- apriltag_ros (ROS 1): no corners; poses with x to the face's right, y to its top, z out of it, as ours.
- apriltag_msgs (ROS 2): corners as the AprilTag library gives them: counter-clockwise from the bottom left, the outer
  corner of the first pixel being (0, 0). Poses, if any, in tf.
- isaac_ros_apriltag: corners clockwise from the top left; pixel coordinates are assumed to be the AprilTag library's.
  Poses, whose axes are not used.

From the sources of AprilRobotics/apriltag_ros (common_functions.cpp), christianrauch/apriltag_ros (AprilTagNode.cpp)
and NVIDIA-ISAAC-ROS/isaac_ros_apriltag (apriltag_node.cpp, which reverses VPI's corners, those of the AprilTag
library). All three detect tags in rectified pictures.
"""

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from groundsbot.calib.foundation import FloatArray, plural
from groundsbot.calib.tags import families, family_size
from groundsbot.offline.importing.bags.frames import frame_name
from groundsbot.offline.importing.bags.topics import APRILTAG_MSGS, APRILTAG_ROS

# Our pixel coordinates, those of OpenCV, have integers at pixel centres.
_PIXEL_CENTRE_PX: Final = 0.5


@dataclass(frozen=True)
class BagTag:
    """One tag in one picture, with its corners, its position, or both.

    Attributes:
        corners_px: (4, 2) in the order of groundsbot.proto.
        position_m: (3,) of its centre in `BagPicture.frame`.
        quaternion_xyzw: quaternion of the tag as groundsbot.proto has it, in `BagPicture.frame`.
        covariance: (3, 3) of the position, unchecked, as in the message.
    """

    family: str
    tag_id: int
    hamming: int = 0
    decision_margin: float = 0.0
    corners_px: FloatArray | None = None
    position_m: FloatArray | None = None
    quaternion_xyzw: tuple[float, float, float, float] | None = None
    covariance: FloatArray | None = None


@dataclass(frozen=True)
class BagPicture:
    """Tags of one picture. `frame` is the camera's optical frame."""

    stamp_ns: int
    frame: str
    tags: tuple[BagTag, ...]


def read_picture(msgtype: str, content: Any, stamp_ns: int, family: str) -> tuple[BagPicture, Counter[str]]:  # noqa: ANN401 - made by rosbags
    """Read one message of detections.

    Args:
        msgtype: one of `bags.topics.TAGS`.
        content: the message.
        stamp_ns: its time.
        family: family of the tags, if the message does not say.

    Returns:
        The picture's tags, and the number of excluded detections by reason.
    """
    frame, found, left_out = frame_name(content.header.frame_id), [], Counter[str]()
    for detection in content.detections:
        if msgtype == APRILTAG_ROS:
            if len(detection.id) != 1:
                left_out["a bundle of several tags"] += 1
                continue
            frame = frame_name(detection.pose.header.frame_id) or frame
            sighting = _with_pose(BagTag(family, int(detection.id[0])), detection.pose.pose, with_rotation=True)
        elif msgtype == APRILTAG_MSGS:
            sighting = BagTag(
                _family(detection.family),
                detection.id,
                detection.hamming,
                detection.decision_margin,
                _corners(detection.corners)[::-1] - _PIXEL_CENTRE_PX,
            )
        else:
            sighting = BagTag(
                _family(detection.family), detection.id, corners_px=_corners(detection.corners) - _PIXEL_CENTRE_PX
            )
            sighting = _with_pose(sighting, detection.pose.pose, with_rotation=False)
        why_not = _exclusion_reason(sighting)
        if why_not is None:
            found.append(sighting)
        else:
            left_out[why_not] += 1
    return BagPicture(stamp_ns, frame, tuple(found)), left_out


def exclusion_lines(left_out: Mapping[str, int]) -> list[str]:
    """Return one line for the user per reason of exclusion."""
    return [f"{plural(number, 'detection')} left out: {why}" for why, number in sorted(left_out.items())]


def with_tf_positions(looks: Sequence[BagPicture], transforms: Iterable[tuple[int, Any]]) -> list[BagPicture]:
    """Return the pictures with tag positions from tf: same stamp, same camera, a child frame that ends in the tag's id.

    Args:
        looks: without positions.
        transforms: (stamp in ns, TransformStamped) of the bag.
    """
    places: dict[tuple[int, str, int], FloatArray] = {}
    for stamp_ns, each in transforms:
        number = re.search(r"(?:^|\D)(\d+)$", each.child_frame_id)
        if number is not None:
            t = each.transform.translation
            key = (stamp_ns, frame_name(each.header.frame_id), int(number[1]))
            places[key] = np.array([t.x, t.y, t.z])
    return [
        replace(
            look,
            tags=tuple(
                replace(each, position_m=places.get((look.stamp_ns, look.frame, each.tag_id))) for each in look.tags
            ),
        )
        for look in looks
    ]


def _with_pose(sighting: BagTag, pose_with_covariance: Any, *, with_rotation: bool) -> BagTag:  # noqa: ANN401
    p, q = pose_with_covariance.pose.position, pose_with_covariance.pose.orientation
    return replace(
        sighting,
        position_m=np.array([p.x, p.y, p.z]),
        quaternion_xyzw=(q.x, q.y, q.z, q.w) if with_rotation else None,
        covariance=np.reshape(pose_with_covariance.covariance, (6, 6))[:3, :3],
    )


def _corners(corners: Any) -> FloatArray:  # noqa: ANN401 - eight numbers in old definitions, four points in new ones
    if isinstance(corners, np.ndarray):
        return np.array(corners, dtype=np.float64).reshape(4, 2)
    return np.array([[corner.x, corner.y] for corner in corners], dtype=np.float64)


def _family(name: str) -> str:
    """Return a family as AprilTag spells it; some packages omit `tag`."""
    return name if name.startswith("tag") else f"tag{name}"


def _exclusion_reason(sighting: BagTag) -> str | None:
    if sighting.family not in families():
        return f"family {sighting.family!r} is unknown"
    if not 0 <= sighting.tag_id < family_size(sighting.family):
        return f"{sighting.family} has no tag {sighting.tag_id}"
    numbers = [each for each in (sighting.corners_px, sighting.position_m) if each is not None]
    if not all(np.isfinite(each).all() for each in numbers):
        return "its corners or position are not finite"
    return None
