"""Disks that fail, block or lose power under a recording. Rows of the table of faults."""

import errno
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from groundsbot.onboard.errors import LogError, OnboardError
from groundsbot.onboard.log.reading.reader import read_log
from groundsbot.onboard.log.writing.segments import SegmentLimits
from groundsbot.onboard.recorder.disk import log_thread as log_thread_module
from groundsbot.onboard.recorder.disk.log_keeper import LogKeeper
from groundsbot.onboard.recorder.disk.log_thread import LogThread
from groundsbot.onboard.recorder.disk.room import one_recorder
from tests.support.data.logs import MS, START_NS, drive, facts, picture_entry, read_all, wheel_entry, write_log
from tests.support.devices.fake_disks import MortalDisk, TroubledDisk
from tests.support.devices.kept_logs import CORE, LIMIT_S, S, contents_of, make_keeper, names, record, step, texts


@pytest.mark.parametrize("count", [60, pytest.param(200, marks=pytest.mark.long)])
def test_row_01b_a_power_cut_at_any_point(tmp_path: Path, count: int) -> None:
    """Everything older than a second is there, in whatever state the cut leaves the rest."""
    disk = MortalDisk()
    entries = drive(6.0, picture_hz=10, picture_bytes=9000)
    keeper = make_keeper(Path("logs"), disk, SegmentLimits(1700 * MS, 1 << 40), pictures=True)
    done_ns: list[int] = []  # by act: when it was done
    for at_ns in step(keeper, entries):
        done_ns += [at_ns] * (len(disk.acts) - len(done_ns))
    keeper.finish(10.0)
    done_ns += [entries[-1].log_time_ns + S] * (len(disk.acts) - len(done_ns))
    written = facts(entries)
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
    assert read_all(tmp_path / "run1")[0] == facts(drive(2.0))
    assert list(read_log(tmp_path / "run2"))
    # And within the same run, as after a failure of the disk: another file, not the one that is there.
    record(make_keeper(tmp_path, TroubledDisk(), run_id="run1"), drive(1.0))
    assert names(tmp_path / "run1") == [f"{CORE}.active", "0001.core.mcap"]
    assert (tmp_path / "run1" / f"{CORE}.active").read_bytes() == left


@pytest.mark.parametrize("act", ["write", "sync", "rename"])
@pytest.mark.parametrize("number", [errno.EIO, errno.EROFS])
def test_row_14_a_file_that_fails(tmp_path: Path, act: str, number: int) -> None:
    """An event, and on in a new file; nothing lost, nothing doubled, also where the file cannot be cut any more."""
    disk = TroubledDisk()
    keeper = make_keeper(tmp_path, disk, SegmentLimits(3 * S, 1 << 40))
    entries = drive(8.0)
    for at_ns in step(keeper, entries):
        if at_ns == START_NS + 2 * S:
            acts = (act, "truncate") if number == errno.EROFS else (act,)
            disk.fails = lambda what, path, acts=acts: number if what in acts and "0000" in path.name else 0  # type: ignore[misc]  # mypy: lambda's default
    keeper.finish(100.0)
    assert contents_of(tmp_path) == facts(entries)
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
    found = contents_of(tmp_path)
    assert [each for each in found if each[0] == "/wheels"] == facts(readings)
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
    assert sorted(contents_of(tmp_path)) == sorted(facts(entries))
    log_times = [each[1] for each in contents_of(tmp_path)]
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
        assert found[:100] == facts(early)
        assert not losses.n_lost
        disk.may_sync.set()
        wait_until(lambda: thread.stalled_s < 1.0)


def test_row_40_closing_gives_a_stalled_disk_up_and_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(log_thread_module, "_END_LIMIT_S", 0.1)
    disk = TroubledDisk()
    with log_thread(make_keeper(tmp_path, disk), disk) as thread:
        wait_until(lambda: bool(thread.status.files))
        disk.may_sync.clear()
        thread.write(*wheel_entry(0, START_NS))
        thread.close()
        (note,) = thread.take_notes()
        assert "the files stay unfinished" in note.text
        assert note.lost == {"log left unfinished": 1}
        assert read_all(tmp_path / "run1")[1].unfinished


def wait_until(condition: Callable[[], bool]) -> None:
    end_s = time.monotonic() + LIMIT_S
    while not condition():
        assert time.monotonic() < end_s
        time.sleep(0.01)
