"""Pictures that are bad, late or lie about their time, and a detection that crawls, crashes or hangs. Rows of the table
of faults, and the wall clock's.
"""

import os
import signal
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from groundsbot.fixtures.recording.devices import PictureFolder, at_rate
from groundsbot.onboard.camera.camera import CameraSettings
from groundsbot.onboard.camera.v4l2 import V4l2Camera
from groundsbot.onboard.detection.child_process import ChildDetector, DetectorSettings
from groundsbot.onboard.detection.tag_detector import Detection, TagDetector
from groundsbot.onboard.log.messages import ClockAnchor, EventKind, StampSource
from groundsbot.onboard.log.reading.reader import read_log
from groundsbot.onboard.process.clock import ClockReading, RunClock
from groundsbot.onboard.recorder.robot_files import RobotCamera
from groundsbot.onboard.wheels.protocol import format_line
from tests.support.devices.fake_capture import FakeCapture
from tests.support.devices.live_recording import (
    Driver,
    check_gapless,
    recording,
    robot_yaml,
    show_until,
    tag_jpeg,
    until,
)
from tests.support.devices.recorder_cores import (
    MS,
    START_NS,
    UPTIME_NS,
    S,
    events_of,
    frames_of,
    line_of,
    make_core,
    wheels_of,
)

HOUR_NS = 3600 * S


@pytest.fixture
def both(tmp_path: Path) -> Path:
    devices = f"{{encoder_port: {tmp_path / 'wheels'}, camera: pictures}}"
    return robot_yaml(tmp_path, devices, "{picture_rate_hz: 1000000}")  # every one


def test_row_33_bad_pictures_are_skipped_and_counted(tmp_path: Path, both: Path) -> None:
    good = tag_jpeg()
    resized = cv2.imencode(".jpg", np.full((60, 80), 90, np.uint8))[1].tobytes()
    tiny = cv2.imencode(".jpg", np.full((3, 3), 90, np.uint8))[1].tobytes()
    (endless := tmp_path / "endless.jpg").symlink_to("/dev/zero")
    scrambled = good[:4] + bytes(len(good) - 6) + good[-2:]  # begins and ends as a JPEG does
    camera = PictureFolder(tmp_path / "pictures")
    with recording(both, tmp_path / "logs") as made:
        made.wait_for(EventKind.CAMERA_CONNECTED)
        for picture in (good, scrambled, good[:-100], b"", resized, tiny, good):
            camera.show(picture)
            time.sleep(0.02)
        endless.rename(tmp_path / "pictures" / f"{time.time_ns()}.jpg")
        made.wait_for_messages("/tags/detections", 4)
        until(lambda: made.losses.get("pictures", 0) == 4, "the bad ones")
    assert [(each.width_px, each.height_px, len(each.detections)) for each in frames_of(made.log)] == [
        (160, 120, 1),
        (80, 60, 0),
        (3, 3, 0),
        (160, 120, 1),
    ]
    assert sum(event.count for event in events_of(made.log, EventKind.FRAME_UNUSABLE)) == 4
    assert [each for each in events_of(made.log, EventKind.FRAME_UNUSABLE) if "is a link" in each.text]
    sizes = events_of(made.log, EventKind.FRAME_SIZE)
    assert ["80x60" in sizes[0].text, "3x3" in sizes[1].text, len(sizes)] == [True, True, 2]
    assert "160x120" in sizes[0].text
    assert len(list(read_log(made.log, ["/camera/image"]))) == 4


@pytest.mark.parametrize(
    ("lie", "believed"),
    [
        ("none", 10),
        ("zero", 0),
        ("stands still", 1),
        ("backwards", 5),
        ("of the wall clock", 0),
        ("from the future", 0),
    ],
)
def test_row_34_a_stamp_that_cannot_be_is_replaced_and_the_source_recorded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lie: str, believed: int
) -> None:
    first_ms = time.monotonic_ns() / MS
    n, newest_ms = 0, 0.0

    def stamp_ms() -> float:
        nonlocal n, newest_ms
        n += 1
        now_ms = time.monotonic_ns() / MS
        newest_ms = now_ms - 20.0 if n % 2 else newest_ms
        return {
            "none": now_ms - 20.0,
            "zero": 0.0,
            "stands still": first_ms,
            "backwards": newest_ms if n % 2 else newest_ms - 10.0,
            "of the wall clock": time.time_ns() / MS,
            "from the future": now_ms + 50.0,
        }[lie]

    (tmp_path / "video0").touch()
    monkeypatch.setattr(cv2, "VideoCapture", lambda *_: FakeCapture([tag_jpeg()] * 10, stamp_ms))
    camera = V4l2Camera(CameraSettings(str(tmp_path / "video0"), 160, 120, 15.0), RunClock())
    camera.open()
    frames = [camera.read(1.0)[0] for _ in range(10)]
    sources = [frame.source for frame in frames]
    assert sources.count(StampSource.STAMP_SOURCE_CAMERA) == believed
    assert sources.count(StampSource.STAMP_SOURCE_ARRIVAL) == 10 - believed
    assert all(
        frame.stamp_ns == frame.receive_ns for frame in frames if frame.source == StampSource.STAMP_SOURCE_ARRIVAL
    )
    assert all(0 <= frame.receive_ns - frame.stamp_ns < S for frame in frames)


def test_row_34_each_picture_has_the_source_of_its_stamp_and_a_change_is_reported(tmp_path: Path) -> None:
    core = make_core(tmp_path)
    sources = [StampSource.STAMP_SOURCE_CAMERA] * 5 + [StampSource.STAMP_SOURCE_ARRIVAL] * 5
    for index, source in enumerate(sources):
        core.on_detections([], (160, 120), START_NS + index * 50 * MS, START_NS + index * 50 * MS + MS, source, index)
    core.close(START_NS + 2 * S)
    assert [each.stamp_source for each in frames_of(tmp_path / "run1")] == sources
    (told,) = events_of(tmp_path / "run1", EventKind.CAMERA_STAMP)
    assert told.count == 1


@dataclass(frozen=True)
class SlowSettings(DetectorSettings):
    """Ten times slower than the pictures come."""

    takes_s: float = 0.2

    def make(self) -> TagDetector:
        return SlowDetector(self.takes_s)


class SlowDetector(TagDetector):
    def __init__(self, takes_s: float) -> None:
        super().__init__()
        self._takes_s = takes_s

    def detect(self, grey: NDArray[np.uint8]) -> list[Detection]:
        time.sleep(self._takes_s)
        return super().detect(grey)


def test_row_35_a_slow_detection_drops_pictures_and_does_not_fall_behind(
    tmp_path: Path, both: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(RobotCamera, "detector_settings", property(lambda _: SlowSettings()))
    monkeypatch.setattr("groundsbot.onboard.camera.folder.FolderCamera.patience_s", 0.5)
    camera, picture, shown, under_way = PictureFolder(tmp_path / "pictures"), tag_jpeg(), list[int](), list[int]()

    def show(_index: int) -> None:
        shown.append(camera.show(picture))
        under_way.append(len(made.recorder._detections[0]._under_way))

    with Driver(tmp_path / "wheels") as driver:
        driver.plug_in()
        with recording(both, tmp_path / "logs") as made:
            made.wait_for(EventKind.CAMERA_CONNECTED)
            at_rate(50.0, 3.0, show)
    frames = list(read_log(made.log, ["/tags/detections"]))
    detected = len(frames)
    assert detected + made.losses["pictures"] == len(shown)
    assert detected
    assert 1 <= max(under_way) <= 8  # the queue's length bounds the lag
    dropped = events_of(made.log, EventKind.FRAME_DROPPED)
    assert sum(event.count for event in dropped) == made.losses["pictures"]
    first, *_, last = events_of(made.log)
    assert len(dropped) <= (last.stamp_ns - first.stamp_ns) / S + 2  # reported once a second
    check_gapless(made.log, driver.refused)
    kept = len(list(read_log(made.log, ["/camera/image"])))
    assert kept == len(shown)  # tags can be found later in what was dropped


@pytest.mark.parametrize(("fault", "reason"), [(signal.SIGKILL, "crashed"), (signal.SIGSTOP, "no answer")])
def test_row_36_a_detection_that_crashes_or_hangs_is_replaced(
    tmp_path: Path, both: Path, monkeypatch: pytest.MonkeyPatch, fault: signal.Signals, reason: str
) -> None:
    if fault == signal.SIGSTOP:
        monkeypatch.setattr(
            "groundsbot.onboard.recorder.camera_detection.ChildDetector", partial(ChildDetector, job_limit_s=2.0)
        )
    camera, picture = PictureFolder(tmp_path / "pictures"), tag_jpeg()
    # More than the pipe to a process holds, so that one which takes nothing cannot be handed it.
    noise = np.random.default_rng(36).integers(0, 255, (1000, 1000), np.uint8)
    large = cv2.imencode(".jpg", noise, [cv2.IMWRITE_JPEG_QUALITY, 100])[1].tobytes()
    with Driver(tmp_path / "wheels") as driver:
        driver.plug_in()
        with recording(both, tmp_path / "logs") as made:
            show_until(camera, picture, made, 1)
            made.wait_for_messages("/wheels", 1)
            detector = made.recorder._detections[0]._detector
            first = detector._process.pid or 0
            os.kill(first, fault)
            camera.show(large)
            made.wait_for(EventKind.DETECTOR_RESTARTED)
            show_until(camera, picture, made, made.recorder.core.counts["/tags/detections"] + 1)
            assert detector._process.pid != first
            assert not Path(f"/proc/{first}").exists()
    told = events_of(made.log, EventKind.DETECTOR_RESTARTED)
    assert any(reason in event.text for event in told)
    unusable = events_of(made.log, EventKind.FRAME_UNUSABLE)
    assert sum(event.count for event in unusable) == len(told)  # each costs one; a machine held up may see several
    check_gapless(made.log, driver.refused)


@pytest.mark.parametrize("to_ns", [START_NS + HOUR_NS, START_NS - HOUR_NS, 0, 2_145_916_800 * S])
def test_row_37_steps_of_the_wall_clock_are_reported_and_the_log_goes_on_evenly(tmp_path: Path, to_ns: int) -> None:
    core = make_core(tmp_path)
    for index in range(400):
        now_ns = START_NS + index * 10 * MS
        core.on_serial_bytes(format_line(line_of(index)), now_ns)
        stepped = to_ns + index * 10 * MS if index >= 200 else now_ns
        core.tick(now_ns, stepped, synchronised=True)
    core.close(START_NS + 5 * S)
    log = list(read_log(tmp_path / "run1"))
    times = [each.log_time_ns for each in log]
    assert times == sorted(times)
    assert times[-1] - times[0] == 5 * S
    (told,) = events_of(tmp_path / "run1", EventKind.CLOCK_STEP)
    assert f"{(to_ns - START_NS) / 1e9:+.0f}"[:4] in told.text
    anchors = [each.message for each in log if isinstance(each.message, ClockAnchor)]
    assert [anchor.stamp_ns - anchor.monotonic_ns for anchor in anchors] == [START_NS - UPTIME_NS] * len(anchors)
    assert len(wheels_of(tmp_path / "run1")) == 400


def test_row_37_the_runs_clock_does_not_step_with_the_wall_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, real = RunClock(), time.time_ns
    before_ns = clock.now_ns()
    for step_ns in (HOUR_NS, -HOUR_NS, -real(), 2_145_916_800 * S - real()):
        monkeypatch.setattr(time, "time_ns", lambda step_ns=step_ns: real() + step_ns)
        assert 0 <= clock.now_ns() - before_ns < 60 * S
        assert 0 <= clock.from_monotonic(time.monotonic_ns()) - before_ns < 60 * S


def test_row_37_slewing_is_no_step(tmp_path: Path) -> None:
    core = make_core(tmp_path)
    for index in range(400):
        now_ns = START_NS + index * 100 * MS
        core.tick(now_ns, now_ns + round(0.08 * (now_ns - START_NS)))  # chrony at its fastest
    core.close(START_NS + 40 * S)
    assert not events_of(tmp_path / "run1", EventKind.CLOCK_STEP)


@pytest.mark.parametrize("step_ns", [HOUR_NS, -HOUR_NS])
def test_row_37_a_picture_named_before_a_step_keeps_its_time(monkeypatch: pytest.MonkeyPatch, step_ns: int) -> None:
    monotonic_ns = UPTIME_NS
    offset_ns = START_NS - UPTIME_NS
    monkeypatch.setattr(
        "groundsbot.onboard.process.clock.read_clocks", lambda: ClockReading(monotonic_ns, monotonic_ns + offset_ns)
    )
    clock = RunClock()
    named_ns = monotonic_ns + offset_ns
    monotonic_ns += S
    offset_ns += step_ns
    assert clock.from_realtime(named_ns) == START_NS
    assert clock.from_realtime(monotonic_ns + offset_ns) == START_NS + S
