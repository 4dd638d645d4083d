"""Disks with little room under a recording. Rows 11 to 13 of the table of faults."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from groundsbot.onboard.log.reading.reader import read_log
from groundsbot.onboard.recorder.disk.room import BALLAST_BYTES, SpacePolicy
from tests.support.data.logs import MS, START_NS, drive, facts, picture_entry, read_all, wheel_entry
from tests.support.devices.fake_disks import TroubledDisk
from tests.support.devices.kept_logs import CORE, MB, S, contents_of, make_keeper, names, record, step, texts
from tests.support.paths import ROOT


def test_row_11_disk_full_in_mid_chunk(tmp_path: Path) -> None:
    disk = TroubledDisk(BALLAST_BYTES + 5 * MB)
    keeper = make_keeper(tmp_path, disk, pictures=True)
    entries = drive(6.0, picture_hz=10, picture_bytes=300_000)
    red = [keeper.status.problem for _ in step(keeper, entries)][-1]
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
    for _ in step(keeper, entries):
        pass
    assert names(tmp_path / "run1") == ["0000.camera.mcap.active", f"{CORE}.active"]
    found, losses = read_all(tmp_path / "run1")
    assert set(found) < set(facts(entries))
    assert len(losses.unfinished) == 2
    assert not losses.n_lost


def test_row_11_on_a_real_disk_that_is_full(tmp_path: Path) -> None:
    """A tmpfs of 30 MiB in a mount namespace of its own, where that is permitted."""
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
