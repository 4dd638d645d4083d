"""How time and memory of an iteration grow with keyframes at a fixed number of tags, and a graph with many tags.

    python -m tests.benchmarks.speed.solver_scaling

The slope is that of a straight line through the logarithms.
"""

import sys
from typing import Final

import numpy as np

from groundsbot.offline.sam.linearisation.robust_losses import SQUARES
from groundsbot.offline.sam.solver import Losses, solve
from tests.benchmarks.speed.solver_bench import least_seconds, memory_mib, reset_peak, warm_up
from tests.benchmarks.speed.solver_world import joint_start, make_fleet

KEYFRAMES: Final = (500, 1500, 5000, 15000, 50000)  # of each of two robots
N_TAGS: Final = 100
_PLAIN: Final = Losses(SQUARES, SQUARES)


def growth() -> None:
    """Prints seconds and memory of an iteration for each size, and their slopes."""
    seconds, memory = [], []
    for n in KEYFRAMES:
        fleet = make_fleet(1, 2, n, N_TAGS)
        arrowhead = fleet.problem.arrowhead
        blocks, rows = arrowhead.empty_system(), arrowhead.empty_rows()

        def iterate() -> None:
            system, _ = arrowhead.linearise(fleet.truth, out=blocks)  # noqa: B023  (called at once)
            step = arrowhead.factorise(system, out=rows).solve_in_order(system.gradient)  # noqa: B023
            arrowhead.retract(fleet.truth, step, fleet.problem.anchor)  # noqa: B023

        seconds.append(least_seconds(iterate, 5))
        # Counted, not asked of the system: small problems fit into what a process holds anyway.
        memory.append(sum(array.nbytes for array in (*blocks, *rows)) / 2.0**20)
        sys.stdout.write(f"2 x {n:6d} keyframes: {1e3 * seconds[-1]:8.2f} ms an iteration, {memory[-1]:7.1f} MiB\n")
    for name, values in (("time", seconds), ("memory", memory)):
        slope = np.polyfit(np.log(KEYFRAMES), np.log(values), 1)[0]
        sys.stdout.write(f"log-log slope of {name}: {slope:.2f}\n")


def many_tags() -> None:
    """Prints what 2,000 tags and 20,000 keyframes take."""
    fleet = make_fleet(1, 10, 2000, 2600, n_crossings=14)
    _ = fleet.problem.arrowhead
    before = memory_mib("VmRSS")
    reset_peak()
    found: list[str] = []

    def run() -> None:
        solution = solve(fleet.problem, joint_start(fleet), losses=_PLAIN, relative_tolerance=1e-7)
        found.append(f"{solution.reason}, {solution.n_linearised} linearisations, cost {solution.cost:.6g}")

    took = least_seconds(run, 1)
    sys.stdout.write(
        f"{len(fleet.truth.tags)} tags, {len(fleet.truth.poses)} keyframes: {took:.2f} s, "
        f"{memory_mib('VmHWM') - before:.0f} MiB ({found[0]})\n"
    )


if __name__ == "__main__":
    warm_up()
    growth()
    many_tags()
