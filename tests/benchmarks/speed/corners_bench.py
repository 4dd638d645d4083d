"""What refining on tag corners takes beside the solve of all runs together on the floor, at the same keyframes.

    python -m tests.benchmarks.speed.corners_bench [--worlds nsh,room] [--seed 0] [--repeats 5]

Drives without rendering. By processor time, in one process that has compiled everything, the least of some repeats:
`whole` is all that `--model corners` adds but for covariances (problem, order of elimination, start, solve, whether
the floor is even, segments that are not level); `solve` is the minimisation alone, as the floor's solve is: its graph
and order of elimination are made in the stage before and do not count, nor do the local maps where it starts.
Writes build/benchmarks/corners.jsonl. Exit 1 where the whole takes more than three solves on the floor.
"""

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any, Final

from groundsbot.offline.corners.bundle_adjustment import refine
from groundsbot.offline.corners.floor_noise import initial_attitude_sigmas
from groundsbot.offline.corners.graph import corner_graph
from groundsbot.offline.corners.solver import solve_corners
from groundsbot.offline.foundation.stages import Stages
from groundsbot.offline.mapping.pipeline import build_map
from groundsbot.offline.mapping.workings import Diagnostics
from groundsbot.offline.measurements.run import Run
from tests.benchmarks.command_line import say, write_report
from tests.benchmarks.speed.stages_bench import SOLVE
from tests.support.data.simulated_runs import simulated_runs
from tests.support.paths import ROOT

REPORT: Final = ROOT / "build" / "benchmarks" / "corners.jsonl"
MOST_SOLVES: Final = 3.0


def main(arguments: Sequence[str] | None = None) -> int:
    """Prints a table and writes the report; 1 if the bound is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", default="nsh,room", help="[nsh,room]")
    parser.add_argument("--seed", type=int, default=0, help="[0]")
    parser.add_argument("--repeats", type=int, default=5, help="[5]")
    given = parser.parse_args(arguments)
    lines = []
    for world in given.worlds.split(","):
        lines.append({"world": world, **measure(simulated_runs(world, given.seed)[0], given.repeats)})
        for text in table(lines[-1]):
            say(text)
    write_report(REPORT, lines)
    return 0 if all(line["solves"] <= MOST_SOLVES for line in lines) else 1


def measure(runs: Sequence[Run], repeats: int) -> dict[str, Any]:
    """Processor seconds of each part, the floor's solve, and how many of these the whole comes to."""
    floor, workings = [], Diagnostics()
    for _ in range(1 + repeats):
        stages, workings = Stages(), Diagnostics(keeps_corners=True)
        build_map(runs, stages=stages, workings=workings)
        floor.append(sum(each.cpu_seconds for each in stages.costs if each.name == SOLVE))
    solved = workings.components[0]
    corners, start = corner_graph(solved.graph, solved.solution.state)
    problem = corners.problem
    found = solve_corners(problem, start)
    parts: dict[str, Callable[[], object]] = {
        "whole": lambda: refine(solved.graph, solved.solution),
        "problem and start": lambda: corner_graph(solved.graph, solved.solution.state),
        "solve": lambda: solve_corners(problem, start),
        "whether the floor is even": lambda: initial_attitude_sigmas(found.problem, found.state, found.factor),
    }
    seconds = {name: _least(part, repeats) for name, part in parts.items()}
    on_floor = min(floor[1:])
    return {"floor_seconds": on_floor, "cpu_seconds": seconds, "solves": seconds["whole"] / on_floor}


def table(line: dict[str, Any]) -> list[str]:
    """For a person."""
    on_floor = line["floor_seconds"]
    return [
        f"{line['world']}: the solve on the floor takes {1e3 * on_floor:.1f} ms",
        *(f"{name:<28}{1e3 * each:8.1f} ms{each / on_floor:7.2f} solves" for name, each in line["cpu_seconds"].items()),
        f"at most {MOST_SOLVES:g} for the whole",
    ]


def _least(part: Callable[[], object], repeats: int) -> float:
    costs = []
    for _ in range(1 + repeats):  # the first compiles
        begun = time.process_time()
        part()
        costs.append(time.process_time() - begun)
    return min(costs[1:])


if __name__ == "__main__":
    sys.exit(main())
