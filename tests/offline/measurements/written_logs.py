"""Logs written message by message, and the refusal of one."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import pytest
from google.protobuf.message import Message

from groundsbot.calib.errors import GroundsbotError
from groundsbot.offline.measurements.run import RobotFile, load_run
from groundsbot.onboard.log.head import log_head
from groundsbot.onboard.log.messages import LogHead, PlanarOdometry, TagDetection, TagDetections, WheelEncoders
from groundsbot.onboard.log.writing.writer import LogWriter
from tests.support.data.drives import CAMERA, FAMILY, START_NS, S, make_robot

ROBOT = make_robot(wheels={"radius_left_m": 0.1, "radius_right_m": 0.11, "track_m": 0.5, "ticks_per_turn": 1000.0})
CORNERS = [100.0, 100.0, 140.0, 100.0, 140.0, 140.0, 100.0, 140.0]


def write_log(
    folder: Path,
    messages: Sequence[tuple[str, Message]],
    head: LogHead | None = None,
    run_id: str = "one",
) -> Path:
    """Messages in the order given, a millisecond apart."""
    log = folder / run_id
    heads = head or log_head(ROBOT, ROBOT.model_dump_json(), CAMERA, run_id, START_NS, 0)
    with LogWriter(log, heads, START_NS, durable=False) as writer:
        for i, (topic, message) in enumerate(messages):
            writer.write(topic, message, START_NS + 1_000_000 * i, START_NS + 1_000_000 * i)
    return log


def wheels(at_s: float, left: int, right: int, boot: int = 1) -> tuple[str, WheelEncoders]:
    stamp_ns = START_NS + round(at_s * S)
    return "/wheels", WheelEncoders(stamp_ns=stamp_ns, boot_id=boot, ticks_left=left, ticks_right=right)


def picture(at_s: float, *tags: TagDetection, size: tuple[int, int] = (1280, 720)) -> tuple[str, TagDetections]:
    stamp_ns = START_NS + round(at_s * S)
    return "/tags/detections", TagDetections(
        stamp_ns=stamp_ns, width_px=size[0], height_px=size[1], detections=list(tags)
    )


def tag(tag_id: int, family: str = FAMILY, hamming: int = 0, corners: Sequence[float] = CORNERS) -> TagDetection:
    return TagDetection(family=family, tag_id=tag_id, hamming=hamming, corners_px=corners)


def wheel_odometry(at_s: float, left_m: float, right_m: float) -> tuple[str, PlanarOdometry]:
    distances = PlanarOdometry.WheelDistances(left_m=left_m, right_m=right_m)
    return "/odometry", PlanarOdometry(stamp_ns=START_NS + round(at_s * S), wheels=distances)


def pose_odometry(at_s: float, x_m: float, y_m: float, theta_rad: float) -> tuple[str, PlanarOdometry]:
    pose = PlanarOdometry.PoseInOdom(x_m=x_m, y_m=y_m, theta_rad=theta_rad)
    return "/odometry", PlanarOdometry(stamp_ns=START_NS + round(at_s * S), pose=pose)


def refusal(log: Path, robot_files: Mapping[str, RobotFile] | None = None) -> str:
    with pytest.raises(GroundsbotError) as caught:
        load_run(log, robot_files)
    text = str(caught.value)
    assert str(log) in text
    assert "\n" not in text
    return text


TWO_OBSERVATIONS = [wheels(0.0, 1000, -50), wheels(0.1, 1010, -30)]
