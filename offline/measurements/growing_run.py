"""A run that is being recorded: its measurements up to now."""

from collections.abc import Mapping
from pathlib import Path
from typing import Protocol

from groundsbot.offline.errors import OfflineError
from groundsbot.offline.measurements.run import Inputs, RobotFile, Run, run_of
from groundsbot.offline.measurements.run_messages import MEASURED_TOPICS, RunMessages
from groundsbot.onboard.log import LogFollower, LogLosses, LogMessage, RunInfo


class MessageSource(Protocol):
    """Messages of a run that is being recorded; see LogFollower.

    Attributes:
        log: names the source in errors.
    """

    log: Path

    @property
    def n_bytes(self) -> int:
        """Size of what was read."""

    @property
    def is_finished(self) -> bool:
        """Whether nothing more will come."""

    @property
    def losses(self) -> LogLosses:
        """What could not be read up to now."""

    def read(self) -> list[LogMessage] | None:
        """Return the new messages in order of log time; None if they begin anew, with another run."""


class GrowingRun:
    """The messages of one run that were read so far. Its log is only read."""

    def __init__(self, source: Path | MessageSource, robot_files: Mapping[str, RobotFile] | None = None) -> None:
        """Begin without reading.

        Args:
            source: a log file or a run folder, which need not exist yet, or another source of the run's messages.
            robot_files: calibrations by robot id that replace those in the log.
        """
        self._robot_files = robot_files
        self._source = LogFollower(source, MEASURED_TOPICS) if isinstance(source, Path) else source
        self._collected = RunMessages()
        self.n_messages = 0

    @property
    def log(self) -> Path:
        """The log, by its final name."""
        return self._source.log

    @property
    def n_bytes(self) -> int:
        """Size of the log when it was last read."""
        return self._source.n_bytes

    @property
    def is_finished(self) -> bool:
        """Whether the recorder has finished all files of the log."""
        return self._source.is_finished

    def read(self) -> int:
        """Read what was added to the log, and return the number of new messages.

        Raises:
            GroundsbotError: the log is not there or cannot be read. What was read before stays.
        """
        new = self._source.read()
        if new is None:  # another run
            self._collected, self.n_messages = RunMessages(), 0
            new = self._source.read() or []
        for entry in new:
            info = self._collected.info
            if isinstance(entry.message, RunInfo) and info is not None and entry.message.run_id != info.run_id:
                raise OfflineError(
                    f"{self.log}: holds files of run {info.run_id} and of run {entry.message.run_id}; keep each run "
                    "in a folder of its own"
                )
            self._collected.add(entry)
        self.n_messages += len(new)
        return len(new)

    def forget(self, until_ns: int, run: Run) -> None:
        """Remove measurements that are no longer needed for the motion after a time.

        Args:
            until_ns: the time, by the wheels' stamps.
            run: run from `measurements`.
        """
        by_camera = {name: run.robot.with_camera(name).time_offset_s for name in run.robot.camera_names}
        self._collected.forget(until_ns, {name: until_ns + round(late_s * 1e9) for name, late_s in by_camera.items()})

    def measurements(self, inputs: Inputs) -> Run:
        """Return the measurements read so far.

        Args:
            inputs: the logs that are mapped together, including this one.

        Raises:
            GroundsbotError: they cannot be mapped, or not yet.
        """
        self._collected.observations.check(self.log, self.n_bytes, inputs.n_logs)
        return run_of(self._collected, self._source.losses, self.log, self.n_bytes, self._robot_files, inputs)
