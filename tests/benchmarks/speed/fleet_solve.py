"""The joint solve of a large fleet in parts on a cluster of worker processes, beside that of a single process.

    python -m tests.benchmarks.speed.fleet_solve [--drives 10,30,100] [--keyframes 10000] [--tags 3000] [--workers 4]
        [--single 30] [--kill]

Fleets are simulated once, without logs, and kept in build/fleet_solve; each worker reads its drives from files. Prints
the seconds of each stage, the largest memory of each process, the bytes that are moved for each drive and
linearisation, and, of fleets of up to --single drives, the difference to the solve of a single process. With --kill a
worker is killed in the middle of each stage, and the result must be the same. Writes
build/benchmarks/fleet_solve.jsonl. Exit 1 where tags or starts differ by more than 1e-7 m, sigmas by more than 1e-6 of
them, a process takes more than 3 GiB, or more than 5 MB are moved between workers.
"""

import argparse
import pickle
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any, Final

import numpy as np
from distributed import Client, Future

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.foundation.cluster import ClusterWorkers, cluster_workers
from groundsbot.offline.foundation.stages import Stages, peak_mib
from groundsbot.offline.foundation.workers import Handle, TaskWorkers, worker_processes
from groundsbot.offline.sam.factors.odometry_and_observations import Columns, State
from groundsbot.offline.sam.partition.solver import PartitionedSolution, solve_parts
from groundsbot.offline.sam.partition.system import PartitionedSystem
from groundsbot.offline.sam.solver import PLAIN_SQUARES, solve
from tests.benchmarks.command_line import exit_code, say, write_report
from tests.benchmarks.speed.fleet_solve_world import (
    FleetFiles,
    build_part,
    fleet_files,
    load_part,
    load_problem,
    load_whole,
)
from tests.support.devices.dying_workers import DyingWorkers
from tests.support.devices.local_cluster import kill_worker_with_results, local_cluster, wait_for_workers
from tests.support.paths import ROOT

REPORT: Final = ROOT / "build" / "benchmarks" / "fleet_solve.jsonl"
STAGES: Final = ("part", "linearise", "eliminate", "add", "substitute")
MOST_M: Final = 1e-7
MOST_OF_SIGMA: Final = 1e-6
MOST_MIB: Final = 3072.0
MOST_MB: Final = 5.0


class CountingWorkers(TaskWorkers):
    """Those of a cluster, with the bytes of what is sent to them and comes back."""

    def __init__(self, workers: ClusterWorkers) -> None:
        self._workers = workers
        self.sent, self.received = 0, 0

    def call(self, name: str, function: Callable[..., object], *arguments: object) -> Handle:
        if name != "add":  # of handles alone
            self.sent += sum(len(pickle.dumps(each)) for each in arguments if not isinstance(each, Future))
        return self._workers.call(name, function, *arguments)

    def results(
        self, submit: Callable[[int], Handle], names: Sequence[str], tick: Callable[[], None]
    ) -> tuple[list[Handle], list[Any]]:
        futures, found = self._workers.results(submit, names, tick)
        self.received += sum(len(pickle.dumps(each)) for each in found)
        return futures, found


def main() -> int:
    """Prints figures for each fleet and writes the report; 1 if a bound is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--drives", default="10,30,100")
    parser.add_argument("--keyframes", type=int, default=10_000, help="of each drive")
    parser.add_argument("--tags", type=int, default=3000)
    parser.add_argument("--workers", type=int, default=4)
    parser.add_argument("--single", type=int, default=30, help="drives up to which a single process solves them too")
    parser.add_argument("--kill", action="store_true", help="a worker in the middle of each stage")
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    lines, missed = [], list[str]()
    for n_drives in map(int, given.drives.split(",")):
        files = fleet_files(n_drives, given.keyframes, given.tags, given.seed)
        line = measure(files, given.workers, kill=given.kill, single=n_drives <= given.single)
        lines.append(line | {"drives": n_drives, "keyframes": given.keyframes})
        missed += [f"{n_drives} drives: {sentence}" for sentence in missed_bounds(line)]
    write_report(REPORT, lines)
    return exit_code(missed)


def measure(files: FleetFiles, n_workers: int, *, kill: bool, single: bool) -> dict[str, Any]:
    """Figures of one fleet."""
    _, start = load_whole(files)
    say(f"{files.n_drives} drives, {len(start.poses)} keyframes, {len(start.tags)} tags, {n_workers} workers")
    with local_cluster(n_workers) as cluster, cluster_workers(cluster.scheduler_address) as workers:
        line, solution = _solve_in_parts(files, workers, cluster)
        if kill:
            same = {stage: _is_same_after_kill(files, workers, cluster, stage, solution) for stage in STAGES}
            line["same_after_kill"] = same
            say(f"  the same bytes after a worker was killed in this stage: {same}")
        whole = solution.linear.whole
        state, columns = solution.state, _columns(whole.columns, whole.segment_start[:-1])
        sigmas = np.sqrt(solution.covariance(columns).diagonal())
    return line | (_compare(files, state, sigmas) if single else {})


def _solve_in_parts(
    files: FleetFiles, workers: ClusterWorkers, cluster: Any
) -> tuple[dict[str, Any], PartitionedSolution]:
    stages, counting = Stages(), CountingWorkers(workers)
    began_s = time.perf_counter()
    linear, start = _linear(files, counting, stages)
    with stages.stage("reading drives"):
        _wait(workers, linear.parts)
    counting.sent = 0
    solution = solve_parts(linear, start, PLAIN_SQUARES)
    _ = solution.covariance_of_top
    seconds = time.perf_counter() - began_s
    n = files.n_drives * solution.n_linearised
    moved = sum(cluster_bytes(cluster).values())
    sigma_poses_m = np.sqrt(solution.pose_covariances(np.arange(len(start.poses)))[:, :2, :2].trace(axis1=1, axis2=2))
    workers_mib = [round(each) for each in run_on_workers(cluster, peak_mib)]
    line = {
        "reason": solution.reason,
        "cost": solution.cost,
        "steps": len(solution.costs) - 1,
        "linearised": solution.n_linearised,
        "seconds": round(seconds, 1),
        "stages": {cost.name: round(cost.seconds, 1) for cost in stages.costs},
        "worker_seconds": task_seconds(cluster),
        "mb_between_workers": moved / n / 1e6,
        "mb_to_workers": counting.sent / n / 1e6,
        "mb_from_workers": counting.received / n / 1e6,
        "peak_mib_of_workers": workers_mib,
        "peak_mib_here": round(peak_mib() or 0.0),
        "largest_sigma_of_a_pose_m": float(sigma_poses_m.max()),
    }
    for name, value in line.items():
        say(f"  {name}: {value}")
    return line, solution


def _linear(files: FleetFiles, workers: TaskWorkers, stages: Stages) -> tuple[PartitionedSystem, State]:
    whole, start = load_whole(files)
    n_poses, n_tags = len(start.poses), len(start.tags)
    numbers = [load_part(files, drive, n_poses, n_tags).numbers for drive in range(files.n_drives)]
    parts = [workers.call("part", build_part, files, drive, n_poses, n_tags) for drive in range(files.n_drives)]
    return PartitionedSystem(whole, numbers, parts, workers, stages), start


def _wait(workers: ClusterWorkers, parts: Sequence[Handle]) -> None:
    workers.results(lambda i: workers.call("wait", _nothing_of, parts[i]), ["part"] * len(parts), lambda: None)


def _nothing_of(_part: object) -> None:
    """Is done when its argument is there."""


def _is_same_after_kill(
    files: FleetFiles, workers: ClusterWorkers, cluster: Any, stage: str, wanted: PartitionedSolution
) -> bool:
    n = 1 if stage == "add" else files.n_drives // 2
    dying = DyingWorkers(workers, stage, n, lambda: kill_worker_with_results(cluster))
    linear, start = _linear(files, dying, Stages())
    found = solve_parts(linear, start, PLAIN_SQUARES)
    assert dying.has_killed
    wait_for_workers(cluster, len(cluster.workers))
    return (
        found.costs == wanted.costs
        and found.state.poses.tobytes() == wanted.state.poses.tobytes()
        and found.state.tags.tobytes() == wanted.state.tags.tobytes()
        and found.covariance_of_top.tobytes() == wanted.covariance_of_top.tobytes()
    )


def _compare(files: FleetFiles, state: State, sigmas: FloatArray) -> dict[str, Any]:
    """Differences to a single process, which is one of its own."""
    with worker_processes(2) as alone:
        single = alone.begin(solve_alone, files).result()
    starts = np.flatnonzero(np.arange(len(state.poses)) % (len(state.poses) // files.n_drives) == 0)
    free = sigmas > 0.0
    line = {
        "single_seconds": round(single["seconds"], 1),
        "single_peak_mib": round(single["peak_mib"]),
        "single_linearised": single["linearised"],
        "off_tags_m": float(np.abs(state.tags - single["tags"]).max()),
        "off_starts": float(np.abs(se2.between(single["starts"], state.poses[starts])).max()),
        "off_sigmas": float(np.abs(sigmas[free] / single["sigmas"][free] - 1.0).max()),
    }
    for name, value in line.items():
        say(f"  {name}: {value}")
    return line


def solve_alone(files: FleetFiles) -> dict[str, Any]:
    """The single-process solve, with its covariances of starts and tags."""
    problem, start = load_problem(files)
    began_s = time.perf_counter()
    solution = solve(problem, start, losses=PLAIN_SQUARES, keep_factorisation=True)
    starts = np.arange(files.n_drives) * (len(start.poses) // files.n_drives)
    covariance = solution.covariance(_columns(problem.columns, starts))
    return {
        "seconds": time.perf_counter() - began_s,
        "peak_mib": peak_mib(),
        "linearised": solution.n_linearised,
        "tags": solution.state.tags,
        "starts": solution.state.poses[starts],
        "sigmas": np.sqrt(covariance.diagonal()),
    }


def _columns(columns: Columns, starts: Any) -> Any:
    return np.concatenate([columns.poses[starts].reshape(-1), columns.tags.reshape(-1)])


def run_on_workers(cluster: Any, function: Callable[[], Any]) -> list[Any]:
    """Results of a function on each worker."""
    with Client(cluster.scheduler_address, set_as_default=False) as client:
        return list(client.run(function).values())


def _received_bytes(dask_worker: Any) -> int:
    return sum(each["total"] for each in dask_worker.transfer_incoming_log)


def cluster_bytes(cluster: Any) -> dict[str, int]:
    """Bytes that each worker got from others."""
    with Client(cluster.scheduler_address, set_as_default=False) as client:
        found: dict[str, int] = client.run(_received_bytes)
        return found


def task_seconds(cluster: Any) -> dict[str, dict[str, float]]:
    """Seconds of computation and transfer of all workers, by the name of tasks."""
    return {
        name: {action: round(seconds, 2) for action, seconds in prefix.all_durations.items()}
        for name, prefix in cluster.scheduler.task_prefixes.items()
    }


def missed_bounds(line: dict[str, Any]) -> list[str]:
    """A sentence for each bound that is missed."""
    found = []
    if max(line.get("off_tags_m", 0.0), line.get("off_starts", 0.0)) > MOST_M:
        found.append(f"tags and starts within {MOST_M:g} m of those of a single process")
    if line.get("off_sigmas", 0.0) > MOST_OF_SIGMA:
        found.append(f"sigmas within {MOST_OF_SIGMA:g} of those of a single process")
    if max(*line["peak_mib_of_workers"], line["peak_mib_here"]) > MOST_MIB:
        found.append(f"no process above {MOST_MIB:g} MiB")
    if line["mb_between_workers"] > MOST_MB:
        found.append(f"at most {MOST_MB:g} MB between workers for a drive and linearisation")
    if not all(line.get("same_after_kill", {}).values()):
        found.append("the same bytes after a worker was killed")
    return found


if __name__ == "__main__":
    sys.exit(main())
