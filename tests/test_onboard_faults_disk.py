"""Disks that fill up, fail, block or lose power under a recording. Rows of the table of faults."""

import errno
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from onboard.disk_room import BALLAST_BYTES, DiskRoom, SpacePolicy, one_recorder
from onboard.errors import LogError, OnboardError
from onboard.log_keeper import LogKeeper
from onboard.log_reader import read_log
from onboard.log_segments import SegmentLimits
from onboard.log_thread import LogThread
from onboard.storage import Storage
from tests.fake_disks import MortalDisk, TroubledDisk
from tests.made_logs import MS, START_NS, Entry, drive, head, picture_entry, read_all, seen, wheel_entry, write_log

S = 1000 * MS
MB = 1 << 20
UNLIMITED = SegmentLimits(1 << 62, 1 << 62)
CORE = "0000.core.mcap"
STEP_NS = 500 * MS
LIMIT_S = 30.0  # only what hangs comes near


def make_keeper(
    folder: Path,
    disk: Storage,
    limits: SegmentLimits = UNLIMITED,
    policy: SpacePolicy | None = None,
    run_id: str = "run1",
    pictures: bool = False,
) -> LogKeeper:
    room = DiskRoom(disk, folder, "gb1", policy or SpacePolicy(0))
    return LogKeeper(folder / run_id, head(run_id), START_NS, disk, room, keep_pictures=pictures, limits=limits)


def stepped(keeper: LogKeeper, entries: list[Entry]) -> Iterator[int]:
    """Writes entries, and steps every half second of log time; yields the time after each step."""
    next_ns = START_NS
    for entry in entries:
        while entry.log_time_ns >= next_ns:
            keeper.step((next_ns - START_NS) / S)
            yield next_ns
            next_ns += STEP_NS
        keeper.write(*entry)
    keeper.step((next_ns - START_NS) / S)
    yield next_ns


def record(keeper: LogKeeper, entries: list[Entry]) -> None:
    for _ in stepped(keeper, entries):
        pass
    keeper.finish(1e6)


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def texts(keeper: LogKeeper) -> list[str]:
    return [note.text for note in keeper.take_notes()]


@pytest.mark.parametrize("count", [60, pytest.param(200, marks=pytest.mark.long)])
def test_row_01b_a_power_cut_at_any_point(tmp_path: Path, count: int) -> None:
    """Everything older than a second is there, in whatever state the cut leaves the rest."""
    disk = MortalDisk()
    entries = drive(6.0, picture_hz=10, picture_bytes=9000)
    keeper = make_keeper(Path("logs"), disk, SegmentLimits(1700 * MS, 1 << 40), pictures=True)
    done_ns: list[int] = []  # by act: when it was done
    for at_ns in stepped(keeper, entries):
        done_ns += [at_ns] * (len(disk.acts) - len(done_ns))
    keeper.finish(10.0)
    done_ns += [entries[-1].log_time_ns + S] * (len(disk.acts) - len(done_ns))
    written = seen(entries)
    rng = np.random.default_rng(1)
    for trial, n_acts in enumerate(np.linspace(1, len(disk.acts), count).astype(int).tolist()):
        folder = tmp_path / str(trial)
        for path, content in disk.after_power_cut(n_acts, rng).items():
            if path.suffix != ".ballast":
                (folder / path).parent.mkdir(parents=True, exist_ok=True)
                (folder / path).write_bytes(content)
        promised = [each for each in written if each[1] <= done_ns[n_acts - 1] - S]
        try:
            found, _ = read_all(folder / "logs" / "run1")
        except LogError:
            assert promised == []
            continue
        assert len(set(found)) == len(found)
        assert set(promised) <= set(found) <= set(written)


def test_row_10_a_start_after_a_kill_leaves_what_was_there(tmp_path: Path) -> None:
    write_log(tmp_path / "run1", drive(2.0), finished=False)
    left = (tmp_path / "run1" / f"{CORE}.active").read_bytes()
    record(make_keeper(tmp_path, TroubledDisk(), run_id="run2"), drive(1.0))
    assert (tmp_path / "run1" / f"{CORE}.active").read_bytes() == left
    assert read_all(tmp_path / "run1")[0] == seen(drive(2.0))
    assert list(read_log(tmp_path / "run2"))
    # And within the same run, as after a failure of the disk: another file, not the one that is there.
    record(make_keeper(tmp_path, TroubledDisk(), run_id="run1"), drive(1.0))
    assert names(tmp_path / "run1") == [f"{CORE}.active", "0001.core.mcap"]
    assert (tmp_path / "run1" / f"{CORE}.active").read_bytes() == left


def test_row_11_disk_full_in_mid_chunk(tmp_path: Path) -> None:
    disk = TroubledDisk(BALLAST_BYTES + 5 * MB)
    keeper = make_keeper(tmp_path, disk, pictures=True)
    entries = drive(6.0, picture_hz=10, picture_bytes=300_000)
    red = [keeper.status.problem for _ in stepped(keeper, entries)][-1]
    assert red is not None
    assert "No space left" in red
    assert names(tmp_path / "run1") == ["0000.camera.mcap", CORE]  # finished, with the ballast's room
    before = list(read_log(tmp_path / "run1"))  # strict: no torn chunk
    assert before
    assert not (tmp_path / ".gb1.ballast").exists()
    disk.capacity_bytes = 1 << 40
    record(keeper, [wheel_entry(10_000, START_NS + 20 * S)])
    assert keeper.status.problem is None
    found = [(each.topic, each.publish_time_ns) for each in read_log(tmp_path / "run1")]
    wanted = [(each.topic, each.publish_time_ns) for each in entries] + [("/wheels", START_NS + 20 * S)]
    assert sorted(found[3:]) == sorted(wanted)  # memory held what the disk did not take
    assert [text for text in texts(keeper) if "recording again, in 0001.core.mcap" in text]


class GreedyDisk(TroubledDisk):
    """Somebody else takes whatever room there comes to be."""

    def remove(self, path: Path) -> None:
        super().remove(path)
        self.capacity_bytes = self.used()


def test_row_11_disk_full_for_good(tmp_path: Path) -> None:
    """The file cannot be finished, and still holds whole chunks only."""
    disk = GreedyDisk(BALLAST_BYTES + 5 * MB)
    entries = drive(6.0, picture_hz=10, picture_bytes=300_000)
    keeper = make_keeper(tmp_path, disk, pictures=True)
    for _ in stepped(keeper, entries):
        pass
    assert names(tmp_path / "run1") == ["0000.camera.mcap.active", f"{CORE}.active"]
    found, losses = read_all(tmp_path / "run1")
    assert set(found) < set(seen(entries))
    assert len(losses.unfinished) == 2
    assert not losses.n_lost


def test_row_11_on_a_real_disk_that_is_full(tmp_path: Path) -> None:
    """A tmpfs of 30 MiB in a mount namespace of its own, where that is permitted."""
    script = f"""
import pathlib, sys
sys.path.insert(0, {str(Path(__file__).parents[1])!r})
from onboard.log_reader import read_log
from onboard.storage import Disk
from tests.made_logs import drive
from tests.test_onboard_faults_disk import make_keeper, stepped
folder = pathlib.Path({str(tmp_path)!r})
keeper = make_keeper(folder, Disk(), pictures=True)
problems = [keeper.status.problem for _ in stepped(keeper, drive(5.0, picture_hz=20, picture_bytes=400_000))]
assert "No space left" in problems[-1], problems
assert sorted(path.name for path in (folder / "run1").iterdir()) == ["0000.camera.mcap", "0000.core.mcap"]
print(len(list(read_log(folder / "run1"))), "read")
"""
    mount = f'mount -t tmpfs -o size=30m none {tmp_path} || exit 77; exec "$0" -c "$1"'
    command = ["unshare", "--mount", "--map-root-user", "sh", "-c", mount, sys.executable, script]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    if ended.returncode == 77 or "unshare" in ended.stderr:
        pytest.skip("mounting a tmpfs is not permitted here; the disk of the test above fails as the kernel does")
    assert ended.returncode == 0, ended.stderr
    assert "read" in ended.stdout


def test_row_12_disk_full_from_the_start(tmp_path: Path) -> None:
    disk = TroubledDisk(capacity_bytes=100)
    keeper = make_keeper(tmp_path, disk)
    entries = drive(8.0)
    for at_ns in stepped(keeper, entries):
        if at_ns < START_NS + 4 * S:
            assert keeper.status.problem is not None
        elif at_ns == START_NS + 4 * S:
            disk.capacity_bytes = 1 << 40
    assert keeper.status.problem is None
    keeper.finish(100.0)
    assert names(tmp_path / "run1") == [CORE]
    assert seen_in(tmp_path) == seen(entries)
    assert [text for text in texts(keeper) if "recording again" in text]


def seen_in(folder: Path) -> list[tuple[str, int, int, bytes]]:
    found, losses = read_all(folder / "run1")
    assert not losses.n_lost
    return found


def test_row_12_what_memory_cannot_hold_is_counted(tmp_path: Path) -> None:
    disk = TroubledDisk(capacity_bytes=100)
    keeper = make_keeper(tmp_path, disk, pictures=True)
    keeper.step(0.0)
    n_pictures, n_readings = 200, 400_000
    taken = sum(keeper.write(*picture_entry(START_NS + index * MS, b"\xff" * 300_000)) for index in range(n_pictures))
    for index in range(n_readings):
        keeper.write(*wheel_entry(index, START_NS + S + index * MS))
    assert keeper.status.waiting_bytes <= 64 * MB
    lost = keeper.status.lost
    assert taken < n_pictures == lost["/camera/image"]  # those that were taken had to go for the readings
    assert 0 < lost["/wheels"] < n_readings
    disk.capacity_bytes = 1 << 40
    keeper.finish(100.0)
    readings = [each for each in seen_in(tmp_path) if each[0] == "/wheels"]
    assert len(readings) == n_readings - lost["/wheels"]
    assert readings[-1][2] == START_NS + S + (n_readings - 1) * MS  # the oldest went
    told = {topic: count for note in keeper.take_notes() for topic, count in note.lost.items()}
    assert told == lost


@pytest.mark.parametrize("allowed", [False, True])
def test_row_13_little_space(tmp_path: Path, allowed: bool) -> None:
    """Only finished files of pictures go, oldest first, as many as are needed, and only if that is allowed."""
    disk = TroubledDisk()
    for age, run_id in enumerate(("new", "middle", "old")):
        files = [tmp_path / run_id / name for name in (CORE, "0000.camera.mcap", "0001.camera.mcap.active")]
        files[0].parent.mkdir()
        for file in files:
            file.write_bytes(b"x" * 100)
            disk.set_used(file, 10 * MB)
            os.utime(file, (1e9 - age, 1e9 - age))
    disk.capacity_bytes = disk.used() + BALLAST_BYTES + 30 * MB
    keeper = make_keeper(tmp_path, disk, policy=SpacePolicy(45 * MB, allowed), pictures=True)
    entries = drive(12.0, picture_hz=2)
    record(keeper, entries)
    gone = {f"{each}/0000.camera.mcap" for each in ("old", "middle")} if allowed else set()
    expected = {f"{run}/{name}" for run in ("new", "middle", "old") for name in files_of_old()} - gone
    left = {str(path.relative_to(tmp_path)) for path in tmp_path.glob("[mno]*/*")}
    assert left == expected
    kept = [each for each in seen_in(tmp_path) if each[0] == "/camera/image"]
    assert len(kept) + keeper.status.lost.get("/camera/image", 0) == 24
    assert (len(kept) > 20) == allowed
    assert any("pictures" in text for text in texts(keeper))
    wheels = [each for each in seen(entries) if each[0] == "/wheels"]
    assert [each for each in seen_in(tmp_path) if each[0] == "/wheels"] == wheels


def files_of_old() -> tuple[str, ...]:
    return (CORE, "0000.camera.mcap", "0001.camera.mcap.active")


@pytest.mark.parametrize("act", ["write", "sync", "rename"])
@pytest.mark.parametrize("number", [errno.EIO, errno.EROFS])
def test_row_14_a_file_that_fails(tmp_path: Path, act: str, number: int) -> None:
    """An event, and on in a new file; nothing lost, nothing doubled, also where the file cannot be cut any more."""
    disk = TroubledDisk()
    keeper = make_keeper(tmp_path, disk, SegmentLimits(3 * S, 1 << 40))
    entries = drive(8.0)
    for at_ns in stepped(keeper, entries):
        if at_ns == START_NS + 2 * S:
            acts = (act, "truncate") if number == errno.EROFS else (act,)
            disk.fails = lambda what, path, acts=acts: number if what in acts and "0000" in path.name else 0  # type: ignore[misc]  # mypy: lambda's default
    keeper.finish(100.0)
    assert seen_in(tmp_path) == seen(entries)
    assert f"{CORE}.active" in names(tmp_path / "run1")
    n_stored = sum(len(read_all(file)[0]) for file in (tmp_path / "run1").iterdir())
    assert (n_stored > len(entries)) == (number == errno.EROFS and act == "sync")
    told = texts(keeper)
    assert any(os.strerror(number) in text for text in told)
    assert any(text.startswith("recording again") for text in told)


@contextmanager
def log_thread(keeper: LogKeeper, disk: TroubledDisk) -> Iterator[LogThread]:
    thread = LogThread(keeper, period_s=0.01)
    try:
        yield thread
    finally:
        disk.may_sync.set()
        thread.close()


def test_row_15_a_sync_that_blocks_holds_up_no_reading(tmp_path: Path) -> None:
    disk = TroubledDisk()
    keeper = make_keeper(tmp_path, disk, pictures=True)
    disk.may_sync.clear()
    with log_thread(keeper, disk) as thread:
        assert disk.syncing.wait(LIMIT_S)
        readings = [wheel_entry(index, START_NS + index * 10 * MS) for index in range(2000)]
        taken = []
        for index, entry in enumerate(readings):
            assert thread.write(*entry)
            if index % 10 == 0:
                taken.append(thread.write(*picture_entry(entry.publish_time_ns, b"\xff" * 400_000)))
        assert taken == sorted(taken, reverse=True)  # the first fit, then none
        assert True in taken
        assert taken.count(False) == thread.status.lost["/camera/image"]
    found = seen_in(tmp_path)
    assert [each for each in found if each[0] == "/wheels"] == seen(readings)
    assert len([each for each in found if each[0] == "/camera/image"]) == taken.count(True)
    assert {"/camera/image": taken.count(False)} in [note.lost for note in thread.take_notes()]


def test_row_19_one_recorder_a_robot(tmp_path: Path) -> None:
    robot, copy = tmp_path / "robot.yaml", tmp_path / "copy.yaml"
    robot.write_text("a")
    copy.write_text("a")
    with one_recorder(robot, tmp_path / "logs", "gb1"):
        for second in ((robot, tmp_path / "elsewhere"), (copy, tmp_path / "logs")):
            with pytest.raises(OnboardError, match="robot gb1 is being recorded already"), one_recorder(*second, "gb1"):
                pass
        with one_recorder(copy, tmp_path / "logs", "gb2"):
            pass
    with one_recorder(robot, tmp_path / "logs", "gb1"):  # and again, now that it is free
        pass


def test_row_39_new_segments_under_load(tmp_path: Path) -> None:
    disk = TroubledDisk()
    keeper = make_keeper(tmp_path, disk, SegmentLimits(1 * S, 200_000), pictures=True)
    entries = drive(20.0, wheel_hz=1000, picture_hz=30)
    with log_thread(keeper, disk) as thread:
        for entry in entries:
            assert thread.write(*entry)
    files = sorted((tmp_path / "run1").iterdir())
    assert len(files) >= 40
    assert not [file for file in files if file.suffix == ".active"]
    for file in files:
        assert [each.topic for each in read_log(file)][:3] == ["/run", "/camera/calibration", "/tf"]
    assert sorted(seen_in(tmp_path)) == sorted(seen(entries))
    log_times = [each[1] for each in seen_in(tmp_path)]
    assert log_times == sorted(log_times)


def test_row_40_a_stalled_disk_shows_and_earlier_data_are_intact(tmp_path: Path) -> None:
    disk = TroubledDisk()
    keeper = make_keeper(tmp_path, disk)
    with log_thread(keeper, disk) as thread:
        early = [wheel_entry(index, START_NS + index * MS) for index in range(100)]
        for entry in early:
            thread.write(*entry)
        wait_until(lambda: thread.status.waiting_bytes == 0)
        disk.may_sync.clear()
        disk.syncing.clear()
        thread.write(*wheel_entry(100, START_NS + S))
        assert disk.syncing.wait(LIMIT_S)
        wait_until(lambda: thread.stalled_s > 1.0)
        found, losses = read_all(tmp_path / "run1")  # as a restarted recorder's user finds it
        assert found[:100] == seen(early)
        assert not losses.n_lost
        disk.may_sync.set()
        wait_until(lambda: thread.stalled_s < 1.0)


def wait_until(condition: Callable[[], bool]) -> None:
    end_s = time.monotonic() + LIMIT_S
    while not condition():
        assert time.monotonic() < end_s
        time.sleep(0.01)
