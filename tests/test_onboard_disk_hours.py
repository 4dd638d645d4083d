"""How long a disk lasts: what `check` foresees is what `status` will measure; and what a camera's rate is."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from onboard import check
from onboard.camera import Camera, CameraEndedError, CameraSettings, Frame
from onboard.clock import RunClock
from onboard.disk_hours import Load, hours_until_full
from onboard.messages import StampSource
from onboard.recorder import RecorderCore
from onboard.robot_files import RobotFiles
from onboard.status import Look, Rates
from onboard.tag_detector import Detection
from tests.live_recording import robot_yaml
from tests.made_cores import CAMERA, MS, START_NS, S, made_core, send

MINUTE = 60 * S


def record(core: RecorderCore, rng: np.random.Generator, pictures_hz: int, picture_bytes: int) -> None:
    """A minute of 100 lines a second, and of pictures with six tags."""
    next_ns = START_NS
    for index in range(100 * MINUTE // S):
        now_ns = send(core, index)
        if now_ns < next_ns:
            continue
        next_ns += S // pictures_hz
        tags = [Detection("tag36h11", k, 0, rng.uniform(30.0, 90.0), rng.uniform(0.0, 120.0, (4, 2))) for k in range(6)]
        if core.wants_picture(now_ns):
            core.on_picture(rng.bytes(picture_bytes), now_ns, now_ns)
        size_px = CAMERA.width_px, CAMERA.height_px
        core.on_detections(tags, size_px, now_ns, now_ns + MS, StampSource.STAMP_SOURCE_SIMULATION, index)


@pytest.mark.parametrize(("pictures_hz", "picture_bytes"), [(15, 0), (15, 3_000), (15, 20_000), (2, 20_000)])
def test_check_foresees_what_status_measures(tmp_path: Path, pictures_hz: int, picture_bytes: int) -> None:
    core = made_core(tmp_path)
    rates = Rates()
    rates.add(Look(START_NS, {}, {}, 0))
    record(core, np.random.default_rng(0), pictures_hz, picture_bytes)
    core.close(START_NS + MINUTE)
    written = sum(each.stat().st_size for each in core.folder.iterdir())
    rates.add(Look(START_NS + MINUTE, {}, {}, written))
    foreseen = hours_until_full(10**12, Load(100.0, pictures_hz, 5.0, picture_bytes).bytes_per_s)
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
    assert check._look(CameraSettings("drive.avi", 160, 120, 15.0), RunClock()).rate_hz == pytest.approx(10.0)
    monkeypatch.setattr(check, "camera_for", lambda _settings, clock, since_ns: Short(clock, since_ns, 0, 0))
    with pytest.raises(CameraEndedError, match="over"):
        check._look(CameraSettings("drive.avi", 160, 120, 15.0), RunClock())


def test_check_counts_with_what_the_devices_give_or_else_with_robot_yaml(tmp_path: Path) -> None:
    files = RobotFiles(robot_yaml(tmp_path, "{encoder_port: port, camera: pictures}"))
    assert check._load_of(files, check._Found(50.0, 2.0, 3_000)) == Load(50.0, 2.0, 5.0, 3_000)
    assert Load(50.0, 2.0, 5.0, 3_000).kept_pictures_hz == 2.0
    assert check._load_of(files, check._Found()) == Load(100.0, 15.0, 5.0, 0.22 * 160 * 120)
    port_only = RobotFiles(robot_yaml(tmp_path, "{encoder_port: port}"))
    assert check._load_of(port_only, check._Found()).bytes_per_s == pytest.approx(3_100.0)


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
    look = check._look(CameraSettings("pictures", 160, 120, 15.0), RunClock())
    assert look.rate_hz == (None if rate_hz is None else pytest.approx(rate_hz))
