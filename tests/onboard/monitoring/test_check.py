"""`check` fails for what would record nothing, and for nothing that a setting says is meant so."""

import threading
import time
from collections.abc import Callable
from itertools import takewhile
from pathlib import Path
from types import SimpleNamespace

import cv2
import pytest

from groundsbot.fixtures.recording.devices import PtyPort, pace, wheel_line
from groundsbot.onboard.monitoring import check
from groundsbot.onboard.monitoring.check import DeviceCheck, check_robot
from groundsbot.onboard.recorder.robot_files import RobotFiles
from tests.support.devices.live_recording import CORNERS, robot_yaml, two_cameras_yaml
from tests.support.devices.recorder_cores import MS
from tests.support.tag_pictures import draw_tag


def checks(robot: Path) -> dict[str, DeviceCheck]:
    found = check_robot(RobotFiles(robot), robot.parent, robot.with_name("check.jpg"), 1.0)
    return {each.name: each for each in found}


def test_a_folder_into_which_nothing_is_written_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(check, "_LISTEN_NS", 100 * MS)
    monkeypatch.setattr(check, "_LOOK_NS", 200 * MS)
    pictures = tmp_path / "pictures"
    pictures.mkdir()
    robot = robot_yaml(tmp_path, "{camera: pictures}")
    empty = checks(robot)["camera"]
    assert not empty.passed
    assert "gave no picture" in empty.text
    cv2.imwrite(str(pictures / f"{time.time_ns() - 60 * 10**9}.png"), draw_tag("tag36h11", 9, CORNERS, (120, 160)))
    left_over = checks(robot)
    assert not left_over["camera"].passed
    assert "no new picture, the newest is 6" in left_over["camera"].text
    assert "tag36h11 9" in left_over["detection"].text


def test_each_camera_is_checked_by_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(check, "_LISTEN_NS", 100 * MS)
    monkeypatch.setattr(check, "_LOOK_NS", 200 * MS)
    front = tmp_path / "front"
    front.mkdir()
    cv2.imwrite(str(front / f"{time.time_ns() + 3600 * 10**9}.png"), draw_tag("tag36h11", 9, CORNERS, (120, 160)))
    found = checks(two_cameras_yaml(tmp_path))
    assert found["camera front"].passed, found["camera front"].text
    assert "tag36h11 9" in found["detection front"].text
    assert (tmp_path / "check_front.jpg").exists()
    assert not found["camera left"].passed
    assert "check cameras.left.device" in found["camera left"].text


@pytest.mark.parametrize(("setting", "passed"), [("", False), (", encoder_rate_hz: 30", True)])
def test_a_slow_controller_is_right_where_robot_yaml_says_so(
    tmp_path: Path, plug_in: Callable[..., PtyPort], setting: str, passed: bool
) -> None:
    port, ended = plug_in(tmp_path / "wheels"), threading.Event()
    robot = robot_yaml(tmp_path, f"{{encoder_port: {tmp_path / 'wheels'}{setting}}}")

    def feed() -> None:
        for index in takewhile(lambda _: not ended.is_set(), pace(30.0)):
            port.send(wheel_line(index, time.monotonic_ns()))

    feeder = threading.Thread(target=feed)
    feeder.start()
    try:
        wheels = checks(robot)["wheels"]
    finally:
        ended.set()
        feeder.join()
    assert wheels.passed == passed, wheels.text
    assert passed or "devices.encoder_rate_hz" in wheels.text


@pytest.mark.parametrize(("hours", "words", "passed"), [(0.97, "0.9 h", False), (1.04, "1.0 h", True)])
def test_hours_are_not_rounded_up_to_what_is_needed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, hours: float, words: str, passed: bool
) -> None:
    files = RobotFiles(robot_yaml(tmp_path, "{encoder_port: wheels}"))
    load = check._load_of(files, check._DeviceFindings())
    free = files.robot.recorder.keep_free_mb * 1_000_000 + round(hours * 3600.0 * load.bytes_per_s)
    monkeypatch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=free))
    found = check._check_disk(tmp_path, load, files.robot.recorder.keep_free_mb)
    assert (f"for about {words}" in found.text, found.passed) == (True, passed)
