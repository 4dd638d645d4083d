"""How long a disk lasts: what `check` foresees is what `status` will measure; and what a camera's rate is."""

from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from groundsbot.calib.robot.robot_yaml import parse_robot_yaml
from groundsbot.onboard.camera.camera import Camera, CameraEndedError, CameraSettings, Frame
from groundsbot.onboard.detection.tag_detector import Detection
from groundsbot.onboard.log.messages import LogHead, StampSource
from groundsbot.onboard.log.writing.segments import SegmentLimits
from groundsbot.onboard.log.writing.storage import Disk
from groundsbot.onboard.monitoring import check
from groundsbot.onboard.monitoring.disk_hours import Load, hours_until_full
from groundsbot.onboard.monitoring.status import Rates, RecordingSnapshot
from groundsbot.onboard.process.clock import RunClock
from groundsbot.onboard.recorder.disk.log_keeper import LogKeeper
from groundsbot.onboard.recorder.disk.log_thread import _PERIOD_S
from groundsbot.onboard.recorder.disk.room import DiskRoom, space_policy
from groundsbot.onboard.recorder.recorder import RecorderCore, RunIdentity
from groundsbot.onboard.recorder.robot_files import RobotFiles
from groundsbot.onboard.wheels.protocol import GyroLine, WheelLine, format_gyro_line, format_line
from tests.support.devices.live_recording import robot_yaml
from tests.support.devices.recorder_cores import CAMERA, MS, ROBOT_YAML, START_NS, S

MINUTE = 60 * S


class SteppedLog:
    """The live recorder's log, whose disk does its work when it is told to: not from a thread."""

    def __init__(self, folder: Path, head: LogHead, start_ns: int, keep_pictures: bool) -> None:
        robot, disk = parse_robot_yaml(ROBOT_YAML, "robot.yaml"), Disk(durable=False)
        room = DiskRoom(disk, folder.parent, robot.robot_id, space_policy(robot))
        limits = SegmentLimits()
        self.keeper = LogKeeper(folder, head, start_ns, disk, room, keep_pictures=keep_pictures, limits=limits)
        self.write, self.take_notes = self.keeper.write, self.keeper.take_notes

    @property
    def last_log_time_ns(self) -> int:
        return self.keeper.last_log_time_ns

    @property
    def written(self) -> Mapping[str, int]:
        return self.keeper.written

    def close(self) -> None:
        self.keeper.finish(self.last_log_time_ns / S)


def record(
    folder: Path, rng: np.random.Generator, lines_hz: int, pictures_hz: int, picture_bytes: int, samples_a_line: int = 0
) -> tuple[Path, float]:
    """A drive whose speed and clock are uneven, a gyro, and pictures with six tags: the run's folder, and seconds."""
    logs: list[SteppedLog] = []

    def open_log(*arguments: Any) -> SteppedLog:
        logs.append(SteppedLog(*arguments))
        return logs[0]

    run = RunIdentity(
        parse_robot_yaml(ROBOT_YAML, "robot.yaml"), ROBOT_YAML, CAMERA, "run1", START_NS, START_NS - MINUTE
    )
    core = RecorderCore(folder, run, open_log=open_log)
    seconds = min(60, 12_000 // lines_hz)
    ticks = np.cumsum(rng.normal(1500.0 / lines_hz, 100.0 / lines_hz, (seconds * lines_hz, 2)), axis=0).astype(int)
    late_us = rng.integers(0, 20, len(ticks))
    next_ns = next_step_ns = START_NS
    for index, (left, right) in enumerate(ticks.tolist()):
        t_us = index * 1_000_000 // lines_hz + int(late_us[index])
        now_ns = START_NS + 1000 * t_us + MS
        core.on_serial_bytes(format_line(WheelLine(7, index, t_us, left, right, 0)), now_ns)
        if samples_a_line:
            period_us = 1_000_000 // (lines_hz * samples_a_line)
            rates = tuple(rng.normal(17_000.0, 3_000.0, samples_a_line).astype(int).tolist())
            turns = GyroLine(7, samples_a_line * index, t_us % 2**32, period_us, rates)
            core.on_serial_bytes(format_gyro_line(turns), now_ns)
        core.tick(now_ns)
        if now_ns >= next_step_ns:
            next_step_ns += round(_PERIOD_S * S)
            logs[0].keeper.step(now_ns / S)
        if not pictures_hz or now_ns < next_ns:
            continue
        next_ns += S // pictures_hz
        tags = [Detection("tag36h11", k, 0, rng.uniform(30.0, 90.0), rng.uniform(0.0, 120.0, (4, 2))) for k in range(6)]
        if core.wants_picture(now_ns):
            core.on_picture(rng.bytes(picture_bytes), now_ns, now_ns)
        size_px = CAMERA.width_px, CAMERA.height_px
        core.on_detections(tags, size_px, now_ns, now_ns + MS, StampSource.STAMP_SOURCE_SIMULATION, index)
    core.close(START_NS + seconds * S)
    return core.folder, float(seconds)


@pytest.mark.parametrize(
    ("lines_hz", "pictures_hz", "picture_bytes", "samples_a_line"),
    [
        (20, 0, 0, 0), (100, 0, 0, 0), (1000, 0, 0, 0), (100, 15, 0, 0), (100, 15, 3_000, 0), (100, 15, 20_000, 0),
        (100, 2, 20_000, 0), (100, 0, 0, 2), (100, 0, 0, 10),
    ],
)  # fmt: skip
def test_check_foresees_what_status_measures(
    tmp_path: Path, lines_hz: int, pictures_hz: int, picture_bytes: int, samples_a_line: int
) -> None:
    rates = Rates()
    rates.add(RecordingSnapshot(START_NS, {}, {}, 0, {}))
    rng = np.random.default_rng(0)
    folder, seconds = record(tmp_path, rng, lines_hz, pictures_hz, picture_bytes, samples_a_line)
    written = sum(each.stat().st_size for each in folder.iterdir())
    rates.add(RecordingSnapshot(START_NS + round(seconds * S), {}, {}, written, {}))
    foreseen = hours_until_full(
        10**12, Load(lines_hz, pictures_hz, 5.0, picture_bytes, lines_hz * samples_a_line).bytes_per_s
    )
    measured = hours_until_full(10**12, rates.bytes_per_s())
    assert foreseen is not None
    assert measured is not None
    assert 0.75 < foreseen / measured < 1.33  # how well readings can be compressed differs


def test_nobody_knows_how_long_a_disk_lasts_that_nothing_is_written_to() -> None:
    assert hours_until_full(10**9, None) is None
    assert hours_until_full(10**9, 0.0) is None


@pytest.mark.parametrize(("free_mb", "passed"), [(0, False), (500, False), (520, True)])
def test_a_full_disk_does_not_pass(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, free_mb: int, passed: bool) -> None:
    """3.1 kB/s for an hour are 11 MB, beside the 500 MB that stay free."""
    monkeypatch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=free_mb * 1_000_000))
    result = check._check_disk(tmp_path, Load(100.0, 0.0, 0.0, 0), 500)
    assert result.passed == passed
    assert "inf" not in result.text


def test_a_camera_that_ends_while_check_looks_has_been_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    class Short(Scripted):
        def read(self, timeout_s: float) -> list[Frame]:
            if not self._frames:
                raise CameraEndedError("over")
            return super().read(timeout_s)

    monkeypatch.setattr(check, "camera_for", lambda _settings, clock, since_ns: Short(clock, since_ns, 0, 20))
    assert check._probe_camera(CameraSettings("drive.avi", 160, 120, 15.0), RunClock()).rate_hz == pytest.approx(10.0)
    monkeypatch.setattr(check, "camera_for", lambda _settings, clock, since_ns: Short(clock, since_ns, 0, 0))
    with pytest.raises(CameraEndedError, match="over"):
        check._probe_camera(CameraSettings("drive.avi", 160, 120, 15.0), RunClock())


def test_check_counts_with_what_the_devices_give_or_else_with_robot_yaml(tmp_path: Path) -> None:
    files = RobotFiles(robot_yaml(tmp_path, "{encoder_port: port, camera: pictures}"))
    camera = {"": check._CameraFindings(2.0, 3_000)}
    assert check._load_of(files, check._DeviceFindings(50.0, cameras=camera)) == Load(50.0, 2.0, 5.0, 3_000)
    assert check._load_of(files, check._DeviceFindings(50.0, 200.0)).samples_hz == 200.0
    assert Load(50.0, 2.0, 5.0, 3_000).kept_pictures_hz == 2.0
    assert check._load_of(files, check._DeviceFindings()) == Load(100.0, 15.0, 5.0, 0.22 * 160 * 120)
    port_only = RobotFiles(robot_yaml(tmp_path, "{encoder_port: port}"))
    assert check._load_of(port_only, check._DeviceFindings()).bytes_per_s == pytest.approx(5_400.0)


class Scripted(Camera):
    """Gives a backlog at once, 150 pictures a second by their arrival, then ten new ones a second."""

    def __init__(self, clock: RunClock, since_ns: int, backlog: int, new: int) -> None:
        begun_ns = clock.now_ns()
        old = [(-S, k * S // 150) for k in range(backlog)]
        fresh = [(k * S // 10,) * 2 for k in range(1, new + 1)]
        self._frames = [
            Frame(b"", begun_ns + stamp, begun_ns + arrival, StampSource.STAMP_SOURCE_FILE_NAME, 0)
            for stamp, arrival in old + fresh
            if begun_ns + stamp >= since_ns
        ]

    def open(self) -> list[str]:
        return []

    def read(self, timeout_s: float) -> list[Frame]:
        frames, self._frames = self._frames, []
        return frames

    def close(self) -> None:
        pass


@pytest.mark.parametrize(("backlog", "new", "rate_hz"), [(0, 20, 10.0), (300, 20, 10.0), (300, 0, None)])
def test_a_backlog_is_no_rate(monkeypatch: pytest.MonkeyPatch, backlog: int, new: int, rate_hz: float | None) -> None:
    monkeypatch.setattr(check, "camera_for", lambda _settings, clock, since_ns: Scripted(clock, since_ns, backlog, new))
    monkeypatch.setattr(check, "_LISTEN_NS", 50 * MS)
    look = check._probe_camera(CameraSettings("pictures", 160, 120, 15.0), RunClock())
    assert look.rate_hz == (None if rate_hz is None else pytest.approx(rate_hz))
