"""The promise held by the whole recorder, by each message's stamp, on a clock of the test's own: no load matters.

Core and log run as they do live, but in one thread: whatever waits (for the next step, for the disk) lets the test's
clock go on, and what arrives meanwhile reaches the core then.
"""

import heapq
from collections.abc import Callable
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from groundsbot.calib.robot.robot_yaml import parse_robot_yaml
from groundsbot.onboard.errors import LogError
from groundsbot.onboard.log.messages import Gyro, LogHead, StampSource, TagDetections, WheelEncoders
from groundsbot.onboard.log.writing.segments import SegmentLimits
from groundsbot.onboard.log.writing.storage import StoredFile
from groundsbot.onboard.recorder.disk import log_thread
from groundsbot.onboard.recorder.disk.log_keeper import LogKeeper
from groundsbot.onboard.recorder.disk.log_thread import LogThread
from groundsbot.onboard.recorder.disk.room import DiskRoom, SpacePolicy
from groundsbot.onboard.recorder.recorder import RecorderCore, RunIdentity
from groundsbot.onboard.wheels.protocol import GyroLine, format_gyro_line, format_line
from tests.support.data.logs import MS, read_all
from tests.support.devices.fake_disks import MortalDisk
from tests.support.devices.recorder_cores import CAMERA, ROBOT_YAML, START_NS, UPTIME_NS, line_of

S = 1000 * MS
END_NS = 11 * S
SYNC_NS = 100 * MS  # a slow card
RESET_NS = 7900 * MS  # a controller's new boot, whose readings are held back as a new segment is due
TICK_NS = 150 * MS  # as late as they come
FRAME_NS = 100 * MS
DETECTION_NS = 60 * MS
SAMPLE_NS = 5 * MS  # of the gyro, in the longest batches that there are
BATCH = 20

Found = tuple[str, int]  # topic and number


class LogicalTime:
    """A clock that goes on only where somebody waits; what is due then is done."""

    def __init__(self) -> None:
        self.now_ns = 0
        self._order = count()
        self._due: list[tuple[int, int, Callable[[], None]]] = []

    def at(self, at_ns: int, act: Callable[[], None]) -> None:
        heapq.heappush(self._due, (at_ns, next(self._order), act))

    def go_on(self, by_ns: int) -> None:
        until_ns = self.now_ns + by_ns
        while self._due and self._due[0][0] <= until_ns:
            self.now_ns, _, act = heapq.heappop(self._due)
            act()
        self.now_ns = until_ns


class SlowDisk(MortalDisk):
    """Takes its time for each sync."""

    def __init__(self, time: LogicalTime) -> None:
        super().__init__()
        self._time = time

    def create(self, path: Path) -> StoredFile:
        file = super().create(path)

        def sync() -> None:
            self._time.go_on(SYNC_NS)
            file.sync()

        return cast(
            StoredFile,
            SimpleNamespace(write=file.write, truncate=file.truncate, close=file.close, sync=sync),
        )

    def sync_folder(self, folder: Path) -> None:
        self._time.go_on(SYNC_NS)
        super().sync_folder(folder)


class Nothing:
    """A power cut that leaves nothing but what was synced: in the place of chance."""

    def random(self) -> float:
        return 0.4

    def integers(self, low: int, _high: int) -> int:
        return low


def step_by_step(time: LogicalTime, monkeypatch: pytest.MonkeyPatch) -> None:
    """Lets LogThread wait on the test's clock, and do so in the test's thread."""

    class Event:
        def __init__(self) -> None:
            self._is_set = False

        def is_set(self) -> bool:
            return self._is_set

        def wait(self, timeout_s: float) -> bool:
            time.go_on(max(0, round(timeout_s * 1e9)))
            return time.now_ns >= END_NS

    class Thread:
        def __init__(self, **_: object) -> None:
            pass

        def start(self) -> None:
            pass

    monkeypatch.setattr(log_thread, "threading", SimpleNamespace(Event=Event, Thread=Thread))
    monkeypatch.setattr(log_thread, "time", SimpleNamespace(monotonic=lambda: time.now_ns / 1e9))


def record(
    monkeypatch: pytest.MonkeyPatch, *, wheels: bool, camera: bool, expect_wheels: bool
) -> tuple[SlowDisk, list[tuple[int, int]]]:
    """A recording of 11 s; its disk, and how much had been done to it at which time."""
    time, kills, logs = LogicalTime(), list[tuple[int, int]](), list[LogThread]()
    step_by_step(time, monkeypatch)
    disk = SlowDisk(time)

    def open_log(folder: Path, head: LogHead, start_ns: int, keep_pictures: bool) -> LogThread:
        room = DiskRoom(disk, folder.parent, "gb1", SpacePolicy(0))
        limits = SegmentLimits(4 * S, 1 << 40)
        logs.append(
            LogThread(LogKeeper(folder, head, start_ns, disk, room, keep_pictures=keep_pictures, limits=limits))
        )
        return logs[0]

    run = RunIdentity(parse_robot_yaml(ROBOT_YAML, "r"), ROBOT_YAML, CAMERA, "run1", START_NS, START_NS - UPTIME_NS)
    core = RecorderCore(Path("logs"), run, expect_wheels=expect_wheels, open_log=open_log)

    def wheel(index: int, at_ns: int) -> None:
        boot, since_ns = int(at_ns >= RESET_NS), at_ns - BATCH * SAMPLE_NS
        data = format_line(line_of(index, boot))
        if since_ns >= S and since_ns % (BATCH * SAMPLE_NS) == 0:
            first = since_ns // SAMPLE_NS
            rates = tuple(range(first, first + BATCH))
            turns = GyroLine(int(since_ns >= RESET_NS), first, since_ns // 1000, SAMPLE_NS // 1000, rates)
            data = format_gyro_line(turns) + data
        core.on_serial_bytes(data, START_NS + at_ns + MS)

    def frame(index: int, at_ns: int) -> None:
        stamp_ns, receive_ns = START_NS + at_ns, START_NS + at_ns + 30 * MS
        if core.wants_picture(stamp_ns):
            core.on_picture(b"\xff\xd8\xff" + bytes(5000) + b"\xff\xd9", stamp_ns, receive_ns)
        core.on_detections([], (160, 120), stamp_ns, receive_ns, StampSource.STAMP_SOURCE_CAMERA, index)

    for at_ns in range(0, END_NS, TICK_NS):
        time.at(at_ns, lambda at_ns=at_ns: core.tick(START_NS + at_ns))  # type: ignore[misc]  # mypy: lambda's default
    for at_ns in range(0, END_NS, 10 * MS):
        time.at(at_ns, lambda at_ns=at_ns: kills.append((at_ns, len(disk.acts))))  # type: ignore[misc]  # same
        if wheels and at_ns >= S:
            time.at(at_ns + MS, lambda at_ns=at_ns: wheel(at_ns // (10 * MS), at_ns))  # type: ignore[misc]  # same
    for index in range(END_NS // FRAME_NS if camera else 0):
        at_ns = index * FRAME_NS + 5 * MS
        time.at(at_ns + DETECTION_NS, lambda index=index, at_ns=at_ns: frame(index, at_ns))  # type: ignore[misc]  # same
    logs[0]._work()
    return disk, kills


def remains(disk: MortalDisk, n_acts: int, folder: Path) -> set[Found]:
    """What a power cut after so many acts leaves for sure."""
    for path, content in disk.after_power_cut(n_acts, cast(np.random.Generator, Nothing())).items():
        if path.suffix != ".ballast":
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
            (folder / path).write_bytes(content)
    found: set[Found] = set()
    try:
        messages, _ = read_all(folder / "logs" / "run1")
    except LogError:
        return found
    for topic, _, _, data in messages:
        if topic == "/wheels":
            found.add((topic, WheelEncoders.FromString(data).sequence))
        elif topic == "/gyro":
            found.add((topic, Gyro.FromString(data).sequence))
        elif topic == "/tags/detections":
            found.add((topic, TagDetections.FromString(data).frame_sequence))
    return found


@pytest.mark.parametrize(
    ("wheels", "camera", "expect_wheels"),
    [(True, False, True), (False, True, False), (False, True, True), (True, True, True)],
    ids=["wheels and gyro", "camera", "camera, wheels silent", "both"],
)
def test_row_01_whatever_was_measured_a_second_ago_is_on_the_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, wheels: bool, camera: bool, expect_wheels: bool
) -> None:
    """While the controller's clock is learnt, while tags wait for wheels, and while a new segment begins."""
    disk, kills = record(monkeypatch, wheels=wheels, camera=camera, expect_wheels=expect_wheels)
    found: dict[int, set[Found]] = {}
    late: set[Found] = set()
    for at_ns, n_acts in kills:
        n_synced = sum(act.what.startswith("sync") for act in disk.acts[:n_acts])
        if n_synced not in found:
            found[n_synced] = remains(disk, n_acts, tmp_path / str(n_synced))
        promised = {("/wheels", each) for each in range(100, (at_ns - S) // (10 * MS) + 1)} if wheels else set()
        if wheels:
            promised |= {("/gyro", each) for each in range(S // SAMPLE_NS, (at_ns - S) // SAMPLE_NS + 1)}
        if camera:
            promised |= {("/tags/detections", each) for each in range((at_ns - S - 5 * MS) // FRAME_NS + 1)}
        late |= promised - found[n_synced]
    assert late == set()
    assert len(found) > 30
