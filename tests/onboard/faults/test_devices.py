"""Ports and cameras that appear, vanish, block and give wrong data. Rows of the table of faults."""

import multiprocessing
import os
import shutil
import subprocess
import sys
import threading
import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import pytest

from groundsbot.fixtures.recording.devices import PictureFolder
from groundsbot.onboard.camera.folder import FolderCamera
from groundsbot.onboard.log.messages import EventKind
from groundsbot.onboard.monitoring import check
from groundsbot.onboard.process.clock import RunClock
from groundsbot.onboard.recorder import device_threads
from groundsbot.onboard.recorder.robot_files import RobotFiles
from groundsbot.onboard.wheels.port import EncoderPort
from tests.support.devices.fake_capture import FakeCapture, v4l2_camera_of
from tests.support.devices.live_recording import (
    Driver,
    check_gapless,
    recording,
    robot_yaml,
    show_until,
    tag_jpeg,
    until,
)
from tests.support.devices.recorder_cores import events_of, frames_of, wheels_of

REPLUGS = 20
Counts = tuple[int, int, int]


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(device_threads, "_RETRY_S", 0.02)


def resources_in_use() -> Counts:
    """Threads, open files and children of this process, once what is on its way out has gone."""
    looks = []
    for _ in range(8):
        files = len(list(Path("/proc/self/fd").iterdir()))
        looks.append((threading.active_count(), files, len(multiprocessing.active_children())))
        time.sleep(0.01)
    return min(look[0] for look in looks), min(look[1] for look in looks), min(look[2] for look in looks)


def check_nothing_is_left(counts: list[Counts]) -> None:
    assert len(counts) == REPLUGS + 1
    assert all(last <= first for first, last in zip(counts[0], counts[-1], strict=True)), counts


@pytest.fixture
def wheels_only(tmp_path: Path) -> Path:
    return robot_yaml(tmp_path, f"{{encoder_port: {tmp_path / 'wheels'}}}")


@pytest.fixture
def both(tmp_path: Path) -> Path:
    return robot_yaml(tmp_path, f"{{encoder_port: {tmp_path / 'wheels'}, camera: pictures}}")


def test_a_relative_port_starts_at_robot_yaml(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    files = RobotFiles(robot_yaml(tmp_path, "{encoder_port: wheels}"))
    with Driver(tmp_path / "wheels") as driver, recording(files.path, tmp_path / "logs") as made:
        driver.plug_in()
        made.wait_for_messages("/wheels", 2)
    (wheels,) = check._check_controller(files, RunClock(), check._DeviceFindings(), listen_s=0.01)
    assert str(tmp_path / "wheels") in wheels.text


def test_check_listens_to_a_gyro_on_the_port(tmp_path: Path) -> None:
    files, seen = RobotFiles(robot_yaml(tmp_path, "{encoder_port: wheels}")), check._DeviceFindings()
    with Driver(tmp_path / "wheels", gyro=True) as driver:
        driver.plug_in()
        until(lambda: driver.sent > 2, "a line")
        wheels, gyro = check._check_controller(files, RunClock(), seen, listen_s=1.0)
    assert (wheels.name, gyro.name) == ("wheels", "gyro")
    assert "samples/s" in gyro.text
    assert seen.samples_hz > 0.0


def test_row_20_a_port_that_is_absent_at_the_start(tmp_path: Path, wheels_only: Path) -> None:
    with Driver(tmp_path / "wheels") as driver, recording(wheels_only, tmp_path / "logs") as made:
        until(lambda: bool(made.notices), "a word about the port")
        driver.plug_in()
        made.wait_for_messages("/wheels", 20)
    assert made.notices == [made.notices[0]]
    assert f"waiting for the wheels: port {tmp_path / 'wheels'}" in made.notices[0]
    kinds = [event.kind for event in events_of(made.log)]
    assert kinds[:2] == ["recording_started", "port_connected"]


def test_row_21_twenty_replugs_leave_nothing_behind(tmp_path: Path, wheels_only: Path) -> None:
    counts = []
    with Driver(tmp_path / "wheels") as driver, recording(wheels_only, tmp_path / "logs") as made:
        until(lambda: bool(made.recorder.log.status.files), "the log's files")
        for replug in range(REPLUGS + 1):
            driver.plug_in()
            made.wait_for(EventKind.PORT_CONNECTED, replug + 1)
            made.wait_for_messages("/wheels", made.recorder.core.counts["/wheels"] + 5)
            counts.append(resources_in_use())
            driver.unplug()
            made.wait_for(EventKind.PORT_LOST, replug + 1)
    check_nothing_is_left(counts)
    readings = wheels_of(made.log)
    missing = sum(after.sequence - before.sequence - 1 for before, after in pairwise(readings))
    gaps = events_of(made.log, EventKind.WHEEL_GAP)
    assert sum(event.count for event in gaps if "missing" in event.text) == missing
    assert len(events_of(made.log, EventKind.PORT_LOST)) == REPLUGS + 1
    assert all(reading.ticks_left == 5 * reading.sequence for reading in readings)


def test_row_22_a_replug_under_another_name_is_found_by_the_link(tmp_path: Path, wheels_only: Path) -> None:
    with Driver(tmp_path / "wheels") as driver, recording(wheels_only, tmp_path / "logs") as made:
        first = driver.plug_in()
        made.wait_for_messages("/wheels", 60)
        old, driver.port = driver.port, None
        second = driver.plug_in()  # before the old one is gone, so that it cannot have its name
        assert old is not None
        old.unplug()
        made.wait_for(EventKind.PORT_CONNECTED, 2)
        made.wait_for_messages("/wheels", made.recorder.core.counts["/wheels"] + 20)
    assert first != second


def test_row_32_a_camera_absent_unplugged_and_frozen_leaves_the_wheels_alone(
    tmp_path: Path, both: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("groundsbot.onboard.recorder.watches._CAMERA_SILENCE_NS", 300_000_000)
    picture, folder = tag_jpeg(), tmp_path / "pictures"
    with Driver(tmp_path / "wheels") as driver:
        driver.plug_in()
        with recording(both, tmp_path / "logs") as made:
            until(lambda: any("camera" in notice for notice in made.notices), "a word about the camera")
            camera = PictureFolder(folder)
            made.wait_for(EventKind.CAMERA_CONNECTED)
            show_until(camera, picture, made, 5)
            made.wait_for(EventKind.NO_PICTURES)  # frozen
            show_until(camera, picture, made, 10)
            made.wait_for(EventKind.NO_PICTURES, 2)  # and reported again
            shutil.rmtree(folder)
            made.wait_for(EventKind.CAMERA_LOST)
            camera = PictureFolder(folder)
            made.wait_for(EventKind.CAMERA_CONNECTED, 2)
            show_until(camera, picture, made, 15)
    refused = check_gapless(made.log, driver.refused)
    losses = made.losses.copy()
    losses.pop("camera gone or silent at the end", None)  # 0.3 s after the last picture, which an end may be late by
    assert losses == ({"wheel lines": refused} if refused else {})
    assert all(each.detections[0].tag_id == 9 for each in frames_of(made.log))


def test_row_32_twenty_reconnects_of_a_camera_leave_nothing_behind(tmp_path: Path, both: Path) -> None:
    picture, folder, counts = tag_jpeg(), tmp_path / "pictures", []
    with recording(both, tmp_path / "logs") as made:
        until(lambda: bool(made.recorder.log.status.files), "the log's files")
        for reconnect in range(REPLUGS + 1):
            camera = PictureFolder(folder)
            made.wait_for(EventKind.CAMERA_CONNECTED, reconnect + 1)
            show_until(camera, picture, made, made.recorder.core.counts["/tags/detections"] + 1)
            counts.append(resources_in_use())
            shutil.rmtree(folder)
            made.wait_for(EventKind.CAMERA_LOST, reconnect + 1)
    check_nothing_is_left(counts)


@pytest.mark.parametrize(
    ("device", "kind"), [(EncoderPort, EventKind.PORT_LOST), (FolderCamera, EventKind.CAMERA_LOST)]
)
def test_row_21_an_unexpected_error_costs_a_reconnect_only(
    tmp_path: Path, both: Path, device: Any, kind: EventKind, monkeypatch: pytest.MonkeyPatch
) -> None:
    read, fails = device.read, [TypeError("an integer is required"), RuntimeError("from the depths of a library")]

    def spoilt(*arguments: object) -> object:
        if fails:
            raise fails.pop()
        return read(*arguments)

    monkeypatch.setattr(device, "read", spoilt)
    camera = PictureFolder(tmp_path / "pictures")
    with Driver(tmp_path / "wheels") as driver:
        driver.plug_in()
        with recording(both, tmp_path / "logs") as made:
            made.wait_for(kind, 2)
            made.wait_for_messages("/wheels", 60)
            show_until(camera, tag_jpeg(), made, 2)
    assert any("from the depths" in event.text for event in events_of(made.log, kind))


def test_row_32_a_stalled_v4l2_camera_is_let_go_and_opened_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """OpenCV gives up waiting after the two seconds set before it is imported, and says so by an empty picture."""
    device, opened = tmp_path / "video0", [FakeCapture([]), FakeCapture([tag_jpeg()] * 100)]
    waiting = list(opened)
    device.touch()
    monkeypatch.setattr(cv2, "VideoCapture", lambda *_: waiting.pop(0))
    monkeypatch.setattr(device_threads, "camera_for", v4l2_camera_of(device))
    with recording(robot_yaml(tmp_path, "{camera: pictures}"), tmp_path / "logs") as made:
        made.wait_for_messages("/tags/detections", 5)
    assert [capture.released for capture in opened] == [1, 1]
    assert [event.text for event in events_of(made.log, EventKind.CAMERA_LOST)] == [
        f"camera {device} gives no pictures"
    ]


def test_row_32_the_limit_for_a_stalled_camera_is_set_before_opencv_is_imported() -> None:
    program = """
import builtins, os, sys
load = builtins.__import__
def watched(name, *rest):
    if name == "cv2" and "cv2" not in sys.modules:
        assert os.environ["OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT"] == "2"
        print("seen")
    return load(name, *rest)
builtins.__import__ = watched
import groundsbot.onboard.cli, groundsbot.onboard.recorder.live_recorder, groundsbot.onboard.monitoring.check
"""
    clean = {key: value for key, value in os.environ.items() if not key.startswith("OPENCV")}
    found = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False, env=clean)
    assert found.returncode == 0, found.stderr
    assert "seen" in found.stdout
