"""Output of every import: one run of one robot, complete or not at all."""

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

from google.protobuf.message import Message

from groundsbot.calib.foundation import folder_written_whole, plural
from groundsbot.offline.errors import OfflineError
from groundsbot.onboard.log import LogHead, LogWriter

Entry = tuple[int, str, Message]  # stamp in ns, topic, message


@dataclass(frozen=True)
class ImportReport:
    """Summary of an import, with remarks for the user."""

    run_folder: Path
    run_id: str
    robot_id: str
    n_odometry: int  # readings in the file
    duration_s: float
    distance_m: float
    n_observations: int
    n_tags: int
    remarks: tuple[str, ...]

    def lines(self) -> list[str]:
        """Return what was imported and what was assumed, as lines of text."""
        drive = (
            f"{plural(self.n_odometry, 'odometry reading')} over {self.duration_s:.1f} s and {self.distance_m:.2f} m"
        )
        seen = f"{plural(self.n_observations, 'observation')} of {plural(self.n_tags, 'tag')}"
        return [
            f"robot {self.robot_id}, run {self.run_id}: {drive}; {seen}",
            *(f"  {remark}" for remark in self.remarks),
            f"wrote {self.run_folder}",
        ]


def check_output(output: Path, run_folder: Path) -> None:
    """Check that `output` holds nothing but other runs and hidden files.

    Raises:
        OfflineError: `output` holds other files, or this run already.
    """
    if output.exists() and not output.is_dir():
        raise OfflineError(f"{output}: is not a folder; give a new or empty one")
    if run_folder.exists():
        if not any(run_folder.rglob("*.mcap")):  # perhaps what is imported, so that none should remove it
            raise OfflineError(f"{run_folder}: exists, and is no run's log; give another output, as -o logs")
        raise OfflineError(f"{run_folder}: exists already; give another output, another --run-id, or remove it")
    if not output.exists():
        return
    for entry in sorted(output.iterdir()):
        if entry.name.startswith("."):  # of another running import, or of a desktop
            continue
        if not (entry.is_dir() and any(entry.rglob("*.mcap"))):
            raise OfflineError(f"{output}: is not empty: {entry.name} is not a run's log; give a new or empty folder")


def write_run(run_folder: Path, head: LogHead, entries: Iterable[Entry]) -> None:
    """Write `run_folder/0000.core.mcap`.

    Args:
        run_folder: created, complete or not at all.
        head: `/run` and other messages that begin each file.
        entries: entries in order of time, at least one.

    Raises:
        GroundsbotError: it cannot be written.
    """
    with folder_written_whole(run_folder) as partial:
        try:
            rest = iter(entries)
            first = next(rest)
            with LogWriter(partial, head, first[0]) as writer:
                for stamp_ns, topic, message in chain([first], rest):
                    writer.write(topic, message, stamp_ns, stamp_ns)
        except OSError as error:
            raise OfflineError(f"{run_folder}: cannot be written: {error.strerror}; choose another output") from error
