"""One pass over a bag: odometry, tags and transforms with their times; pictures are read later."""

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, TypeVar

from groundsbot.calib.foundation import plural
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.importing.bags.frames import FixedFrames
from groundsbot.offline.importing.bags.reader import Bag, BagMessage, BagTopic
from groundsbot.offline.importing.bags.tags import BagPicture, exclusion_lines, read_picture
from groundsbot.offline.importing.bags.topics import (
    APRILTAG_MSGS,
    CAMERA_INFO,
    IMU,
    TAGS,
    TRANSFORMS,
    BagOptions,
    ChosenTopics,
)

_NS_PER_S: Final = 1_000_000_000
Row = TypeVar("Row")


@dataclass
class BagContent:
    """Messages of a bag.

    Attributes:
        frames: frames from the fixed transforms.
        odometry: (stamp in ns, message), ascending.
        imu: (stamp in ns, message), ascending.
        pictures: pictures with their detections, ascending.
        tag_transforms: (stamp in ns, TransformStamped) that may be tag poses.
        camera_infos: the first message of each such topic.
        n_excluded: number of excluded detections by reason.
        remarks: lines for the user.
    """

    frames: FixedFrames
    odometry: list[tuple[int, Any]] = field(default_factory=list)
    imu: list[tuple[int, Any]] = field(default_factory=list)
    pictures: list[BagPicture] = field(default_factory=list)
    tag_transforms: list[tuple[int, Any]] = field(default_factory=list)
    camera_infos: dict[str, Any] = field(default_factory=dict)
    n_excluded: Counter[str] = field(default_factory=Counter)
    remarks: list[str] = field(default_factory=list)

    @property
    def camera_frames(self) -> set[str]:
        """Frames that detections are given in."""
        return {look.frame for look in self.pictures if look.tags}

    @property
    def base_frame(self) -> str:
        """Child frame of the odometry; empty if its messages name none."""
        return str(getattr(self.odometry[0][1], "child_frame_id", ""))

    def add_transforms(self, message: Any, *, may_be_tags: bool) -> None:  # noqa: ANN401 - made by rosbags
        """Add a message of `/tf` or `/tf_static`."""
        self.frames.add(message)
        if may_be_tags:
            self.tag_transforms += [(_header_ns(t.header), t) for t in message.transforms]


def read_content(bag: Bag, chosen: ChosenTopics, options: BagOptions, family: str) -> BagContent:
    """Read all messages but pictures.

    Args:
        bag: open.
        chosen: topics of it.
        options: options of the command line.
        family: family of the tags where messages do not say.

    Raises:
        OfflineError: the bag is damaged, its messages have no times, or its detections no tags.
    """
    content, clock = BagContent(FixedFrames(str(bag.path))), BagClock(bag.path, options)
    timed = _timed_topics(chosen)
    for each in bag.messages([*timed, *chosen.transforms, *chosen.camera_infos]):
        if each.msgtype in TRANSFORMS:
            content.add_transforms(each.content, may_be_tags=chosen.tags.msgtype == APRILTAG_MSGS)
        elif each.msgtype == CAMERA_INFO:
            content.camera_infos.setdefault(each.topic, each.content)
        elif (stamp_ns := clock.stamp_ns(each)) is None:
            continue
        elif each.msgtype in TAGS:
            look, left_out = read_picture(each.msgtype, each.content, stamp_ns, family)
            content.pictures.append(look)
            content.n_excluded += left_out
        elif each.msgtype == IMU:
            content.imu.append((stamp_ns, each.content))
        else:
            content.odometry.append((stamp_ns, each.content))
    clock.check(timed)
    content.imu, _ = _sort_and_deduplicate(content.imu, [(stamp_ns,) for stamp_ns, _ in content.imu])
    content.odometry, n_odometry = _sort_and_deduplicate(content.odometry, _odometry_keys(content.odometry))
    content.pictures, n_looks = _sort_and_deduplicate(content.pictures, [(look.stamp_ns,) for look in content.pictures])
    if not chosen.has_pictures:
        _require_tags(bag.path, chosen.tags, content)
    content.remarks = clock.remarks()
    for n, topic in ((n_odometry, chosen.odometry), (n_looks, chosen.tags)):
        if n:
            content.remarks.append(f"{topic.name}: {plural(n, 'message')} left out: other messages have the same times")
    return content


def _require_tags(path: Path, topic: BagTopic, content: BagContent) -> None:
    """Check that any detection is of a tag.

    Raises:
        OfflineError: no detection is of a tag.
    """
    if not any(look.tags for look in content.pictures):
        n_pictures = plural(len(content.pictures), "picture")
        reasons = "; ".join([f"no tag was seen in {n_pictures}", *exclusion_lines(content.n_excluded)])
        raise OfflineError(f"{path}: {topic.name}: {reasons}; is it the right topic?")


def _timed_topics(chosen: ChosenTopics) -> list[BagTopic]:
    """Return the topics whose messages are read with their times."""
    tags = [] if chosen.has_pictures else [chosen.tags]
    return [chosen.odometry, *tags, *([] if chosen.imu is None else [chosen.imu])]


class BagClock:
    """Measurement times of messages, from their headers; times of reception if the options ask for them."""

    def __init__(self, path: Path, options: BagOptions) -> None:
        """Start without messages."""
        self._path = path
        self._by_receiving = options.receive_times
        self._stamped: Counter[str] = Counter()
        self._without: Counter[str] = Counter()

    def stamp_ns(self, message: BagMessage) -> int | None:
        """Return the time of a message; None if its header has none."""
        stamp_ns = message.received_ns if self._by_receiving else _header_ns(message.content.header)
        if stamp_ns <= 0:
            self._without[message.topic] += 1
            return None
        self._stamped[message.topic] += 1
        return stamp_ns

    def check(self, topics: list[BagTopic]) -> None:
        """Check that these topics have times.

        Raises:
            OfflineError: one has none.
        """
        for topic in topics:
            if not self._stamped[topic.name]:
                raise OfflineError(
                    f"{self._path}: {topic.name}: the header stamps of {plural(self._without[topic.name], 'message')} "
                    "are 0; give --receive-times for the less exact times at which they were received"
                )

    def remarks(self) -> list[str]:
        """Return what was left out, and which times were used, as lines of text."""
        said = ["times are those at which the bag received the messages"] if self._by_receiving else []
        return said + [
            f"{topic}: {plural(n, 'message')} left out: their header stamps are 0" for topic, n in self._without.items()
        ]


def _sort_and_deduplicate(rows: list[Row], keys: list[tuple[Any, ...]]) -> tuple[list[Row], int]:
    """Return the first row of each key in ascending order, keys beginning with the time; and the number dropped."""
    first = dict(zip(reversed(keys), reversed(rows), strict=True))
    return [first[key] for key in sorted(first)], len(rows) - len(first)


def _odometry_keys(odometry: list[tuple[int, Any]]) -> list[tuple[Any, ...]]:
    """Return keys of time and joint names, as the joints may come in separate messages."""
    return [(stamp_ns, *getattr(message, "name", ())) for stamp_ns, message in odometry]


def _header_ns(header: Any) -> int:  # noqa: ANN401 - made by rosbags
    return int(header.stamp.sec) * _NS_PER_S + int(header.stamp.nanosec)
