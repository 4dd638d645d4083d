"""A log kept on a disk with troubles, stepped by hand."""

from collections.abc import Iterator
from pathlib import Path

from groundsbot.onboard.log.writing.segments import SegmentLimits
from groundsbot.onboard.log.writing.storage import Storage
from groundsbot.onboard.recorder.disk.log_keeper import LogKeeper
from groundsbot.onboard.recorder.disk.room import DiskRoom, SpacePolicy
from tests.support.data.logs import MS, START_NS, Entry, Seen, head, read_all

S = 1000 * MS
MB = 1 << 20
UNLIMITED = SegmentLimits(1 << 62, 1 << 62)
CORE = "0000.core.mcap"
STEP_NS = 500 * MS
LIMIT_S = 120.0  # only what hangs comes near


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


def step(keeper: LogKeeper, entries: list[Entry]) -> Iterator[int]:
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
    for _ in step(keeper, entries):
        pass
    keeper.finish(1e6)


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def texts(keeper: LogKeeper) -> list[str]:
    return [note.text for note in keeper.take_notes()]


def contents_of(folder: Path) -> list[Seen]:
    found, losses = read_all(folder / "run1")
    assert not losses.n_lost
    return found
