"""Bags that cannot become a log: one line that says why and what to do, exit 1, nothing written."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.support.data.drives import HALL, PINHOLE, make_drive, write_drive
from tests.support.data.importing.bags import BagOfLog, good
from tests.support.data.importing.ros_messages import CAMERA, Sent, header, without_definitions, write_bag
from tests.support.programs import Run

DRIVE = make_drive([1.0, 1.5, 0.3], [(0.4, 0.4, 1.0)], step_ns=20_000_000)
SIZE = ["--tag-size-m", "0.15"]

Spoil = Callable[[BagOfLog, Path], Path]


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_drive(tmp_path_factory.mktemp("log"), DRIVE, HALL[:2], camera=PINHOLE)


def alter(
    made: BagOfLog, folder: Path, topic: str, change: Callable[[dict[str, Any]], dict[str, Any]], first: int = 0
) -> Path:
    """The bag with messages of one topic changed, from one of them on."""
    sent, n = [], 0
    for each in made.sent:
        n += each.topic == topic
        sent.append(
            each._replace(fields=each.fields | change(each.fields)) if each.topic == topic and n > first else each
        )
    return write_bag(folder / "drive", sent)


def without_stamps(made: BagOfLog, folder: Path) -> Path:
    return alter(made, folder, "/detections", lambda _: {"header": header(0, CAMERA)})


def other_clock(made: BagOfLog, folder: Path) -> Path:
    return alter(made, folder, "/detections", lambda f: {"header": f["header"] | {"stamp": {"sec": 77}}})


def shorten(name: str, share: float) -> Spoil:
    def spoil(made: BagOfLog, folder: Path) -> Path:
        bag = (made.without("/detections") if name.endswith(".bag") else made).write(folder / name)
        file = bag if bag.is_file() else next(bag.glob("*.mcap"))
        data = file.read_bytes()
        file.write_bytes(data[: int(share * len(data))])
        return file

    return spoil


def broken_index(made: BagOfLog, folder: Path) -> Path:
    """The index points into the middle of nowhere."""
    bag = made.without("/detections").write(folder / "drive.bag")
    data = bytearray(bag.read_bytes())
    at = data.index(b"index_pos=") + len(b"index_pos=")
    data[at : at + 8] = (int.from_bytes(data[at : at + 8], "little") - 1000).to_bytes(8, "little")
    bag.write_bytes(data)
    return bag


def no_metadata(made: BagOfLog, folder: Path) -> Path:
    bag = made.write(folder / "drive")
    (bag / "metadata.yaml").unlink()
    return bag


def unknown_type(made: BagOfLog, folder: Path) -> Path:
    """An unknown detector, in a bag without definitions."""
    renamed = write_bag(folder / "drive_db3", made.sent)
    (database,) = without_definitions(renamed).glob("*.db3")
    for file in (database, renamed / "metadata.yaml"):
        file.write_bytes(file.read_bytes().replace(b"apriltag_msgs/msg", b"somebody_msgs/msg"))
    return renamed


def other_definition(made: BagOfLog, folder: Path) -> Path:
    """CameraInfo without its width, by the definition in the bag."""
    bag = made.write(folder / "drive_db3")
    (database,) = bag.glob("*.db3")
    database.write_bytes(database.read_bytes().replace(b"uint32 width", b"uint32 wodth"))
    return bag


def spoilt_quaternion(made: BagOfLog, folder: Path) -> Path:
    def spoil(fields: dict[str, Any]) -> dict[str, Any]:
        first, *rest = fields["transforms"]
        return {"transforms": [first | {"transform": {"translation": first["transform"]["translation"]}}, *rest]}

    return alter(made, folder, "/tf_static", spoil)


def moving_mount(made: BagOfLog, folder: Path) -> Path:
    """A head that turns between base and camera."""
    (fixed,) = [each for each in made.sent if each.topic == "/tf_static"]
    first, *_ = fixed.fields["transforms"]
    turned = first | {"transform": {"rotation": {"w": 1.0}}}
    also = [Sent("/tf", fixed.msgtype, fixed.received_ns + 5, {"transforms": [turned]})]
    return write_bag(folder / "drive", [*made.sent, *also])


def jump(made: BagOfLog, folder: Path) -> Path:
    return alter(made, folder, "/odom", lambda _: {"pose": {"pose": {"orientation": {"w": 1.0}}}}, first=20)


def with_picture(made: BagOfLog, encoding: str, shape: tuple[int, int]) -> BagOfLog:
    sent = made.without("/detections")
    return sent.picture("mono8", np.zeros(shape, np.uint8), int(made.track.stamps_ns[3])) if encoding else sent


def picture_of_other_encoding(made: BagOfLog, folder: Path) -> Path:
    return alter(with_picture(made, "mono8", (720, 1280)), folder, "/camera/image_raw", lambda _: {"encoding": "32FC1"})


def blank(_fields: dict[str, Any]) -> dict[str, Any]:
    """A CameraInfo as drivers send it of uncalibrated cameras."""
    return {"k": np.zeros(9), "p": np.zeros(12)}


# By case: what is done to a good bag, what is said, and the options besides the size of the tags.
BAD: dict[str, tuple[Spoil, str, *tuple[str, ...]]] = {
    "no odometry": (
        lambda made, folder: made.without("/odom").write(folder / "drive"),
        r"no odometry: no messages of nav_msgs/Odometry or sensor_msgs/JointState; it holds /camera/camera_info",
    ),
    "no detections": (
        lambda made, folder: made.without("/detections").write(folder / "drive"),
        r"no tags: no messages of apriltag_ros/AprilTagDetectionArray or .*sensor_msgs/CompressedImage; it holds",
    ),
    "nothing seen": (
        lambda made, folder: alter(made, folder, "/detections", lambda _: {"detections": []}),
        r"/detections: no tag was seen in 8 pictures",
    ),
    "unknown type": (unknown_type, r"no tags: .*/detections \(somebody_msgs/AprilTagDetectionArray, 8 messages\)"),
    "another definition": (other_definition, r"holds a message that is not as its type should be: .*'width'"),
    "broken index": (broken_index, r"drive\.bag: cannot be read as a bag: .*`rosbag reindex`"),
    "cut short, ROS 1": (shorten("drive.bag", 0.6), r"cannot be read as a bag: .*`rosbag reindex`"),
    "cut short, MCAP": (shorten("drive", 0.7), r"\.mcap: cannot be read as a bag: .*`mcap recover`"),
    "no metadata": (no_metadata, r"has no metadata\.yaml, .*`ros2 bag reindex`"),
    "times of zero": (without_stamps, r"/detections: the header stamps of 8 messages are 0; give --receive-times"),
    "two clocks": (other_clock, r"the tags from 77\.\d+ to 77\.\d+ s; were they stamped by different clocks\?"),
    "two odometry topics": (
        lambda made, folder: made.odometry("/odometry/filtered").write(folder / "drive"),
        r"2 topics fit: /odom \(nav_msgs/Odometry, 51 messages\), /odometry/filtered .*; choose .* --odometry-topic",
    ),
    "two cameras": (
        lambda made, folder: made.apriltag_msgs("/rear/detections", "rear").write(folder / "drive"),
        r"2 topics fit: /detections .*, /rear/detections .*; choose one with --tags-topic",
    ),
    "frames not joined": (
        lambda made, folder: made.without("/tf_static").write(folder / "drive"),
        r"no fixed transforms connect the camera's frame 'camera_optical' to the base 'base_link'; record /tf_static",
    ),
    "a moving mount": (moving_mount, r"to the base 'base_link', since 'camera_link' moves on its parent; record"),
    "a quaternion of zero": (spoilt_quaternion, r"tf to camera_link: .* quaternion has norm 0, must be 1"),
    "no size": (
        lambda made, folder: made.write(folder / "drive"),
        r"/detections: has corners but no positions, nor has tf; .* give --tag-size-m or --robot",
    ),
    "no calibration": (
        lambda made, folder: made.without("/camera/camera_info").write(folder / "drive"),
        r"/detections: placing tags by their corners needs a CameraInfo",
    ),
    "not calibrated": (
        lambda made, folder: alter(made, folder, "/camera/camera_info", blank),
        r"/camera/camera_info: camera camera: fx_px is 0.0 but must be above 0",
    ),
    "odometry reset": (jump, r"/odom: a wheel rolls .* before message 21, faster than 20 m/s; was the odometry"),
    "a pose that is none": (
        lambda made, folder: alter(made, folder, "/odom", lambda _: {"pose": {"pose": {"orientation": {}}}}, first=6),
        r"/odom: the pose of message 7 is invalid",
    ),
    "wheels without names": (
        lambda made, folder: made.without("/odom").joints(names=("a", "b")).write(folder / "drive"),
        r"/joint_states: the wheels' joints cannot be recognised among a, b; give --left-joint and --right-joint",
        "--wheel-radius-m", "0.1", "--track-width-m", "0.5",
    ),
    "wheels of unknown size": (
        lambda made, folder: made.without("/odom").joints().write(folder / "drive"),
        r"/joint_states: the wheels' radius is unknown; give --wheel-radius-m, or --robot",
        "--track-width-m", "0.5",
    ),
    "pictures of another size": (
        lambda made, folder: with_picture(made, "mono8", (480, 640)).write(folder / "drive"),
        r"/camera/image_raw: a picture is 640x480 px, the camera's calibration is for 1280x720 px",
    ),
    "pictures that cannot be read": (picture_of_other_encoding, r"encoded as '32FC1', which is unsupported; use mono8"),
    "our own log": (lambda made, folder: next(made.run.log.glob("*.mcap")), r"cannot be read as a bag"),
    "no such bag": (lambda made, folder: folder / "none.bag", r"none\.bag: does not exist"),
    "a topic that is not there": (
        lambda made, folder: made.write(folder / "drive"),
        r"--odometry-topic /odometry has no messages in this bag; it holds /camera/camera_info",
        "--odometry-topic", "/odometry",
    ),
    "a topic of another type": (
        lambda made, folder: made.write(folder / "drive"),
        r"is of type apriltag_msgs/AprilTagDetectionArray, must be of nav_msgs/Odometry or sensor_msgs/JointState",
        "--odometry-topic", "detections",
    ),
    "ticks in odometry": (
        lambda made, folder: made.write(folder / "drive"),
        r"holds no ticks, so --ticks-per-turn would have no effect", "--ticks-per-turn", "100",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_a_bad_bag_is_one_line_and_nothing_is_written(tmp_path: Path, run: Run, log: Path, name: str) -> None:
    spoil, pattern, *options = BAD[name]
    options += [] if name == "no size" else SIZE
    bag = spoil(good(log), tmp_path)
    outcome = run("import", bag, "-o", tmp_path / "logs", *options)
    assert outcome.code == 1, outcome
    assert outcome.out == ""
    assert outcome.err.count("\n") == 1, outcome.err
    assert re.search(pattern, outcome.err), outcome.err
    assert not (tmp_path / "logs").exists()
