"""A log that is no run is refused with file, field, value and way out."""

from pathlib import Path

import numpy as np
import pytest
from google.protobuf.message import Message

from groundsbot.offline.measurements.run import RobotFile, load_run
from groundsbot.onboard.log.head import log_head
from groundsbot.onboard.log.messages import CameraCalibration, PlanarOdometry, RunInfo, WheelEncoders
from tests.offline.measurements.written_logs import (
    ROBOT,
    TWO_OBSERVATIONS,
    picture,
    pose_odometry,
    refusal,
    tag,
    wheel_odometry,
    wheels,
    write_log,
)
from tests.support.data.drives import CAMERA, START_NS, S, make_drive, write_drive


def test_a_log_without_wheels_is_refused(tmp_path: Path) -> None:
    text = refusal(write_log(tmp_path, [picture(0.0, tag(1))]))
    assert "/wheels" in text
    assert "0 messages" in text
    assert "check" in text


def test_tags_without_a_camera_are_refused(tmp_path: Path) -> None:
    head = log_head(ROBOT, ROBOT.model_dump_json(), None, "one", START_NS, 0)
    text = refusal(write_log(tmp_path, [*TWO_OBSERVATIONS, picture(0.05, tag(1))], head))
    assert "/camera/calibration" in text
    assert "--robot" in text


def test_a_camera_of_another_picture_size_is_refused(tmp_path: Path) -> None:
    text = refusal(write_log(tmp_path, [*TWO_OBSERVATIONS, picture(0.05, tag(1), size=(640, 480))]))
    for part in ("/tags/detections", "640x480", "/camera/calibration", "1280x720", "--robot"):
        assert part in text


def test_a_given_camera_of_another_picture_size_is_refused(tmp_path: Path) -> None:
    log = write_log(tmp_path, [*TWO_OBSERVATIONS, picture(0.05, tag(1))])
    text = refusal(log, {"carl": RobotFile(ROBOT, {"": CAMERA.resize(0.5)})})
    for part in ("1280x720", "--robot", "640x360"):
        assert part in text


def test_a_calibration_that_is_none_is_refused(tmp_path: Path) -> None:
    head = dict(log_head(ROBOT, ROBOT.model_dump_json(), CAMERA, "one", START_NS, 0))
    for broken in (
        CameraCalibration(width=1280, height=720),
        CameraCalibration(width=1280, height=720, distortion_model="plumb_bob", K=[0.0] * 9, D=[0.0] * 5),
        CameraCalibration(width=1280, height=720, distortion_model="wavy", K=[9.0] * 9, D=[0.0] * 5),
    ):
        log = write_log(
            tmp_path, TWO_OBSERVATIONS, head | {"/camera/calibration": broken}, run_id=f"r{len(str(broken))}"
        )
        refusal(log)


def test_a_robot_that_cannot_be_is_refused_with_its_field(tmp_path: Path) -> None:
    broken = ROBOT.model_dump_json().replace('"default_size_m":0.15', '"default_size_m":-0.15')
    head = {"/run": RunInfo(run_id="one", robot_id="carl", robot_yaml=broken)}
    text = refusal(write_log(tmp_path, TWO_OBSERVATIONS, head))
    assert "default_size_m" in text
    assert "-0.15" in text


@pytest.mark.parametrize("name", ["", "../../home", "a/b", "a\\b", ".hidden", "two\nlines", "x" * 101])
def test_names_that_lead_out_of_the_output_folder_are_refused(tmp_path: Path, name: str) -> None:
    for field, run_id, robot_id in (("run_id", name, "fine"), ("robot_id", "fine", name)):
        info = RunInfo(run_id=run_id, robot_id=robot_id, robot_yaml=ROBOT.model_dump_json())
        text = refusal(write_log(tmp_path / field, TWO_OBSERVATIONS, {"/run": info}))
        assert f"/run: {field} is" in text


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e300])
@pytest.mark.parametrize("kind", ["wheels", "pose"])
def test_odometry_that_is_no_number_is_refused(tmp_path: Path, value: float, kind: str) -> None:
    good, bad = wheel_odometry(0.0, 0.0, 0.0), wheel_odometry(0.1, 0.1, value)
    if kind == "pose":
        good, bad = pose_odometry(0.0, 0.0, 0.0, 0.0), pose_odometry(0.1, 0.1, 0.0, value)
    text = refusal(write_log(tmp_path, [good, bad]))
    for part in ("/odometry", "right_m" if kind == "wheels" else "theta_rad", f"{value:g}", "reading 2"):
        assert part in text


@pytest.mark.parametrize("topic", ["/wheels", "/odometry"])
def test_times_before_zero_are_refused(tmp_path: Path, topic: str) -> None:
    observations: dict[str, list[Message]] = {
        "/wheels": [WheelEncoders(stamp_ns=at_ns, boot_id=1) for at_ns in (-1_500_000_000, 0)],
        "/odometry": [PlanarOdometry(stamp_ns=at_ns, wheels={}) for at_ns in (-1_500_000_000, 0)],
    }
    text = refusal(write_log(tmp_path, [(topic, each) for each in observations[topic]]))
    for part in (topic, "stamp_ns is -1500000000 in reading 1", "below 0"):
        assert part in text


@pytest.mark.parametrize("ticks", [10**9, -(2**62), 2**63 - 1])
def test_counts_that_no_wheel_can_have_made_are_refused(tmp_path: Path, ticks: int) -> None:
    text = refusal(write_log(tmp_path, [wheels(0.0, 0, 0), wheels(0.01, 0, ticks)]))
    for part in ("/wheels", "reading 2", "100 m/s", "--robot"):
        assert part in text


def test_a_fast_robot_is_not_refused(tmp_path: Path) -> None:
    drive = make_drive([0.0, 0.0, 0.0], [(20.0, 20.0, 1.0)], step_ns=S // 20)
    load_run(write_drive(tmp_path, drive))
