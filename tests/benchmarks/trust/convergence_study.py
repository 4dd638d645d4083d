"""Does the solve of a long drive past few tags end in the right minimum, and is a wrong one detected?

    python -m tests.benchmarks.trust.convergence_study --seeds 0-99

A row a seed. Right is the optimum that is reached from the truth: the same cost to 1e-6 of it, the same poses to a
millimetre; a lower cost would be right as well. `plain` is Levenberg-Marquardt from dead reckoning; where it fails, its
end is a wrong one for the check to find, too.
"""

import argparse
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from typing import Final

import numpy as np

from groundsbot.calib.geometry import se2
from groundsbot.offline.local_map.goodness_of_fit import fit_windows
from groundsbot.offline.local_map.local_map import solve_local_map
from groundsbot.offline.sam.graph import build_graph
from groundsbot.offline.sam.solver import Solution, solve
from tests.benchmarks.command_line import exit_code, say, seeds_of
from tests.support.data.long_drives import make_long_drive

COST_TOLERANCE: Final = 1e-6  # relative
PLACE_TOLERANCE_M: Final = 1e-3
LEAST_ERROR: Final = (30.0, 60.0)  # m and degrees, medians of dead reckoning
LEAST_PLAIN_FAILURES: Final = 0.2
LEAST_RIGHT: Final = 0.97
MOST_RIGHT_FLAGGED: Final = 0.01


@dataclass(frozen=True)
class Figures:
    """What one seed gave."""

    seed: int
    error_m: float  # of dead reckoning, at its end
    error_deg: float  # likewise, turns counted through
    cost: float  # from the truth
    plain_over: float  # how much more the plain solve ends at
    ours_over: float
    plain_right: bool
    ours_right: bool
    flagged: bool  # ours
    plain_flagged: bool
    truth_flagged: bool
    seconds: float


def study_seed(seed: int) -> Figures:
    """Drives, solves and checks one seed."""
    drive = make_long_drive(seed)
    segment = drive.segment
    dead_reckoned = segment.odometry.dead_reckon()
    turned = se2.between(drive.T_start_base[:-1], drive.T_start_base[1:])[:, 2].sum()
    graph = build_graph([segment])
    best = solve(graph.problem, drive.true_state(graph))
    plain = solve(graph.problem, graph.start(dead_reckoned, {}, {}))
    began = time.perf_counter()
    ours = solve_local_map(segment)
    seconds = time.perf_counter() - began
    windows = fit_windows(graph.problem)
    return Figures(
        seed,
        float(np.hypot(*(dead_reckoned[-1] - drive.T_start_base[-1])[:2])),
        float(np.degrees(abs(segment.odometry.motion[:, 2].sum() - turned))),
        best.cost,
        plain.cost - best.cost,
        ours.solution.cost - best.cost,
        is_right(plain, best),
        is_right(ours.solution, best),
        not ours.goodness.fits,
        not windows.goodness_of_fit(plain.state).fits,
        not windows.goodness_of_fit(best.state).fits,
        seconds,
    )


def is_right(found: Solution, best: Solution) -> bool:
    """Whether a solve ended where the one from the truth did, or lower."""
    if found.cost < best.cost * (1.0 - COST_TOLERANCE):
        return True
    off_m = np.abs(found.state.poses[:, :2] - best.state.poses[:, :2]).max()
    return bool(found.cost <= best.cost * (1.0 + COST_TOLERANCE) and off_m < PLACE_TOLERANCE_M)


def missed_bounds(found: Sequence[Figures]) -> list[str]:
    """A sentence for each promise that these seeds do not keep."""
    n = len(found)
    missed = []
    for name, least, values in (
        ("m", LEAST_ERROR[0], [each.error_m for each in found]),
        ("degrees", LEAST_ERROR[1], [each.error_deg for each in found]),
    ):
        if np.median(values) < least:
            missed.append(f"dead reckoning ends {np.median(values):.0f} {name} off: too easy, {least:g} at least")
    if sum(not each.plain_right for each in found) < LEAST_PLAIN_FAILURES * n:
        missed.append("the plain solve fails too seldom for this to be hard")
    if sum(each.ours_right for each in found) < LEAST_RIGHT * n:
        missed.append(f"right in {sum(each.ours_right for each in found)} of {n} only")
    for what, wrong in (
        ("ours", [each for each in found if not each.ours_right and not each.flagged]),
        ("plain", [each for each in found if not each.plain_right and not each.plain_flagged]),
    ):
        missed += [f"seed {each.seed}: {what} ended in a wrong place unnoticed" for each in wrong]
    for what, flagged in (
        ("ours", [each for each in found if each.ours_right and each.flagged]),
        ("truth", [each for each in found if each.truth_flagged]),
    ):
        if len(flagged) > max(1.0, MOST_RIGHT_FLAGGED * n):
            missed.append(f"{len(flagged)} right ends of {what} flagged")
    return missed


def summary(found: Sequence[Figures]) -> list[str]:
    """The figures over all seeds, as text."""
    n = len(found)
    wrong_plain = [each for each in found if not each.plain_right]
    wrong = [each for each in found if not each.ours_right]
    right = [each for each in found if each.ours_right]
    seconds = [each.seconds for each in found]
    error = (
        f"dead reckoning ends {np.median([each.error_m for each in found]):.0f} m and "
        f"{np.median([each.error_deg for each in found]):.0f} degrees off (medians)"
    )
    plain = (
        f"plain Levenberg-Marquardt from there fails in {len(wrong_plain)} of {n}; "
        f"{sum(each.plain_flagged for each in wrong_plain)} of these ends are flagged"
    )
    ours = (
        f"ours is right in {len(right)} of {n}; flagged: {sum(each.flagged for each in wrong)} of {len(wrong)} wrong, "
        f"{sum(each.flagged for each in right)} of {len(right)} right "
        f"(from the truth {sum(each.truth_flagged for each in found)} of {n})"
    )
    return [error, plain, ours, f"seconds: median {np.median(seconds):.2f}, longest {max(seconds):.2f}"]


def main(arguments: Sequence[str] | None = None) -> int:
    """The script: 0 where every promise is kept, else 1."""
    parser = argparse.ArgumentParser(description="Convergence of long drives past few tags, over simulated seeds.")
    parser.add_argument("--seeds", type=seeds_of, default=range(100), help="FIRST-LAST or one seed [0-99]")
    parser.add_argument("--jobs", type=int, default=1, help="seeds at a time [1]")
    given = parser.parse_args(arguments)
    found = []
    with ProcessPoolExecutor(given.jobs, mp_context=get_context("spawn")) as pool:
        for each in pool.map(study_seed, given.seeds):
            found.append(each)
            say(_row(each))
    for line in summary(found):
        say(line)
    return exit_code(missed_bounds(found))


def _row(each: Figures) -> str:
    def end(over: float, *, right: bool, flagged: bool) -> str:
        return f"{'right' if right else f'wrong by {over:.4g}'}{', flagged' if flagged else ''}"

    plain = end(each.plain_over, right=each.plain_right, flagged=each.plain_flagged)
    ours = end(each.ours_over, right=each.ours_right, flagged=each.flagged)
    return (
        f"seed {each.seed:3d}: dead reckoning off by {each.error_m:5.0f} m {each.error_deg:5.0f} deg; cost "
        f"{each.cost:7.1f}; plain {plain:28}; ours {ours} in {each.seconds:.2f} s"
    )


if __name__ == "__main__":
    sys.exit(main())
