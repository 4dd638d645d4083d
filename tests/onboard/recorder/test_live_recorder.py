"""The recorder as a process of its own: wheels through a pseudo terminal, pictures through a folder."""

import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from itertools import islice
from pathlib import Path
from typing import IO

import cv2
import numpy as np

from groundsbot.fixtures.recording.devices import PictureFolder, PtyPort, pace, wheel_line
from groundsbot.onboard.log.messages import Event, TagDetections, WheelEncoders
from groundsbot.onboard.log.reading.reader import find_logs, read_log
from groundsbot.onboard.recorder.pictures import PictureSchedule
from tests.support.data.logs import run_info_of
from tests.support.devices.live_recording import CORNERS, PATIENCE_S, PATIENT, repeat, robot_yaml, tag_jpeg
from tests.support.devices.recorder_cores import frames_of, wheels_of
from tests.support.programs import running
from tests.support.tag_pictures import draw_tag

MS = 1_000_000


def send(port: PtyPort, index: int) -> int | None:
    """Sends line `index`; returns the monotonic time of its measurement; None: the port had no room for it."""
    now_ns = time.monotonic_ns()
    return now_ns if port.send(wheel_line(index, now_ns)) else None


def program(*arguments: str | Path, before: str = "") -> AbstractContextManager["subprocess.Popen[str]"]:
    return running([sys.executable, "-c", f"{before}\nfrom groundsbot.onboard.cli import main\nmain()", *arguments])


def wait_for(output: IO[str] | None, *words: str) -> list[str]:
    """Reads lines until each word has stood in one of them."""
    assert output is not None
    lines: list[str] = []
    while not all(any(word in line for line in lines) for word in words):
        line = output.readline()
        assert line, f"ended after {lines}"
        lines.append(line)
    return lines


def feed_wheels(port: PtyPort, seconds: float) -> list[int | None]:
    return [send(port, index) for index in islice(pace(100.0), round(100.0 * seconds))]


def feed_pictures(folder: Path, seconds: float) -> list[tuple[int, int]]:
    """15 pictures a second; every third as a slow writer does it, in two pieces and in place.

    Returns:
        For each, monotonic times just before and after the one that is its name.
    """
    picture = cv2.imencode(".png", draw_tag("tag36h11", 9, CORNERS, (120, 160)))[1].tobytes()
    exposed = []
    for index in islice(pace(15.0), round(15.0 * seconds)):
        before_ns, realtime_ns, after_ns = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        path = folder / f"{realtime_ns}.png"
        if index % 3 == 0:
            with path.open("wb", buffering=0) as file:
                file.write(picture[:1000])
                time.sleep(0.02)
                file.write(picture[1000:])
        else:
            path.with_suffix(".part").write_bytes(picture)
            path.with_suffix(".part").rename(path)
        exposed.append((before_ns, after_ns))
    return exposed


def test_a_live_recording_has_every_line_and_picture_on_one_clock(
    tmp_path: Path, plug_in: Callable[..., PtyPort]
) -> None:
    pictures = tmp_path / "pictures"
    pictures.mkdir()
    (pictures / "1000.png").write_bytes(b"an old one, left alone")
    port = plug_in(tmp_path / "wheels")
    robot = robot_yaml(tmp_path, f"{{encoder_port: {tmp_path / 'wheels'}, camera: pictures}}")
    exposed: list[tuple[int, int]] = []
    with program("record", "--robot", robot, "--output", tmp_path / "logs", before=PATIENT) as process:
        wait_for(process.stdout, "port_connected", "camera_connected")
        feeder = threading.Thread(target=lambda: exposed.extend(feed_pictures(pictures, 4.0)))
        feeder.start()
        measured = feed_wheels(port, 4.0)
        feeder.join()
        process.send_signal(signal.SIGTERM)
        said, _ = process.communicate(timeout=PATIENCE_S)
    refused = measured.count(None)
    assert process.returncode == (3 if refused else 0), said

    (log,) = find_logs([tmp_path / "logs"])
    epoch_ns = run_info_of(log).run_epoch_ns
    wheels = wheels_of(log)
    assert [each.sequence for each in wheels] == [index for index, at_ns in enumerate(measured) if at_ns is not None]
    late_ns = np.array([each.stamp_ns - epoch_ns - (measured[each.sequence] or 0) for each in wheels])
    assert np.median(np.abs(late_ns)) < 5 * MS
    assert late_ns.min() > -5 * MS  # a line that was held up may be stamped late, none early
    assert all(each.publish_time_ns < each.log_time_ns + 5 * MS for each in read_log(log, ["/wheels"]))

    frames = frames_of(log)
    assert [each.frame_sequence for each in frames] == list(range(60))
    for frame, (before_ns, after_ns) in zip(frames, exposed, strict=True):
        assert before_ns - 5 * MS < frame.stamp_ns - epoch_ns < after_ns + 5 * MS
    assert all([tag.tag_id for tag in each.detections] == [9] for each in frames)
    check_named(frames, wheels)
    schedule = PictureSchedule(5.0, 15.0)  # of robot.yaml
    due = [each.stamp_ns for each in frames if schedule.is_due(each.stamp_ns)]
    assert [each.publish_time_ns for each in read_log(log, ["/camera/image"])] == due


def check_named(frames: list[TagDetections], wheels: list[WheelEncoders]) -> None:
    """Each picture names the last wheel reading before it, but those from before the first."""
    stamps_ns = np.array([each.stamp_ns for each in wheels])
    for frame in frames:
        before = int(np.searchsorted(stamps_ns, frame.stamp_ns, side="right"))
        assert frame.has_wheel_sequence == (before > 0)
        assert not before or frame.wheel_sequence == wheels[before - 1].sequence


def test_what_the_devices_hold_when_recording_ends_belongs_to_it(
    tmp_path: Path, plug_in: Callable[..., PtyPort]
) -> None:
    pictures = tmp_path / "pictures"
    pictures.mkdir()
    port = plug_in(tmp_path / "wheels")
    robot = robot_yaml(tmp_path, f"{{encoder_port: {tmp_path / 'wheels'}, camera: pictures}}")
    picture = cv2.imencode(".png", draw_tag("tag36h11", 9, CORNERS, (120, 160)))[1].tobytes()
    with program("record", "--robot", robot, "--output", tmp_path / "logs", before=PATIENT) as process:
        wait_for(process.stdout, "port_connected", "camera_connected")
        for index in range(60):
            send(port, index)
        for _ in range(20):
            (pictures / f"{time.time_ns()}.png").write_bytes(picture)
        process.send_signal(signal.SIGTERM)
        said, _ = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, said
    (log,) = find_logs([tmp_path / "logs"])
    assert len(list(read_log(log, ["/wheels"]))) == 60
    assert len(list(read_log(log, ["/tags/detections"]))) == 20


def test_a_port_that_goes_and_comes_back_under_its_link(tmp_path: Path, plug_in: Callable[..., PtyPort]) -> None:
    link = tmp_path / "wheels"
    robot = robot_yaml(tmp_path, f"{{encoder_port: {link}}}")
    with program("record", "--robot", robot, "--output", tmp_path / "logs") as process:
        wait_for(process.stdout, "waiting for the wheels")  # absent at the start
        port = plug_in(link)
        wait_for(process.stdout, "port_connected")
        for index in range(20):
            send(port, index)
        time.sleep(0.2)
        port.unplug()
        wait_for(process.stdout, "port_lost")
        port = plug_in(link)
        wait_for(process.stdout, "port_connected")
        for index in range(30, 50):  # ten were sent while nobody listened
            send(port, index)
        time.sleep(0.2)
        process.send_signal(signal.SIGINT)
        said, _ = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 3
    assert "lost: 10 wheel lines" in said
    (log,) = find_logs([tmp_path / "logs"])
    kinds = [each.message.kind for each in read_log(log, ["/events"]) if isinstance(each.message, Event)]
    assert kinds[:4] == ["recording_started", "port_connected", "port_lost", "port_connected"]
    sequences = [
        each.message.sequence for each in read_log(log, ["/wheels"]) if isinstance(each.message, WheelEncoders)
    ]
    assert sequences == [*range(20), *range(30, 50)]


def test_check_tells_of_each_device(tmp_path: Path, plug_in: Callable[..., PtyPort]) -> None:
    pictures = tmp_path / "pictures"
    pictures.mkdir()
    port = plug_in(tmp_path / "wheels")
    robot = robot_yaml(tmp_path, f"{{encoder_port: {tmp_path / 'wheels'}, camera: pictures}}")
    camera, picture = PictureFolder(pictures, keep=20), tag_jpeg()
    with (
        repeat(lambda index: send(port, index), 100.0),
        repeat(lambda _: camera.show(picture), 10.0),
        program("check", "--robot", robot) as process,
    ):
        said, _ = process.communicate(timeout=PATIENCE_S)
    lines = said.splitlines()
    assert process.returncode == 0, said
    assert [line.split(":")[0] for line in lines] == [
        f"ok   {name}" for name in ("wheels", "camera", "detection", "clock", "disk")
    ]
    assert "160x120 px" in said
    assert f"tag36h11 9; picture: {tmp_path / 'check.jpg'}" in said
    drawn = cv2.imread(str(tmp_path / "check.jpg"))
    assert drawn is not None
    green = (drawn[:, :, 1] > 150) & (drawn[:, :, 0] < 120) & (drawn[:, :, 2] < 120)
    edge = np.linspace(CORNERS[1], CORNERS[2], 9)[1:-1]  # its right side
    assert all(green[round(y) - 2 : round(y) + 3, round(x) - 2 : round(x) + 3].any() for x, y in edge)


def test_check_fails_for_what_is_missing_or_does_not_fit(tmp_path: Path) -> None:
    pictures = tmp_path / "pictures"
    pictures.mkdir()
    cv2.imwrite(str(pictures / f"{time.time_ns()}.jpg"), np.zeros((240, 320), np.uint8))
    robot = robot_yaml(tmp_path, f"{{encoder_port: {tmp_path / 'wheels'}, camera: pictures}}")
    short = "from groundsbot.onboard.monitoring import check\ncheck._LISTEN_NS = 100_000_000"
    with program("check", "--robot", robot, before=short) as process:
        said, _ = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 1
    assert "FAIL wheels: port" in said
    assert "FAIL camera:" in said
    assert "320x240 px, the calibration is for 160x120 px" in said
