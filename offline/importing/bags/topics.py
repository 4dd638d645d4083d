"""Choice of a bag's topics to import: by type, or as named on the command line."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import Final

from groundsbot.calib.foundation import plural
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.importing.bags.reader import BagTopic

ODOMETRY: Final = "nav_msgs/msg/Odometry"
JOINTS: Final = "sensor_msgs/msg/JointState"
APRILTAG_ROS: Final = "apriltag_ros/msg/AprilTagDetectionArray"
APRILTAG_MSGS: Final = "apriltag_msgs/msg/AprilTagDetectionArray"
ISAAC: Final = "isaac_ros_apriltag_interfaces/msg/AprilTagDetectionArray"
TAGS: Final = (APRILTAG_ROS, APRILTAG_MSGS, ISAAC)
IMAGE: Final = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE: Final = "sensor_msgs/msg/CompressedImage"
IMAGES: Final = (IMAGE, COMPRESSED_IMAGE)
CAMERA_INFO: Final = "sensor_msgs/msg/CameraInfo"
IMU: Final = "sensor_msgs/msg/Imu"
TRANSFORMS: Final = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
_MOST_LISTED: Final = 8


@dataclass(frozen=True)
class BagOptions:
    """Options of the command line for bags; None if not given."""

    odometry_topic: str | None = None
    tags_topic: str | None = None
    image_topic: str | None = None
    camera_info_topic: str | None = None
    imu_topic: str | None = None
    left_joint: str | None = None
    right_joint: str | None = None
    base_frame: str | None = None
    camera_frame: str | None = None
    tag_size_m: float | None = None
    receive_times: bool = False

    def __post_init__(self) -> None:
        if self.tag_size_m is not None and not (isfinite(self.tag_size_m) and 0.0 < self.tag_size_m <= 10.0):
            raise OfflineError(f"--tag-size-m is {self.tag_size_m}, must be above 0 and at most 10; correct it")
        if self.tags_topic is not None and self.image_topic is not None:
            raise OfflineError("--tags-topic and --image-topic: tags come from one of them; leave one out")
        if (self.left_joint is None) != (self.right_joint is None):
            raise OfflineError("--left-joint and --right-joint belong together; give both")

    def refuse_any(self, recording: Path, but: Sequence[str] = ()) -> None:
        """Refuse these options for a recording that is not a bag, except those of the names `but`.

        Raises:
            OfflineError: naming those that were given.
        """
        given = [name for name, value in vars(self).items() if value not in (None, False) and name not in but]
        if given:
            flags = " and ".join(f"--{name.replace('_', '-')}" for name in given)
            raise OfflineError(f"{recording}: is not a bag, so {flags} would have no effect; leave it out")


@dataclass(frozen=True)
class ChosenTopics:
    """Topics of odometry and of tags: detections or pictures; that of the yaw rate where it was named.

    Attributes:
        unused_imus: others of that type, if none was named: fused odometry contains what they measured already.
    """

    odometry: BagTopic
    tags: BagTopic
    transforms: tuple[BagTopic, ...]
    camera_infos: tuple[BagTopic, ...]  # several if that of the tags is ambiguous
    imu: BagTopic | None = None
    unused_imus: tuple[str, ...] = ()

    @property
    def has_pictures(self) -> bool:
        """Whether tags must be detected in pictures."""
        return self.tags.msgtype in IMAGES


def choose_topics(path: Path, topics: Sequence[BagTopic], options: BagOptions) -> ChosenTopics:
    """Choose topics by type; Odometry is preferred to JointState, detections to pictures.

    Raises:
        OfflineError: nothing fits, several do, or what was named does not.
    """
    odometry = _topic_of_flag(path, topics, "--odometry-topic", options.odometry_topic, (ODOMETRY, JOINTS))
    odometry = odometry or _only_topic(path, topics, "--odometry-topic", (ODOMETRY,))
    odometry = odometry or _only_topic(path, topics, "--odometry-topic", (JOINTS,))
    if odometry is None:
        raise OfflineError(
            f"{path}: no odometry: no messages of {_types((ODOMETRY, JOINTS))}; it holds {_list_topics(topics)}; "
            "record the robot's odometry or its wheel joints"
        )
    tags = _topic_of_flag(path, topics, "--tags-topic", options.tags_topic, TAGS)
    tags = tags or _topic_of_flag(path, topics, "--image-topic", options.image_topic, IMAGES)
    tags = tags or _only_topic(path, topics, "--tags-topic", TAGS)
    tags = tags or _only_topic(path, topics, "--image-topic", IMAGES)
    if tags is None:
        raise OfflineError(
            f"{path}: no tags: no messages of {_types((*TAGS, *IMAGES))}; it holds {_list_topics(topics)}; record "
            "detections or pictures"
        )
    transforms = tuple(each for each in topics if each.msgtype in TRANSFORMS)
    imu = _topic_of_flag(path, topics, "--imu-topic", options.imu_topic, (IMU,))
    unused = () if imu else tuple(each.name for each in topics if each.msgtype == IMU)
    return ChosenTopics(odometry, tags, transforms, _camera_infos(path, topics, options, tags), imu, unused)


def _camera_infos(path: Path, topics: Sequence[BagTopic], options: BagOptions, tags: BagTopic) -> tuple[BagTopic, ...]:
    """Return the camera_info named; else those that share most leading parts of their name with the topic of tags."""
    named = _topic_of_flag(path, topics, "--camera-info-topic", options.camera_info_topic, (CAMERA_INFO,))
    if named is not None:
        return (named,)
    found = [each for each in topics if each.msgtype == CAMERA_INFO]
    shared = [_n_shared(each.name.split("/"), tags.name.split("/")) for each in found]
    return tuple(each for each, n in zip(found, shared, strict=True) if n == max(shared))


def only_camera_info(path: Path, chosen: ChosenTopics) -> BagTopic | None:
    """Return the only camera_info; None if there is none.

    Raises:
        OfflineError: there are several.
    """
    return _only_topic(path, chosen.camera_infos, "--camera-info-topic", (CAMERA_INFO,))


def _n_shared(a: list[str], b: list[str]) -> int:
    n = 0
    while n < min(len(a), len(b)) and a[n] == b[n]:
        n += 1
    return n


def _topic_of_flag(
    path: Path, topics: Sequence[BagTopic], flag: str, name: str | None, types: tuple[str, ...]
) -> BagTopic | None:
    if name is None:
        return None
    known = [each for each in topics if each.name.lstrip("/") == name.lstrip("/")]
    for each in known:
        if each.msgtype in types:
            return each
    if known:
        raise OfflineError(
            f"{path}: {flag} {name} is of type {known[0].short_type}, must be of {_types(types)}; name another"
        )
    raise OfflineError(
        f"{path}: {flag} {name} has no messages in this bag; it holds {_list_topics(topics)}; name another"
    )


def _only_topic(path: Path, topics: Sequence[BagTopic], flag: str, types: tuple[str, ...]) -> BagTopic | None:
    found = [each for each in topics if each.msgtype in types]
    if len(found) > 1:
        raise OfflineError(f"{path}: {len(found)} topics fit: {_list_topics(found)}; choose one with {flag}")
    return found[0] if found else None


def _types(types: Sequence[str]) -> str:
    return " or ".join(each.replace("/msg/", "/") for each in types)


def _list_topics(topics: Sequence[BagTopic]) -> str:
    listed = [
        f"{each.name} ({each.short_type}, {plural(each.n_messages, 'message')})" for each in topics[:_MOST_LISTED]
    ]
    more = [f"{len(topics) - _MOST_LISTED} more"] if len(topics) > _MOST_LISTED else []
    return ", ".join([*listed, *more]) or "no messages at all"
