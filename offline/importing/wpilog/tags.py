"""Tags of a WPILib log: of PhotonVision, of a Limelight, or transforms beside ids; as corners or as positions."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from groundsbot.calib.foundation import FloatArray, IntArray, plural
from groundsbot.calib.robot import R_LEVEL_OPTICAL, Mount
from groundsbot.calib.tags import family_size
from groundsbot.offline.importing.bags.positions import position_entries
from groundsbot.offline.importing.bags.tags import BagPicture, BagTag, exclusion_lines
from groundsbot.offline.importing.run_writer import Entry
from groundsbot.offline.importing.wpilog.camera_poses import is_camera_poses, read_camera_poses
from groundsbot.offline.importing.wpilog.limelight import is_fiducials, read_fiducials
from groundsbot.offline.importing.wpilog.photon import PhotonFrame, is_photon, read_photon
from groundsbot.offline.importing.wpilog.reader import WpiLog, WpiTopic

# PhotonVision hands on the AprilTag library's corners, whose first pixel reaches from 0 to 1; ours has its centre at 0.
_PIXEL_CENTRE_PX: Final = 0.5
_SEVERAL: Final = "of a picture with several tags, where the camera's pose may come from a field layout"
_TO_OPTICAL: Final = R_LEVEL_OPTICAL.inv()  # of forward, left, up


@dataclass(frozen=True)
class WpiTags:
    """Tags of a topic.

    Attributes:
        pictures: in order of time, with corners in our order and pixels, or positions in the camera's optical frame.
        has_corners: whether they are corners.
        n_excluded: number of tags that were left out, by reason.
        remarks: lines for the user.
    """

    pictures: list[BagPicture]
    has_corners: bool
    n_excluded: Counter[str]
    remarks: tuple[str, ...] = ()

    @property
    def tag_ids(self) -> IntArray:
        """Id of each tag of each picture."""
        return np.array([each.tag_id for look in self.pictures for each in look.tags], dtype=np.int64)

    @property
    def corners_px(self) -> FloatArray:
        """Corners (M, 4, 2) of all tags that have some."""
        found = [each.corners_px for look in self.pictures for each in look.tags if each.corners_px is not None]
        return np.array(found).reshape(-1, 4, 2)

    def lines(self) -> list[str]:
        """Return remarks and what was left out, as lines of text."""
        return [*self.remarks, *exclusion_lines(self.n_excluded)]


def is_tags(topic: WpiTopic) -> bool:
    """Return whether a topic's type is one of those that hold tag detections."""
    return is_photon(topic) or is_fiducials(topic) or is_camera_poses(topic)


def count_tags(log: WpiLog, topic: WpiTopic) -> int:
    """Return the number of tags that a topic saw, known family or not.

    Raises:
        OfflineError: a record is damaged.
    """
    if is_photon(topic):
        return sum(target.tag_id >= 0 for frame in read_photon(log, topic) for target in frame.targets)
    frames = read_fiducials(log, topic)[0] if is_fiducials(topic) else read_camera_poses(log, topic)
    return sum(len(tags) for tags in frames.values())


def read_tags(log: WpiLog, topic: WpiTopic, family: str, with_camera: bool) -> WpiTags:
    """Read a topic of tags.

    Args:
        log: the log.
        topic: topic of the log with tag detections (`is_tags`).
        family: family of the tags; logs do not say it.
        with_camera: whether the camera's intrinsics are known, so that corners are of use.

    Raises:
        OfflineError: a record is damaged.
    """
    if is_photon(topic):
        frames = read_photon(log, topic)
        has_corners = with_camera and any(each.corners_px is not None for frame in frames for each in frame.targets)
        found = _photon_corners(frames, family) if has_corners else _photon_positions(frames, family)
    elif is_fiducials(topic):
        fiducials, has_latency = read_fiducials(log, topic)
        found = _positions(fiducials, family, several_are_measured=True)
        said = "pictures' times are those of publication less tl and cl" if has_latency else "tl is not in the log"
        found = replace(found, remarks=(f"tags: Limelight's angles and distance of each tag; {said}",))
    else:
        found = _positions(read_camera_poses(log, topic), family, several_are_measured=False)
        found = replace(found, remarks=("tags: transforms to single tags, at the times at which they were logged",))
    return found


def positions_in(tags: WpiTags, mount: Mount) -> list[Entry]:
    """Return messages for `/tags/observations`, in the axes of the camera's yaw.

    Args:
        tags: tags with positions.
        mount: mount whose roll and pitch turn the camera's axes.
    """
    turned = Rotation.from_euler("z", -mount.yaw_rad) * mount.T_base_camera.rotation
    entries, _ = position_entries(tags.pictures, turned, "camera_planar")
    return entries


def _photon_corners(frames: Sequence[PhotonFrame], family: str) -> WpiTags:
    """Corners of every tag, several in a picture or not: they are measured, whatever the poses beside them are."""
    excluded: Counter[str] = Counter()
    pictures = []
    for frame in frames:
        tags = []
        for target in frame.targets:
            why_not = _exclusion(target.tag_id, family)
            if why_not is None and target.corners_px is None:
                why_not = "without four corners"
            if why_not is not None or target.corners_px is None:
                excluded[why_not or ""] += 1
                continue
            # Against the clock from the bottom left, as the AprilTag library has them.
            corners_px = target.corners_px[::-1] - _PIXEL_CENTRE_PX
            tags.append(BagTag(family, target.tag_id, corners_px=corners_px))
        pictures.append(BagPicture(frame.stamp_ns, "", tuple(tags)))
    return WpiTags(pictures, True, excluded, ("tags: corners of PhotonVision's results; its poses are not used",))


def _photon_positions(frames: Sequence[PhotonFrame], family: str) -> WpiTags:
    places = {
        frame.stamp_ns: [(each.tag_id, each.forward_left_up_m) for each in frame.targets if each.tag_id >= 0]
        for frame in frames
    }
    found = _positions(places, family, several_are_measured=False)
    said = "tags: camera-to-target of PhotonVision's results, for they have no corners, or the log no cameraIntrinsics"
    return replace(found, remarks=(said,))


def _positions(frames: dict[int, list[tuple[int, FloatArray]]], family: str, *, several_are_measured: bool) -> WpiTags:
    excluded: Counter[str] = Counter()
    pictures = []
    for stamp_ns, seen in frames.items():
        tags = []
        for tag_id, place_m in seen:
            why_not = _exclusion(tag_id, family)
            if len(seen) > 1 and not several_are_measured:
                why_not = _SEVERAL
            elif why_not is None and not (np.isfinite(place_m).all() and place_m[0] > 0.0):
                why_not = "its place is not known"
            if why_not is None:
                tags.append(BagTag(family, tag_id, position_m=_TO_OPTICAL.apply(place_m)))
            else:
                excluded[why_not] += 1
        if tags:
            pictures.append(BagPicture(stamp_ns, "", tuple(tags)))
    return WpiTags(pictures, False, excluded)


def _exclusion(tag_id: int, family: str) -> str | None:
    return None if 0 <= tag_id < family_size(family) else f"a number that {family} does not have"


def seen_line(topic: WpiTopic, tags: WpiTags) -> str:
    """Return a line on what a topic saw."""
    numbers = ", ".join(str(each) for each in np.unique(tags.tag_ids).tolist()[:20])
    return f"camera's topic: {topic.name} ({topic.type}), {plural(len(tags.pictures), 'picture')}, tags {numbers}"
