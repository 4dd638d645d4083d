"""Read the runs of a map, and refuse those that cannot go into one map, or not into an archived one."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

import numpy as np

from groundsbot.calib.errors import CalibError
from groundsbot.calib.robot import NoiseParameters
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.foundation import Stages, Workers
from groundsbot.offline.local_map import check_extendable, check_sizes_in_map
from groundsbot.offline.mapping.shared_logs import SharedLog, read_intact, run_from, shared_logs
from groundsbot.offline.maps import MapResult
from groundsbot.offline.measurements import SAME_SIZE_M, Inputs, RobotFile, Run
from groundsbot.offline.self_calibration import Calibrate
from groundsbot.onboard.log import Allowance

_READING: Final = "reading logs"
# Recorded drives take 200 kB a minute or more, and of a hundred only a few ended early. The time for alignment grows
# with the number of pairs of segments.
_FREE_SEGMENTS: Final = 25
_BYTES_A_SEGMENT: Final = 64 << 10


def check_distinct(runs: Sequence[Run]) -> None:
    """Refuse a drive that is given twice, and runs and segments that would have the same name."""
    if not runs:
        raise OfflineError("no log given; name at least one log file or run folder")
    seen: dict[str, Run] = {}
    for run in runs:
        if run.name in seen:
            other = seen[run.name]
            if (run.robot_id, run.run_id) != (other.robot_id, other.run_id):
                raise OfflineError(
                    f"{run.log}: run {run.run_id} of robot {run.robot_id} would be named {run.name}, as run "
                    f"{other.run_id} of robot {other.robot_id} in {other.log} is; give each to a command of its own"
                )
            raise OfflineError(
                f"{run.log}: run {run.run_id} of robot {run.robot_id} is given twice (also as {other.log}); "
                "leave one out"
            )
        seen[run.name] = run
    for run in runs:
        later = re.fullmatch(r"(.+)_stretch\d+", run.name)
        if later and later[1] in seen:
            raise OfflineError(
                f"{run.log}: run {run.run_id} of robot {run.robot_id} is named like a segment of {later[1]}, which "
                f"{seen[later[1]].log} is; give each to a command of its own"
            )


def check_new(
    runs: Sequence[Run], extending: MapResult, noise: NoiseParameters | None, *, corners: bool, calibrate: Calibrate
) -> None:
    """Refuse runs that the map has already, other tag sizes, and options that extending does not support."""
    check_extendable(extending)
    if corners:
        raise OfflineError("--model corners: the map to extend has no corners; map all logs anew, or leave it out")
    if calibrate.names:
        raise OfflineError("--calibrate: the map to extend is calibrated already; map all logs anew, or leave it out")
    if noise is not None:
        raise OfflineError("a map is extended under its own noise; leave --noise out, or map all logs anew with it")
    names = {name for each in extending.archived_segments for name in (each.run, each.name)}
    for run in runs:
        if run.name in names:
            raise OfflineError(
                f"{run.log}: run {run.run_id} of robot {run.robot_id} is in the map already; leave it out"
            )
        check_sizes_in_map(run, extending)


def read_runs(
    logs: Sequence[Path],
    robot_files: Mapping[str, RobotFile] | None = None,
    stages: Stages | None = None,
    workers: Workers | None = None,
) -> list[Run]:
    """Read logs for `build_map`, whose frame is the start of the first.

    Args:
        logs: files or run folders; those at URLs as `find_remote_logs` returns them.
        robot_files: calibrations by robot id that replace those in the logs.
        stages: notified of progress, and records times.
        workers: processes that read the logs; None: this process.

    Raises:
        GroundsbotError: one line that says what is wrong with a log, or which robot has none.
    """
    inputs, allowance = Inputs.of(logs), Allowance()
    if logs:
        _check_segments(len(logs), inputs, logs[-1])

    def read(each: SharedLog, _stages: Stages) -> Run:
        return run_from(each, allowance)

    workers, stages, names = workers or Workers(), stages or Stages(), list(map(str, logs))
    # Copies of remote logs that a killed process leaves here are deleted with the folder.
    with TemporaryDirectory(prefix="groundsbot-", ignore_cleanup_errors=True) as copies:
        shared = shared_logs(logs, robot_files, inputs, Path(copies))
        if workers.is_this_process:
            runs = workers.map(read, shared, names, stages, _READING)
        else:
            found = workers.map(read_intact, shared, names, stages, _READING)
            runs = [run or read(each, stages) for each, run in zip(shared, found, strict=True)]
    n_segments = 0
    for log, run in zip(logs, runs, strict=True):
        n_segments += len(run.wheel_segments)
        _check_segments(n_segments, inputs, log)
    check_robots(runs, robot_files or {})
    return runs


def _check_segments(n_segments: int, inputs: Inputs, log: Path) -> None:
    """Check that the logs up to this one have no more segments than those of their size; a log alone has no limit."""
    most = _FREE_SEGMENTS + inputs.n_bytes // _BYTES_A_SEGMENT
    if inputs.n_logs > 1 and n_segments > most:
        raise OfflineError(
            f"{log}: the logs up to this one have {n_segments} segments of drives, limit {most} for {inputs.n_logs} "
            f"logs of {inputs.n_bytes} bytes in total; give fewer at once (`map --extend` adds others to a map)"
        )


def check_robots(runs: Sequence[Run], robot_files: Mapping[str, RobotFile]) -> None:
    """Refuse a robot.yaml of a robot that is in no log.

    Raises:
        OfflineError: naming it, and the robots of the logs.
    """
    recorded = {run.robot_id for run in runs}
    for robot_id in robot_files:
        if robot_id not in recorded:
            raise OfflineError(
                f"--robot: robot_id {robot_id!r} is in none of the logs (they are of {', '.join(sorted(recorded))}); "
                "give the file of one of these robots"
            )


def check_tag_sizes(runs: Sequence[Run]) -> None:
    """Refuse detections whose tag has no size, and runs that disagree about a tag's size.

    Raises:
        GroundsbotError: naming the run, the tag and the sizes.
    """
    known: dict[tuple[str, int], tuple[float, Run]] = {}
    for run in runs:
        for index in np.unique(run.detections.tag):
            key = run.tags[index]
            try:
                size_m = run.robot.tag_size_m(key.family, key.tag_id)[0]
            except CalibError as error:
                raise OfflineError(f"{run.log}: {error}") from error
            other_m, other = known.setdefault(key, (size_m, run))
            if abs(other_m - size_m) > SAME_SIZE_M:
                raise OfflineError(
                    f"{run.log}: tags: tag {key.tag_id} of {key.family} has size {size_m} m in the robot.yaml of "
                    f"{run.name} but {other_m} m in that of {other.name}; give one robot.yaml with --robot"
                )
