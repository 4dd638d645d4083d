"""Solvers against each other on the same fleets: seconds, iterations, cost and memory.

    python -m tests.benchmarks.speed.solver_bench [--cases 2x1000 10x1000] [--repeats 3] [--seeds 5]

Each measurement is a process of its own, bound to one core before it imports anything, solvers taking turns; the least
of the repeats counts, and a solve of less than a second runs three times in each, so that none pays for memory that
is new to the process. Seconds are the processor's: on a core of its own the same, on a shared one the fairer. Writes
build/benchmarks/solver.jsonl. GTSAM has to be installed to be compared with; it keeps its default stop rule. `ours` is
the joint solve of `map`, from where `map` starts it: each drive solved alone, which takes the `start` seconds of the
table. `gtsam` starts from dead reckoning; `gtsam_our_start` and `splu` get the same start as `ours` for nothing.

`ordering_seconds` stand apart: for `ours` all that depends on the graph but not on values, once a graph (the order of
elimination, factors by pose); for GTSAM its COLAMD ordering, which its `seconds` include too. The summary gives the
worst and the median ratio over all seeds, with and without them.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.offline.sam.factors.odometry_and_observations import State
from groundsbot.offline.sam.solver import PLAIN_SQUARES, Problem, Solution, solve
from tests.benchmarks.command_line import write_report
from tests.benchmarks.speed.plain_solver import plain_normal_equations, plain_solve, plain_step
from tests.benchmarks.speed.solver_world import Fleet, joint_start, make_fleet

TAGS: Final = {"2x1000": 50, "10x1000": 100, "2x10000": 200, "10x10000": 500, "50x2000": 500}
_Result = TypeVar("_Result")
SEEDS: Final = {"2x1000": 5, "10x1000": 5, "2x10000": 2, "10x10000": 2, "50x2000": 2}
SOLVERS: Final = ("ours", "gtsam", "gtsam_our_start", "splu")
OUTPUT: Final = Path("build/benchmarks/solver.jsonl")
# Where the next step would lower the cost by a smaller share the solve has arrived.
_RELATIVE_TOLERANCE: Final = 1e-7
_TIME_LIMIT_S: Final = 900
_TIMES: Final = ("seconds", "seconds_per_iteration", "ordering_seconds", "start_seconds")


def ours(fleet: Fleet) -> tuple[float, float, int, State]:
    """Seconds in total and an iteration, iterations, and the end."""

    start = joint_start(fleet)

    def run() -> Solution:
        return solve(fleet.problem, start, losses=PLAIN_SQUARES, relative_tolerance=_RELATIVE_TOLERANCE)

    seconds, solution = _time_run(run)
    arrowhead = fleet.problem.arrowhead
    blocks, rows = arrowhead.empty_system(), arrowhead.empty_rows()

    def iterate() -> None:
        system, _ = arrowhead.linearise(start, out=blocks)
        step = -arrowhead.factorise(system, out=rows).solve_in_order(system.gradient)
        arrowhead.retract(start, step, fleet.problem.anchor)

    return seconds, least_seconds(iterate), solution.n_linearised, solution.state


def splu(fleet: Fleet) -> tuple[float, float, int, State]:
    """The plain way from our start."""
    start = joint_start(fleet)
    seconds, (state, iterations) = _time_run(lambda: plain_solve(fleet.problem, start, _RELATIVE_TOLERANCE))
    each = least_seconds(lambda: plain_step(*plain_normal_equations(fleet.problem, start), 0.0), 1)
    return seconds, each, iterations, state


def gtsam(fleet: Fleet, start: State) -> tuple[float, float, int, State]:
    """Levenberg-Marquardt as it comes."""
    import gtsam as library

    graph, values = _gtsam_graph(fleet.problem, start.poses[0], library), _gtsam_values(start, library)

    def run() -> tuple[Any, int]:
        optimizer = library.LevenbergMarquardtOptimizer(graph, values, library.LevenbergMarquardtParams())
        return optimizer.optimize(), optimizer.iterations()

    seconds, (result, iterations) = _time_run(run)
    ordering = library.Ordering.ColamdNonlinearFactorGraph(graph)
    each = least_seconds(lambda: graph.linearize(values).optimize(ordering), 1)
    poses = np.array([_pose(result.atPose2(i)) for i in range(len(start.poses))])
    tags = np.array([result.atPoint2(len(start.poses) + i) for i in range(len(start.tags))])
    return seconds, each, iterations, State(poses, tags, start.calibration)


def _gtsam_ordering_seconds(fleet: Fleet) -> float:
    import gtsam as library

    graph = _gtsam_graph(fleet.problem, fleet.dead_reckoned.poses[0], library)
    return least_seconds(lambda: library.Ordering.ColamdNonlinearFactorGraph(graph), 1)


def _gtsam_graph(problem: Problem, held: FloatArray, library: Any) -> Any:  # its bindings carry no types
    graph = library.NonlinearFactorGraph()
    n_poses = len(problem.columns.poses)
    hold = library.noiseModel.Isotropic.Sigma(3, 1e-6)
    graph.add(library.PriorFactorPose2(0, library.Pose2(*held), hold))
    odometry, observations = problem.odometry, problem.observations
    for i, motion, W in zip(odometry.first.tolist(), odometry.motion, odometry.whitening, strict=True):
        noise = library.noiseModel.Gaussian.Information(W.T @ W)
        graph.add(library.BetweenFactorPose2(i, i + 1, library.Pose2(*motion), noise))
    swap = np.array([[0.0, 1.0], [1.0, 0.0]])
    for pose, tag, (range_m, bearing), W in zip(
        observations.pose.tolist(), observations.tag.tolist(), observations.value, observations.whitening, strict=True
    ):
        noise = library.noiseModel.Gaussian.Information(swap @ W.T @ W @ swap)
        graph.add(library.BearingRangeFactor2D(pose, n_poses + tag, library.Rot2(bearing), range_m, noise))
    return graph


def _gtsam_values(start: State, library: Any) -> Any:
    values = library.Values()
    for i, pose in enumerate(start.poses):
        values.insert(i, library.Pose2(*pose))
    for i, tag in enumerate(start.tags):
        values.insert(len(start.poses) + i, np.asarray(tag))
    return values


def _pose(pose: Any) -> FloatArray:
    return np.array([pose.x(), pose.y(), pose.theta()])


def _time_run(run: Callable[[], _Result]) -> tuple[float, _Result]:
    """Least seconds of three runs, or of one that takes a second; and what came out."""
    began = time.process_time()
    result = run()
    least = time.process_time() - began
    return (min(least, least_seconds(run, 2)) if least < 1.0 else least), result


def least_seconds(run: Callable[[], object], repeats: int = 3) -> float:
    """Of some runs."""
    least = np.inf
    for _ in range(repeats):
        began = time.process_time()
        run()
        least = min(least, time.process_time() - began)
    return float(least)


def measure(case: str, solver: str, seed: int) -> dict[str, Any]:
    """One line of the table; in a process of its own."""
    warm_up()
    if solver.startswith("gtsam"):
        import_module("gtsam")  # imports are not counted as memory
    before_mib = memory_mib("VmRSS")
    n_robots, n_keyframes = map(int, case.split("x"))
    fleet = make_fleet(seed, n_robots, n_keyframes, TAGS[case])
    run: dict[str, Callable[[], tuple[float, float, int, State]]] = {
        "ours": lambda: ours(fleet),
        "splu": lambda: splu(fleet),
        "gtsam": lambda: gtsam(fleet, fleet.dead_reckoned),
        "gtsam_our_start": lambda: gtsam(fleet, joint_start(fleet)),
    }
    began = time.process_time()
    arrowhead = fleet.problem.arrowhead  # graph building is not counted
    ordering_seconds = time.process_time() - began
    if solver.startswith("gtsam"):
        ordering_seconds = _gtsam_ordering_seconds(fleet)
    began = time.process_time()
    joint_start(fleet)
    start_seconds = time.process_time() - began
    reset_peak()
    seconds, each, iterations, state = run[solver]()
    return {
        "robots": n_robots,
        "keyframes": n_keyframes,
        "tags": arrowhead.tree.n_tags,
        "solver": solver,
        "seed": seed,
        "seconds": seconds,
        "seconds_per_iteration": each,
        "ordering_seconds": ordering_seconds if solver != "splu" else 0.0,
        "start_seconds": start_seconds if solver != "gtsam" else 0.0,
        "iterations": iterations,
        "cost": fleet.problem.cost(state, PLAIN_SQUARES),
        "peak_mib": memory_mib("VmHWM") - before_mib,
    }


def warm_up() -> float:
    """Loads or compiles what is compiled; returns the seconds that took."""
    began = time.perf_counter()
    ours(make_fleet(0, 2, 100, 20))
    return time.perf_counter() - began


def reset_peak() -> None:
    """Lets the peak of this process's memory begin anew."""
    Path("/proc/self/clear_refs").write_text("5")


def memory_mib(name: str) -> float:
    """VmRSS or VmHWM of this process."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(name)) / 1024.0


def _in_process(case: str, solver: str, seed: int) -> dict[str, Any] | None:
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "TBB_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "tests.benchmarks.speed.solver_bench", "--measure", case, solver, str(seed)]
    try:
        done = subprocess.run(
            command, env=environment, capture_output=True, text=True, check=False, timeout=_TIME_LIMIT_S
        )
    except subprocess.TimeoutExpired:
        return None
    if done.returncode:
        sys.stderr.write(done.stderr[-500:])
        return None
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def compare(cases: list[str], solvers: list[str], repeats: int, seeds: int | None) -> list[dict[str, Any]]:
    """All measurements; of each case, seed and solver the least seconds."""
    best: list[dict[str, Any]] = []
    for case in cases:
        for seed in range(1, (seeds or SEEDS[case]) + 1):
            taken: dict[str, list[dict[str, Any]]] = {solver: [] for solver in solvers}
            for _ in range(repeats):
                for solver in solvers:
                    line = _in_process(case, solver, seed)
                    taken[solver] += [line] if line else []
            for lines in taken.values():
                best += [line | {key: min(one[key] for one in lines) for key in _TIMES} for line in lines[:1]]
                sys.stdout.write("".join(_row(line, best) for line in best[-1:] if lines))
                sys.stdout.flush()
    return best


def _row(line: dict[str, Any], lines: list[dict[str, Any]]) -> str:
    mine = next(
        (
            o
            for o in reversed(lines)
            if o["solver"] == "ours" and o["robots"] == line["robots"] and o["seed"] == line["seed"]
        ),
        line,
    )
    total, each = (line[key] / mine[key] for key in ("seconds", "seconds_per_iteration"))
    return (
        f"{line['robots']:3d} x {line['keyframes']:6d} {line['tags']:4d} tags seed {line['seed']} {line['solver']:16s}"
        f"{line['start_seconds']:8.3f} s start{line['ordering_seconds']:9.5f} s ordering"
        f"{line['seconds']:10.4f} s {line['seconds_per_iteration']:9.5f} s/it {line['iterations']:4d} it"
        f"  cost {line['cost']:.8g} (x{line['cost'] / mine['cost']:.7f})  {line['peak_mib']:7.0f} MiB"
        f"  x{total:.1f} total x{each:.1f} an iteration\n"
    )


def summary(lines: list[dict[str, Any]]) -> str:
    """Of each case and other solver the worst and the median ratio over the seeds."""
    text = "how many times longer than ours, worst and median seed; in brackets with our ordering counted\n"
    mine = {(line["robots"], line["keyframes"], line["seed"]): line for line in lines if line["solver"] == "ours"}
    ratios: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for line in lines:
        own = mine.get((line["robots"], line["keyframes"], line["seed"]))
        if own is not None and line is not own:
            pair = line["seconds"] / own["seconds"], line["seconds"] / (own["seconds"] + own["ordering_seconds"])
            ratios.setdefault((f"{line['robots']}x{line['keyframes']}", line["solver"]), []).append(pair)
    for (case, solver), pairs in ratios.items():
        (worst, worst_all), (median, median_all) = np.min(pairs, axis=0), np.median(pairs, axis=0)
        text += (
            f"{case:>9s} {solver:16s} x{worst:.1f} (x{worst_all:.1f})  x{median:.1f} (x{median_all:.1f})"
            f"  {len(pairs)} seeds\n"
        )
    return text


def main() -> int:
    """Runs what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", nargs="+", default=list(TAGS), choices=list(TAGS))
    parser.add_argument("--solvers", nargs="+", default=list(SOLVERS), choices=SOLVERS)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--seeds", type=int, help="of each case; many for small ones where not said")
    parser.add_argument("--measure", nargs=3, metavar=("CASE", "SOLVER", "SEED"))
    arguments = parser.parse_args()
    if arguments.measure:
        case, solver, seed = arguments.measure
        sys.stdout.write(json.dumps(measure(case, solver, int(seed))) + "\n")
        return 0
    if find_spec("gtsam") is None:
        sys.stdout.write("gtsam is not installed: left out (pip install gtsam)\n")
        arguments.solvers = [solver for solver in arguments.solvers if not solver.startswith("gtsam")]
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})  # and so for all processes begun from here
    sys.stdout.write(f"compiled code ready after {warm_up():.1f} s\n")
    lines = compare(arguments.cases, arguments.solvers, arguments.repeats, arguments.seeds)
    sys.stdout.write(summary(lines))
    write_report(OUTPUT, lines)
    return 0


if __name__ == "__main__":
    sys.exit(main())
