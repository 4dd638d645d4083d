"""Logs as paths, which worker processes open themselves, wherever they run."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from groundsbot.calib.errors import GroundsbotError
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.foundation import Stages, worker_name
from groundsbot.offline.measurements import Inputs, RobotFile, Run, load_run
from groundsbot.onboard.log import Allowance, size_bytes


class SharedLog(NamedTuple):
    """A log that a worker process reads.

    Attributes:
        log: as given, which names it in errors and in the map.
        path: absolute, since workers have other working folders.
        n_bytes: its size; a log that grows is refused by a cluster, which may have to read it again.
        robot_files: calibrations by robot id that replace the log's.
        inputs: the logs that are read together.
    """

    log: Path
    path: Path
    n_bytes: int
    robot_files: Mapping[str, RobotFile] | None
    inputs: Inputs


def shared_logs(logs: Sequence[Path], robot_files: Mapping[str, RobotFile] | None, inputs: Inputs) -> list[SharedLog]:
    """Return logs for `read_intact`."""
    return [SharedLog(log, log.absolute(), size_bytes(log), robot_files, inputs) for log in logs]


def read_intact(shared: SharedLog, _stages: Stages) -> Run | None:
    """Return the run of a log that takes nothing of what all logs share; None of any other, which is read in turn.

    Raises:
        OfflineError: a worker of a cluster does not see the log, or another one under its name.
    """
    worker = worker_name()
    if worker is not None:  # processes of this computer see what it sees
        _check_visible(shared, worker)
    nothing = Allowance(0, 0, 0, 0)
    try:
        run = load_run(shared.path, shared.robot_files, shared.inputs, nothing)
    except GroundsbotError:
        return None
    if run.lost or nothing != Allowance(0, 0, 0, 0):
        return None
    return replace(run, log=shared.log)


def _check_visible(shared: SharedLog, worker: str) -> None:
    n_bytes = size_bytes(shared.path) if shared.path.exists() else 0
    if n_bytes != shared.n_bytes:
        seen = f"has {n_bytes} bytes there, but {shared.n_bytes} here" if n_bytes else "is not seen there"
        raise OfflineError(
            f"{shared.log}: {seen} ({worker}); put logs where all workers see them as {shared.path}, as in a "
            "folder of the network, or leave --scheduler out"
        )
