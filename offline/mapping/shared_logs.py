"""Logs as paths, which worker processes open themselves, wherever they run."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from groundsbot.calib.errors import GroundsbotError
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.foundation import RemoteLog, Stages, local_copy, log_size, worker_name
from groundsbot.offline.measurements import Inputs, RobotFile, Run, load_run
from groundsbot.onboard.log import Allowance, size_bytes


class SharedLog(NamedTuple):
    """A log that a worker process reads.

    Attributes:
        log: as given, which names it in errors and in the map.
        path: absolute, since workers have other working folders; or a URL.
        n_bytes: its size; a log that grows is refused by a cluster, which may have to read it again.
        robot_files: calibrations by robot id that replace the log's.
        inputs: the logs that are read together.
        copies: folder for copies of remote logs, on the computer of the command.
    """

    log: Path
    path: Path
    n_bytes: int
    robot_files: Mapping[str, RobotFile] | None
    inputs: Inputs
    copies: Path


def shared_logs(
    logs: Sequence[Path], robot_files: Mapping[str, RobotFile] | None, inputs: Inputs, copies: Path
) -> list[SharedLog]:
    """Return logs for `read_intact` and `run_from`."""
    paths = [log if isinstance(log, RemoteLog) else log.absolute() for log in logs]
    return [
        SharedLog(log, path, log_size(log), robot_files, inputs, copies) for log, path in zip(logs, paths, strict=True)
    ]


def read_intact(shared: SharedLog, _stages: Stages) -> Run | None:
    """Return the run of a log that takes nothing of what all logs share; None of any other, which is read in turn.

    Raises:
        OfflineError: a worker of a cluster does not see the log, or another one under its name; or a remote one cannot
            be read.
    """
    worker = worker_name()
    if worker is not None and not isinstance(shared.path, RemoteLog):  # processes of this computer see what it sees
        _check_visible(shared, worker)
    nothing = Allowance(0, 0, 0, 0)
    with local_copy(shared.path, shared.n_bytes, shared.copies) as path:
        try:
            run = load_run(path, shared.robot_files, shared.inputs, nothing)
        except GroundsbotError:
            return None
    if run.lost or nothing != Allowance(0, 0, 0, 0):
        return None
    return replace(run, log=shared.log)


def run_from(shared: SharedLog, allowance: Allowance) -> Run:
    """Return the run of a log, in the process of the command.

    Raises:
        GroundsbotError: one line that says what is wrong with it.
    """
    if not isinstance(shared.log, RemoteLog):
        return load_run(shared.log, shared.robot_files, shared.inputs, allowance)
    with local_copy(shared.log, shared.n_bytes, shared.copies) as path:
        try:
            run = load_run(path, shared.robot_files, shared.inputs, allowance)
        except GroundsbotError as error:
            raise OfflineError(str(error).replace(str(path), str(shared.log))) from error
    return replace(run, log=shared.log)


def _check_visible(shared: SharedLog, worker: str) -> None:
    n_bytes = size_bytes(shared.path) if shared.path.exists() else 0
    if n_bytes != shared.n_bytes:
        seen = f"has {n_bytes} bytes there, but {shared.n_bytes} here" if n_bytes else "is not seen there"
        raise OfflineError(
            f"{shared.log}: {seen} ({worker}); put logs where all workers see them as {shared.path}, as in a "
            "folder of the network, or leave --scheduler out"
        )
