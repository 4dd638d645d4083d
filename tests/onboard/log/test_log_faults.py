"""A log whose disk thread meets an unexpected error: reported, counted, and continued in a new file."""

import errno
import fcntl
import os
import threading
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from groundsbot.onboard.errors import OnboardError
from groundsbot.onboard.log.writing.segments import LogSegments, SegmentLimits
from groundsbot.onboard.log.writing.storage import Disk
from groundsbot.onboard.log.writing.writer import head_records
from groundsbot.onboard.recorder.disk.log_keeper import LogKeeper
from groundsbot.onboard.recorder.disk.log_thread import LogThread
from groundsbot.onboard.recorder.disk.room import BALLAST_BYTES, DiskRoom, SpacePolicy, one_recorder
from tests.support.data.logs import MS, START_NS, facts, head, picture_entry, wheel_entry
from tests.support.devices.fake_disks import TroubledDisk
from tests.support.devices.kept_logs import LIMIT_S, MB, S, contents_of, make_keeper, record, texts
from tests.support.devices.live_recording import until

READINGS = [wheel_entry(index, START_NS + index * 10 * MS) for index in range(300)]


def failing_once(monkeypatch: pytest.MonkeyPatch, owner: type, name: str, when: Callable[..., bool]) -> threading.Event:
    """Lets a method fail as no disk does, once; the event shows that it did."""
    whole, failed = getattr(owner, name), threading.Event()

    def fails(self: object, *given: object) -> object:
        if not failed.is_set() and when(*given):
            failed.set()
            raise MemoryError
        return whole(self, *given)

    monkeypatch.setattr(owner, name, fails)
    return failed


@pytest.mark.parametrize("name", ["commit", "sync", "finish"])
def test_an_error_that_is_none_of_the_disks_costs_a_new_file_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    disk = TroubledDisk()
    keeper = make_keeper(tmp_path, disk)
    for part in (READINGS[:100], READINGS[100:200], READINGS[200:]):
        if part[0] is READINGS[100]:
            failing_once(monkeypatch, LogSegments, name, lambda: True)
        for entry in part:
            keeper.write(*entry)
        keeper.step(0.0)
    keeper.finish(0.0)
    assert sorted(contents_of(tmp_path)) == sorted(facts(READINGS))
    assert [text for text in texts(keeper) if "MemoryError" in text]


def test_a_reading_that_no_file_takes_is_lost_alone_and_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bad_ns = READINGS[50].log_time_ns
    append = LogSegments.append

    def refuses(self: LogSegments, record: object) -> None:
        if getattr(record, "log_time_ns", 0) == bad_ns:
            raise ValueError("too odd")
        append(self, record)  # type: ignore[arg-type]  # a Record, as it came

    monkeypatch.setattr(LogSegments, "append", refuses)
    keeper = make_keeper(tmp_path, TroubledDisk())
    for entry in READINGS:
        keeper.write(*entry)
    keeper.step(0.0)
    keeper.finish(0.0)
    assert contents_of(tmp_path) == facts([*READINGS[:50], *READINGS[51:]])
    assert keeper.status.lost == {"/wheels": 1}


def test_a_fault_in_the_logs_thread_does_not_end_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    failed = failing_once(monkeypatch, DiskRoom, "is_low", lambda: True)
    log = LogThread(make_keeper(tmp_path, TroubledDisk()), period_s=0.01)
    assert failed.wait(LIMIT_S)
    for entry in READINGS:
        log.write(*entry)
    until(lambda: log.status.waiting_bytes == 0, "the readings on the disk")
    log.close()
    assert contents_of(tmp_path) == facts(READINGS)
    (note,) = [note for note in log.take_notes() if "MemoryError" in note.text]
    assert note.lost


def test_what_a_thread_leaves_that_cannot_finish_is_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    disk = TroubledDisk()
    disk.fails = lambda what, path: errno.EIO
    log = LogThread(make_keeper(tmp_path, disk), period_s=0.01)
    for entry in READINGS:
        log.write(*entry)
    failing_once(monkeypatch, LogKeeper, "finish", lambda _: True)
    log.close()
    lost: dict[str, int] = {}
    for note in log.take_notes():
        lost |= note.lost
    assert lost["/wheels"] == len(READINGS)


class NosyPath(type(Path())):  # type: ignore[misc]  # the class of paths on this system
    """Another process continues while its name is read."""

    meanwhile: Callable[[], None] = staticmethod(lambda: None)

    @property
    def name(self) -> str:
        type(self).meanwhile()
        return str(super().name)


def test_names_can_be_read_while_files_come_and_go(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = NosyPath(tmp_path / "a.mcap")

    def files(_number: int) -> Sequence[tuple[Path, tuple[str, ...]]]:
        return [(path, ("/run", "/tf", "/camera/calibration", "/wheels"))]

    segments = LogSegments(Disk(durable=False), files, head_records(tmp_path, head(), START_NS), None)
    segments.open(START_NS)
    monkeypatch.setattr(NosyPath, "meanwhile", segments.discard)
    assert segments.names in ("a.mcap", "")


def test_old_pictures_that_are_deleted_when_the_disk_is_full_are_reported(tmp_path: Path) -> None:
    disk = TroubledDisk()
    old = tmp_path / "old" / "0000.camera.mcap"
    old.parent.mkdir()
    old.write_bytes(b"x")
    disk.set_used(old, 10 * MB)
    keeper = make_keeper(tmp_path, disk, policy=SpacePolicy(500 * MB, remove_old_pictures=True))
    keeper.step(0.0)  # there is room, and it is looked at again in 10 s
    disk.capacity_bytes = disk.used()
    keeper.write(*READINGS[0])
    keeper.step(0.5)
    assert not old.exists()
    (told,) = [text for text in texts(keeper) if text.startswith("removed")]
    assert "1 old files" in told
    assert str(old) in told


@pytest.mark.parametrize("left_bytes", [0, BALLAST_BYTES - 1])
def test_a_ballast_that_was_left_too_small_is_made_anew(tmp_path: Path, left_bytes: int) -> None:
    ballast = tmp_path / ".gb1.ballast"
    with ballast.open("wb") as file:
        file.truncate(left_bytes)
    room = DiskRoom(Disk(durable=False), tmp_path, "gb1", SpacePolicy(0))
    room.take_ballast()
    assert ballast.stat().st_size == BALLAST_BYTES
    made = ballast.stat().st_ino
    room.take_ballast()
    assert ballast.stat().st_ino == made
    room.drop_ballast()


@pytest.mark.parametrize("output", ["/dev/null/logs", "robot.yaml"])
def test_a_place_where_nothing_can_be_recorded_is_one_line(tmp_path: Path, output: str) -> None:
    robot = tmp_path / "robot.yaml"
    robot.write_text("a")
    with pytest.raises(OnboardError, match="cannot record here"), one_recorder(robot, tmp_path / output, "gb1"):
        pass


def test_an_error_of_the_recording_is_none_of_the_lock(tmp_path: Path) -> None:
    robot = tmp_path / "robot.yaml"
    robot.write_text("a")
    with pytest.raises(BlockingIOError), one_recorder(robot, tmp_path / "logs", "gb1"):
        raise BlockingIOError


def test_row_12_a_disk_too_full_for_the_lock_leaves_robot_yamls(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot, whole = tmp_path / "robot.yaml", os.open
    robot.write_text("a")

    def full(path: str | Path, flags: int, *mode: int) -> int:
        if str(path).endswith("gb1.lock"):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        return whole(path, flags, *mode)

    monkeypatch.setattr(os, "open", full)
    other = one_recorder(robot, tmp_path / "other", "gb1")
    with one_recorder(robot, tmp_path / "logs", "gb1"), pytest.raises(OnboardError, match="is being recorded"), other:
        pass


def test_locks_are_out_of_the_reach_of_other_users(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Who can open a file can hold a lock on it, and so keep the robot from being recorded."""
    robot, output, runtime = tmp_path / "robot.yaml", tmp_path / "logs", tmp_path / "run"
    robot.write_text("a")
    runtime.mkdir()
    output.mkdir()
    (output / ".gb1.lock").touch(mode=0o644)  # of an earlier version
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(runtime))
    with robot.open() as file:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        with one_recorder(robot, output, "gb1"):
            (lock,) = (runtime / "groundsbot").iterdir()
            for each, mode in ((lock.parent, 0o700), (lock, 0o600), (output / ".gb1.lock", 0o600)):
                assert each.stat().st_mode & 0o777 == mode


@pytest.mark.parametrize("kind", ["open to all", "link", "file"])
def test_a_folder_for_locks_that_is_not_private_is_not_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    """Another user may have made it; that blocks no recording, and a recording elsewhere is still found."""
    robot, runtime, spare, theirs = tmp_path / "robot.yaml", tmp_path / "run", tmp_path / "spare", tmp_path / "theirs"
    robot.write_text("a")
    for folder in (runtime, spare, theirs):
        folder.mkdir()
    if kind == "open to all":
        (runtime / "groundsbot").mkdir()
        (runtime / "groundsbot").chmod(0o755)
    elif kind == "link":
        (runtime / "groundsbot").symlink_to(theirs)
    else:
        (runtime / "groundsbot").touch()
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(runtime))
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(spare))
    with one_recorder(robot, tmp_path / "logs", "gb1"):
        assert len(list((spare / "groundsbot").iterdir())) == 1
        assert list(theirs.iterdir()) == []
        with pytest.raises(OnboardError, match="is being recorded"), one_recorder(robot, tmp_path / "other", "gb1"):
            pass


def test_logs_are_readable_by_their_group_only(tmp_path: Path) -> None:
    umask = os.umask(0)
    try:
        with one_recorder(tmp_path / "robot.yaml", tmp_path / "logs", "gb1"):
            record(make_keeper(tmp_path / "logs", Disk(), pictures=True), [wheel_entry(0, START_NS)])
    finally:
        os.umask(umask)
    made = [tmp_path / "logs", *(tmp_path / "logs").rglob("*")]
    assert {path.name: path.stat().st_mode & 0o777 for path in made} == {
        "logs": 0o750,
        "run1": 0o750,
        "0000.core.mcap": 0o640,
        "0000.camera.mcap": 0o640,
        ".gb1.lock": 0o600,
    }


class CountingDisk(TroubledDisk):
    """Counts what the disk is waited for."""

    def __init__(self) -> None:
        super().__init__()
        self.n_syncs = 0
        self.fails = self._count

    def _count(self, act: str, _path: Path) -> int:
        self.n_syncs += act == "sync"
        return 0

    def sync_folder(self, folder: Path) -> None:
        self.n_syncs += 1


def test_a_new_segment_costs_a_step_no_finishing_of_the_old_one(tmp_path: Path) -> None:
    """Readings that come meanwhile wait for that step; the two old files are finished in the next two."""
    disk, counts = CountingDisk(), []
    keeper = make_keeper(tmp_path, disk, SegmentLimits(1750 * MS, 1 << 40), pictures=True)
    for step in range(9):
        for at_ns in (START_NS + step * S // 2, START_NS + step * S // 2 + S // 4):
            keeper.write(*wheel_entry(step, at_ns))
            keeper.write(*picture_entry(at_ns + MS, b"x"))
        disk.n_syncs = 0
        keeper.step(step / 2.0)
        counts.append(disk.n_syncs)
    assert counts[1:7] == [2, 2, 5, 4, 4, 2]
    keeper.finish(9.0)
    assert len(contents_of(tmp_path)) == 36
