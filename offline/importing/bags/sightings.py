"""Tag messages of an imported log: corners if camera and tag sizes are known, else positions."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from scipy.spatial.transform import Rotation

from groundsbot.calib.camera import CameraModel
from groundsbot.calib.errors import CalibError
from groundsbot.calib.foundation import plural
from groundsbot.calib.robot import Robot
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.foundation import Progress
from groundsbot.offline.importing.bags.content import BagContent
from groundsbot.offline.importing.bags.detection import detect_in_bag
from groundsbot.offline.importing.bags.frames import frame_name
from groundsbot.offline.importing.bags.pictures import camera_of
from groundsbot.offline.importing.bags.positions import position_entries
from groundsbot.offline.importing.bags.reader import Bag
from groundsbot.offline.importing.bags.tags import BagPicture, exclusion_lines, with_tf_positions
from groundsbot.offline.importing.bags.topics import (
    APRILTAG_MSGS,
    APRILTAG_ROS,
    BagOptions,
    ChosenTopics,
    only_camera_info,
)
from groundsbot.offline.importing.run_writer import Entry
from groundsbot.offline.measurements import read_robot_file
from groundsbot.onboard.detection import Detection, tag_message
from groundsbot.onboard.log import TagDetections, TagObservations


@dataclass(frozen=True)
class BagCamera:
    """Camera of a bag, its frame (empty if not named), and the source of its calibration."""

    model: CameraModel
    frame: str
    source: str


@dataclass(frozen=True)
class TagEntries:
    """Messages about tags.

    Attributes:
        entries: entries in order of time.
        camera: camera whose pixels the corners are in; None for positions.
        remarks: lines for the user.
    """

    entries: list[Entry]
    camera: CameraModel | None
    remarks: list[str]

    @property
    def tags(self) -> list[tuple[str, int]]:
        """(family, id) of every observation."""
        seen: list[tuple[str, int]] = []
        for _, _, message in self.entries:
            if isinstance(message, TagDetections):
                seen += [(each.family, each.tag_id) for each in message.detections]
            elif isinstance(message, TagObservations):
                seen += [(each.family, each.tag_id) for each in message.observations]
        return seen


def find_camera(path: Path, chosen: ChosenTopics, content: BagContent, robot_file: Path | None) -> BagCamera | None:
    """Return the camera that took the pictures, from robot.yaml, else from CameraInfo; None if not needed or unknown.

    Raises:
        GroundsbotError: there are several, it is not calibrated, or there is none for pictures.
    """
    if chosen.tags.msgtype == APRILTAG_ROS:
        return None  # it sends no corners
    given = read_robot_file(robot_file).camera if robot_file is not None else None
    if given is not None:
        return BagCamera(given, "", f"as in {robot_file}")
    topic = only_camera_info(path, chosen)
    if topic is None:
        if chosen.has_pictures:
            raise OfflineError(
                f"{path}: {chosen.tags.name}: pictures without a sensor_msgs/CameraInfo; record it, or give --robot "
                "with its `camera` set"
            )
        return None
    # The detectors of ROS use rectified pictures; for pictures the topic's name says which they are.
    is_rectified = not chosen.has_pictures or "rect" in chosen.tags.name.rpartition("/image")[2]
    info = content.camera_infos[topic.name]
    camera = camera_of(f"{path}: {topic.name}", info, rectified=is_rectified)
    how = "rectified" if is_rectified else "raw"
    return BagCamera(camera, frame_name(info.header.frame_id), f"{topic.name}, for {how} pictures")


def tag_entries(
    bag: Bag,
    chosen: ChosenTopics,
    content: BagContent,
    robot: Robot,
    in_camera: bool,
    camera: BagCamera | None,
    options: BagOptions,
    progress: Progress,
) -> TagEntries:
    """Return detections, or tags detected in pictures, as messages of our log.

    Args:
        bag: open.
        chosen: its topics.
        content: messages read from it.
        robot: its mount and tag sizes.
        in_camera: whether positions are relative to the camera, else to the base.
        camera: that took the pictures.
        options: options of the command line.
        progress: called with the number of pictures that are done.

    Raises:
        GroundsbotError: no tag was detected, or the camera or a tag size is missing.
    """
    where = f"{bag.path}: {chosen.tags.name}"
    if camera is not None and robot.tags:
        if chosen.has_pictures:
            entries, remarks = detect_in_bag(bag, chosen.tags, camera.model, robot, options, progress)
        else:
            entries, remarks = (
                corner_entries(content.pictures, camera.model, chosen.tags.short_type.partition("/")[0]),
                [],
            )
        found = TagEntries(entries, camera.model, [f"camera: {camera.source}", *remarks])
    elif chosen.has_pictures or options.tag_size_m is not None:
        missing = "their size; give --tag-size-m, or --robot with `tags`" if camera else "a CameraInfo; record it"
        raise OfflineError(f"{where}: placing tags by their corners needs {missing}")
    else:
        found = _positions(where, chosen, content, robot, in_camera)
    if not found.tags:
        raise OfflineError(
            f"{where}: no tag of {', '.join(robot.recorder.families)} was seen in "
            f"{plural(len(found.entries), 'picture')}; is it the right family? see --tag-family"
        )
    check_sizes(where, robot, found)
    said = [f"tags: {chosen.tags.name} ({chosen.tags.short_type})", *exclusion_lines(content.n_excluded)]
    return TagEntries(found.entries, found.camera, [*said, *found.remarks])


def corner_entries(looks: Sequence[BagPicture], camera: CameraModel, detector: str) -> list[Entry]:
    """Return messages for `/tags/detections` of the corners that another program's detector found."""
    return [
        (
            look.stamp_ns,
            "/tags/detections",
            TagDetections(
                stamp_ns=look.stamp_ns,
                frame_sequence=number,
                width_px=camera.width_px,
                height_px=camera.height_px,
                detections=[
                    tag_message(
                        Detection(each.family, each.tag_id, each.hamming, each.decision_margin, each.corners_px)
                    )
                    for each in look.tags
                    if each.corners_px is not None
                ],
                detector=detector,
            ),
        )
        for number, look in enumerate(looks)
    ]


def _positions(where: str, chosen: ChosenTopics, content: BagContent, robot: Robot, in_camera: bool) -> TagEntries:
    """Return the positions that the detector itself computed."""
    looks: Sequence[BagPicture] = content.pictures
    if chosen.tags.msgtype == APRILTAG_MSGS:
        looks = with_tf_positions(looks, content.tag_transforms)
    n = sum(len(look.tags) for look in looks)
    n_placed = sum(each.position_m is not None for look in looks for each in look.tags)
    if not n_placed:
        raise OfflineError(
            f"{where}: has corners but no positions, nor has tf; to place tags by their corners, give --tag-size-m or "
            "--robot, and have a CameraInfo in the bag"
        )
    turned, frame = Rotation.identity(), "base"
    if in_camera:
        turned, frame = (
            Rotation.from_euler("z", -robot.mount.yaw_rad) * robot.mount.T_base_camera.rotation,
            "camera_planar",
        )
    entries, remarks = position_entries(looks, turned, frame)
    if n_placed < n:
        remarks.append(f"{plural(n - n_placed, 'detection')} left out: tf has no position of them")
    hint = "" if chosen.tags.msgtype == APRILTAG_ROS else "; corners are more accurate: give --tag-size-m or --robot"
    return TagEntries(entries, None, [f"positions: as the detector computed them{hint}", *remarks])


def check_sizes(where: str, robot: Robot, found: TagEntries) -> None:
    """Check that the size of each tag with corners is known.

    Raises:
        OfflineError: naming a tag.
    """
    if found.camera is None:
        return
    for family, tag_id in sorted(set(found.tags)):
        try:
            robot.tag_size_m(family, tag_id)
        except CalibError as error:
            raise OfflineError(f"{where}: {error}") from error
