"""A long day: memory, files and threads stay what they were. A row of the table of faults."""

import multiprocessing
import os
import threading
import time
import tracemalloc
from pathlib import Path

import pytest

from groundsbot.fixtures.recording.devices import PictureFolder
from groundsbot.onboard.camera.folder import FolderCamera
from groundsbot.onboard.log.messages import StampSource
from groundsbot.onboard.process.clock import RunClock
from groundsbot.onboard.wheels.protocol import WheelLine, format_line
from tests.support.devices.live_recording import Driver, recording, robot_yaml, tag_jpeg, until
from tests.support.devices.recorder_cores import MS, START_NS, S, make_core

_PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")


@pytest.mark.parametrize("minutes", [2, pytest.param(24 * 60, marks=pytest.mark.long)])
def test_row_42_a_day_of_readings_and_pictures_takes_no_more_memory_than_its_beginning(
    tmp_path: Path, minutes: int
) -> None:
    """The recorder's core as fast as it goes, a new file every 15 s; noise, gaps and clock steps among the readings."""
    core, jpeg, in_use = make_core(tmp_path), tag_jpeg(), []
    tracemalloc.start()
    for index in range(minutes * 6000):
        now_ns = START_NS + index * 10 * MS
        line = format_line(WheelLine(7, index, index * 10_000 % 2**32, 13 * index, -14 * index, 0))
        core.on_serial_bytes(b"noise\r\n" if index % 500 == 7 else line, now_ns)
        if index % 20 == 0:
            if core.wants_picture(now_ns):
                core.on_picture(jpeg, now_ns, now_ns)
            core.on_detections([], (160, 120), now_ns, now_ns, StampSource.STAMP_SOURCE_CAMERA, index // 20)
        if index % 25 == 0:
            core.tick(now_ns, now_ns + index // 6000 * S)
        if index % 500 == 499:
            in_use.append(tracemalloc.get_traced_memory()[0])
    tracemalloc.stop()
    core.close(START_NS + minutes * 60 * S)
    third = len(in_use) // 3
    assert len(list(core.folder.iterdir())) >= 8 * minutes
    assert max(in_use[-third:]) < max(in_use[:third]) + 100_000, in_use


def resources_in_use() -> tuple[int, int, int]:
    """Threads, open files and children of this process."""
    files = len(list(Path("/proc/self/fd").iterdir()))
    return threading.active_count(), files, len(multiprocessing.active_children())


def memory_mb() -> float:
    """What this process has in memory."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * _PAGE_BYTES / 1e6


@pytest.mark.parametrize("n_looks", [9, pytest.param(9_000, marks=pytest.mark.long)])
def test_row_42_a_live_day_at_ten_times_the_speed(tmp_path: Path, n_looks: int) -> None:
    """1 kHz of lines, 50 pictures a second into a folder that is emptied behind, a replug now and then."""
    robot = robot_yaml(tmp_path, f"{{encoder_port: {tmp_path / 'wheels'}, camera: pictures}}")
    camera, picture = PictureFolder(tmp_path / "pictures", keep=200), tag_jpeg()
    looks: list[tuple[float, int, int, int]] = []
    with Driver(tmp_path / "wheels", 1000.0) as driver:
        driver.plug_in()
        with recording(robot, tmp_path / "logs") as made:
            made.wait_for_messages("/wheels", 100)
            while len(looks) < n_looks:
                for _ in range(50):
                    camera.show(picture)
                    time.sleep(0.018)
                looks.append((memory_mb(), *resources_in_use()))
                if len(looks) % 4 == 0:
                    lost = made.count("port_lost")
                    driver.unplug()
                    until(lambda lost=lost: made.count("port_lost") > lost, "the port lost")  # type: ignore[misc]
                    driver.plug_in()
    third = len(looks) // 3
    first, last = looks[third:-third], looks[-third:]
    assert min(look[0] for look in last) < max(look[0] for look in first) + 20.0, looks
    for what in (1, 2, 3):
        assert min(look[what] for look in last) <= max(look[what] for look in first), looks


def test_row_42_a_folder_that_is_emptied_behind_takes_no_memory(tmp_path: Path) -> None:
    camera, shown = FolderCamera(tmp_path, RunClock(), since_ns=0), PictureFolder(tmp_path, keep=10)
    camera.open()
    n_seen = 0
    for _ in range(300):
        shown.show(tag_jpeg())
        n_seen += len(camera.read(1.0))
    assert n_seen == 300
    assert len(camera._seen) + len(camera._unfinished) <= 11
