"""Disks with little room under a recording. Rows 11 to 13 of the table of faults."""

import os
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

from groundsbot.onboard.log.reading.reader import read_log
from groundsbot.onboard.recorder.disk.room import BALLAST_BYTES, LEAST_BYTES, SpacePolicy
from tests.support.data.logs import MS, START_NS, Entry, Seen, drive, facts, picture_entry, read_all, wheel_entry
from tests.support.devices.fake_disks import TroubledDisk
from tests.support.devices.kept_logs import CORE, MB, S, contents_of, make_keeper, names, record, step, texts
from tests.support.paths import ROOT

BACKLOG_BYTES = 64 << 10  # what is written at once on a full disk


def test_row_11_disk_full_in_mid_chunk(tmp_path: Path) -> None:
    """Pictures go first; readings go on in the ballast's room; pictures come back with room for them."""
    disk = TroubledDisk(2 * BALLAST_BYTES)
    keeper = make_keeper(tmp_path, disk, pictures=True)
    entries = drive(9.0, picture_hz=10, picture_bytes=300_000)
    red = [keeper.status.problem for _ in step(keeper, entries)]
    assert red[:10] == [None] * 10
    assert red[-1] == "little space left: pictures are not kept"
    finished = ["0000.camera.mcap", CORE]  # with the ballast's room
    assert names(tmp_path / "run1") == sorted([*finished, "0001.camera.mcap.active", "0001.core.mcap.active"])
    assert all(list(read_log(tmp_path / "run1" / each)) for each in finished)  # strict: no torn chunk
    notes = texts(keeper)
    assert [text for text in notes if "No space left" in text]
    assert [text for text in notes if "recording again, in 0001.core.mcap" in text]
    lost = keeper.status.lost
    assert set(lost) == {"/camera/image"}
    assert [each for each in contents_of(tmp_path) if each[0] == "/wheels"] == wheels_in(entries)
    disk.capacity_bytes = 1 << 40
    more = [wheel_entry(10_000, START_NS + 20 * S), picture_entry(START_NS + 31 * S, b"\xff" * 1000)]
    record(keeper, more)
    assert keeper.status.problem is None
    assert keeper.status.lost == lost
    found = contents_of(tmp_path)
    assert [each for each in found if each[0] == "/wheels"] == wheels_in([*entries, *more])
    assert found[-1] == facts(more)[-1]
    assert len(found) == len(entries) + len(more) - lost["/camera/image"]
    assert keeper.status.written == Counter(each[0] for each in found)


def wheels_in(entries: list[Entry]) -> list[Seen]:
    return [each for each in facts(entries) if each[0] == "/wheels"]


@pytest.mark.parametrize("waiting", [False, True])
@pytest.mark.parametrize("free_bytes", [18 * MB, 2 * MB])
def test_row_12_a_nearly_full_disk_takes_what_fits(tmp_path: Path, free_bytes: int, waiting: bool) -> None:
    """Also where all waits in memory until the end; each file is finished; the rest is counted."""
    disk = TroubledDisk(capacity_bytes=0 if waiting else free_bytes)
    keeper = make_keeper(tmp_path, disk)
    entries = drive(80.0, wheel_hz=1000)
    for _ in step(keeper, entries):
        assert keeper.status.problem is not None
    disk.capacity_bytes = free_bytes
    keeper.finish(1e6)
    assert all(path.suffix == ".mcap" for path in (tmp_path / "run1").iterdir())
    found = contents_of(tmp_path)
    lost = sum(keeper.status.lost.values())
    assert len(found) == len(entries) - lost == sum(keeper.status.written.values())
    if free_bytes > 4 * MB:
        assert lost == 0
    else:
        assert 0 < lost < len(entries)
        assert disk.free_bytes(tmp_path) < LEAST_BYTES + BACKLOG_BYTES
    assert found == facts(entries)[: len(found)]  # what came first


class GreedyDisk(TroubledDisk):
    """Another program takes all space that becomes free."""

    def remove(self, path: Path) -> None:
        super().remove(path)
        self.capacity_bytes = self.used()


def test_row_11_disk_full_until_the_end(tmp_path: Path) -> None:
    """The file cannot be finished, and still holds whole chunks only."""
    disk = GreedyDisk(2 * BALLAST_BYTES)
    entries = drive(6.0, picture_hz=10, picture_bytes=400_000)
    keeper = make_keeper(tmp_path, disk, pictures=True)
    for _ in step(keeper, entries):
        pass
    assert names(tmp_path / "run1") == ["0000.camera.mcap.active", f"{CORE}.active"]
    found, losses = read_all(tmp_path / "run1")
    assert set(found) < set(facts(entries))
    assert len(losses.unfinished) == 2
    assert not losses.n_lost


def test_row_11_on_a_real_disk_that_is_full(tmp_path: Path) -> None:
    """A tmpfs of 40 MiB in a mount namespace of its own, where that is permitted."""
    script = f"""
import pathlib, sys
sys.path.insert(0, {str(ROOT)!r})
from groundsbot.onboard.log.reading.reader import read_log
from groundsbot.onboard.log.writing.storage import Disk
from tests.support.data.logs import drive
from tests.support.devices.kept_logs import make_keeper, step
folder = pathlib.Path({str(tmp_path)!r})
keeper = make_keeper(folder, Disk(), pictures=True)
problems = [keeper.status.problem for _ in step(keeper, drive(5.0, picture_hz=20, picture_bytes=400_000))]
assert problems[-1] == "little space left: pictures are not kept", problems
keeper.finish(100.0)
assert any("No space left" in note.text for note in keeper.take_notes())
assert set(keeper.status.lost) == {{"/camera/image"}}, keeper.status.lost
assert sorted(path.name for path in (folder / "run1").iterdir()) == [
    "0000.camera.mcap", "0000.core.mcap", "0001.camera.mcap", "0001.core.mcap"]
print(len(list(read_log(folder / "run1"))), "read")
"""
    mount = f'mount -t tmpfs -o size=40m none {tmp_path} || exit 77; exec "$0" -c "$1"'
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
    for at_ns in step(keeper, entries):
        if at_ns < START_NS + 4 * S:
            assert keeper.status.problem is not None
        elif at_ns == START_NS + 4 * S:
            disk.capacity_bytes = 1 << 40
    assert keeper.status.problem is None
    keeper.finish(100.0)
    assert names(tmp_path / "run1") == [CORE]
    assert contents_of(tmp_path) == facts(entries)
    assert [text for text in texts(keeper) if "recording again" in text]


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
    readings = [each for each in contents_of(tmp_path) if each[0] == "/wheels"]
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
    kept = [each for each in contents_of(tmp_path) if each[0] == "/camera/image"]
    assert len(kept) + keeper.status.lost.get("/camera/image", 0) == 24
    assert (len(kept) > 20) == allowed
    assert any("pictures" in text for text in texts(keeper))
    wheels = [each for each in facts(entries) if each[0] == "/wheels"]
    assert [each for each in contents_of(tmp_path) if each[0] == "/wheels"] == wheels


def files_of_old() -> tuple[str, ...]:
    return (CORE, "0000.camera.mcap", "0001.camera.mcap.active")
