"""The runs that are followed: which there are, what was read of each, and in which state it is."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from groundsbot.calib.errors import GroundsbotError
from groundsbot.offline.measurements import GrowingRun, Inputs, RobotFile, Run
from groundsbot.onboard.errors import LogError
from groundsbot.onboard.log import find_logs

State = Literal["waiting", "under way", "finished", "away"]


@dataclass(frozen=True)
class RunState:
    """One run.

    Attributes:
        name: its name in the map, or its path before it has one.
        state: `waiting` before anything can be read of it, `away` when its log cannot be read any more for now.
        reason: why it is waiting or away, or why it is not in the map; else empty.
    """

    name: str
    state: State
    reason: str = ""


class _FollowedRun:
    """One run, what was read of it, and its state."""

    def __init__(self, log: Path, robot_files: Mapping[str, RobotFile]) -> None:
        self.growing = GrowingRun(log, robot_files)
        self.state: State = "waiting"
        self._name = str(log)
        self._why_away = self._why_unusable = ""

    def read(self) -> None:
        """Read what is new; a log that cannot be read is tried again the next time."""
        try:
            self.growing.read()
        except GroundsbotError as error:
            self.state = "away" if self.growing.n_messages else "waiting"
            self._why_away = str(error)
        else:
            self.state = "finished" if self.growing.is_finished else "under way"
            self._why_away = ""

    def measurements(self, inputs: Inputs) -> Run | None:
        """Return what was measured so far; None where it cannot be mapped, or not yet."""
        try:
            run = self.growing.measurements(inputs)
        except GroundsbotError as error:
            self._why_unusable = str(error)
            return None
        self._name, self._why_unusable = run.name, ""
        return run

    def describe(self) -> RunState:
        """Return its state."""
        return RunState(self._name, self.state, self._why_away or self._why_unusable)


class Drives:
    """All runs at some paths, which need not exist yet."""

    def __init__(self, paths: Sequence[Path], robot_files: Mapping[str, RobotFile]) -> None:
        """Begin without reading.

        Args:
            paths: files, run folders, or folders of runs, in which new ones may appear.
            robot_files: calibrations by robot id that replace those in the logs.
        """
        self._paths = paths
        self._robot_files = robot_files
        self._missing: list[RunState] = []
        self._drives: dict[Path, _FollowedRun] = {}

    @property
    def n_messages(self) -> int:
        """Number of messages read so far."""
        return sum(each.growing.n_messages for each in self._drives.values())

    @property
    def is_finished(self) -> bool:
        """Whether all runs are there and the recorders have finished them."""
        drives = self._drives.values()
        return bool(drives) and not self._missing and all(each.state == "finished" for each in drives)

    def read(self) -> None:
        """Read what is new of each run, and find new ones."""
        self._missing = []
        for path in self._paths:
            self._find(path)
        for each in self._drives.values():
            each.read()

    def states(self) -> tuple[RunState, ...]:
        """Return the states of all runs."""
        return (*(each.describe() for each in self._drives.values()), *self._missing)

    def measurements(self) -> list[Run]:
        """Return what was measured so far in the runs that can be mapped."""
        read = [each for each in self._drives.values() if each.growing.n_messages]
        inputs = Inputs(max(1, len(read)), sum(each.growing.n_bytes for each in read))
        return [run for each in read if (run := each.measurements(inputs)) is not None]

    def _find(self, path: Path) -> None:
        """Find the runs at a path; those that were found before stay, also where the path is gone for now."""
        try:
            logs = find_logs([path])
        except (LogError, OSError) as error:
            logs = [path] if ".mcap" in path.suffixes else []
            if not logs and not any(path in (log, *log.parents) for log in self._drives):
                self._missing.append(RunState(str(path), "waiting", str(error)))
        for log in logs:
            drive = _FollowedRun(log, self._robot_files)
            self._drives.setdefault(drive.growing.log, drive)
