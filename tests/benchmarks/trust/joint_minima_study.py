"""Does the joint solve of several long drives end in the least minimum?

    python -m tests.benchmarks.trust.joint_minima_study --drives 8 --length-m 1000 --seeds 0-23

A row a seed: drives of one simulated town past tags 10 to 30 m apart, each solved alone, aligned and solved together.
Right is the cost that is reached from the truth, to 1e-6 of it, or less. Exit 1 where an end is not right.
"""

import argparse
import sys
import time
from collections.abc import Sequence
from typing import Final

import numpy as np

from groundsbot.calib.geometry import se2
from groundsbot.offline.alignment.merging import merge
from groundsbot.offline.foundation.stages import Stages
from groundsbot.offline.global_map.joint_solve import solve_global_map
from groundsbot.offline.local_map.local_map import solve_local_map
from groundsbot.offline.sam.graph import build_graph
from groundsbot.offline.sam.solver import Solution, solve
from tests.benchmarks.command_line import exit_code, say, seeds_of
from tests.support.data.long_drives import LongDrive, make_long_drive, make_town

COST_TOLERANCE: Final = 1e-6  # relative
N_CROSSINGS: Final = 6


def drives_of(seed: int, n: int, length_m: float) -> list[LongDrive]:
    """Drives of one town."""
    town = make_town(seed, n_crossings=N_CROSSINGS)
    return [make_long_drive(number + 100 * seed, length_m, town=town) for number in range(n)]


def solve_from_truth(drives: Sequence[LongDrive]) -> Solution:
    """The minimum next to the truth, in the frame of the first drive's start."""
    graph = build_graph([drive.segment for drive in drives])
    of_start = [se2.between(drives[0].T_town_start, drive.T_town_start) for drive in drives]
    poses = np.concatenate([se2.compose(T, each.T_start_base) for T, each in zip(of_start, drives, strict=True)])
    tags = {
        tag: se2.apply(T, place)
        for T, drive in zip(of_start, drives, strict=True)
        for tag, place in drive.tags_m.items()
    }
    return solve(graph.problem, graph.start(poses, tags, {}))


def study_seed(seed: int, n: int, length_m: float) -> tuple[str, bool]:
    """The row of a seed, and whether all its components end right."""
    drives = drives_of(seed, n, length_m)
    maps = [solve_local_map(drive.segment) for drive in drives]
    row, all_right = f"{seed:4d}", True
    for group in merge(maps).groups:
        best = solve_from_truth([drives[m] for m in group.members])
        stages = Stages()
        began_s = time.process_time()
        _, found = solve_global_map(maps, group, stages)
        seconds = time.process_time() - began_s
        is_right = found.converged and found.cost <= best.cost * (1.0 + COST_TOLERANCE)
        all_right &= is_right
        row += (
            f"  {len(group.members)} drives: {found.cost:.2f}, from the truth {best.cost:.2f}, "
            f"{found.n_linearised} linearisations, {seconds:.1f} s{'' if is_right else ': WRONG'}"
        )
    return row, all_right


def main(arguments: Sequence[str] | None = None) -> int:
    """Prints a row for each seed; 1 where an end is not right."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--drives", type=int, default=8)
    parser.add_argument("--length-m", type=float, default=1000.0)
    parser.add_argument("--seeds", type=seeds_of, default=range(24), help="FIRST-LAST or one seed [0-23]")
    given = parser.parse_args(arguments)
    wrong = []
    for seed in given.seeds:
        row, is_right = study_seed(seed, given.drives, given.length_m)
        say(row)
        wrong += [] if is_right else [f"seed {seed} ended in another minimum"]
    say(f"right in {len(given.seeds) - len(wrong)} of {len(given.seeds)}")
    return exit_code(wrong)


if __name__ == "__main__":
    sys.exit(main())
