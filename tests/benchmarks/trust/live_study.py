"""Maps of drives under way: are they right at each time, and how long does an update take as the drives grow?

    python -m tests.benchmarks.trust.live_study --seeds 0-19 [--world nsh] [--robots hallway,loop] [--step-s 5]
    python -m tests.benchmarks.trust.live_study --minutes 20 [--step-s 5]

The first plays two drives of a world, unrendered and with drawn calibration, and maps them after each step: the largest
error of a tag in its own sigmas, seed by seed. The second plays two drives of a fleet of that length: the processor
time of an update without that of the fits, which have a process of their own. Exit 1 where a tag is off by more than
four sigma, or an update takes more than a second.
"""

import argparse
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from groundsbot.fixtures.simulate import TRUTH_FILE, simulate
from groundsbot.offline.evaluation.against_truth import evaluate
from groundsbot.offline.evaluation.truth import read_truth
from groundsbot.offline.foundation.workers import Workers
from groundsbot.offline.live.live_map import LiveMap, Update
from groundsbot.onboard.log.reading.reader import find_logs
from tests.benchmarks.command_line import exit_code, say, seeds_of
from tests.benchmarks.speed.fleet import simulated_fleet
from tests.support.data.played_logs import PlayedLog, play_all

MOST_SIGMAS: Final = 4.0
MOST_SECONDS: Final = 1.0
_KEYFRAMES_A_MINUTE: Final = 870  # of a robot of the fleet
_TAGS: Final = 100


class FitsApart(Workers):
    """Fits that are there at the next update, and their processor time."""

    def __init__(self) -> None:
        """Begin without fits."""
        super().__init__()
        self.seconds: list[float] = []

    def begin(self, function: Callable[[Any], Any], item: Any) -> Future[Any]:
        """The result of the function, in this process."""
        began_s = time.process_time()
        future: Future[Any] = Future()
        future.set_result(function(item))
        self.seconds.append(time.process_time() - began_s)
        return future


class Step(NamedTuple):
    """One update: time of the drives, the update, and its processor time without that of a fit."""

    at_s: float
    update: Update
    seconds: float


def played(logs: Sequence[Path], copies: Path, step_s: float, fits: FitsApart) -> Iterator[Step]:
    """Play logs and map them after each step."""
    drives = [PlayedLog(log, copies / log.parent.name) for log in logs]
    live = LiveMap([each.copy for each in drives], workers=fits)
    goes_on, at_s = True, 0.0
    while goes_on:
        at_s += step_s
        goes_on = play_all(drives, at_s)
        began_s, n_fits = time.process_time(), len(fits.seconds)
        update = live.update()
        yield Step(at_s, update, time.process_time() - began_s - sum(fits.seconds[n_fits:]))


def worst_sigmas(seed: int, world: str, robots: Sequence[str], step_s: float) -> tuple[float, float, int]:
    """Largest error of a tag in sigmas at any time, the time of that, and the number of maps."""
    worst, when_s, n_maps = 0.0, 0.0, 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "drives"
        simulate(world, seed, folder, robots, render=False)
        truth = read_truth(folder / TRUTH_FILE)
        for step in played(find_logs([folder]), Path(name) / "live", step_s, FitsApart()):
            if step.update.result is None:
                continue
            n_maps += 1
            for component in evaluate(step.update.result, truth).components:
                for tag in component.tags:
                    if tag.error_m > worst * tag.sigma_m:
                        worst, when_s = tag.error_m / tag.sigma_m, step.at_s
    return worst, when_s, n_maps


def update_times(minutes: float, step_s: float) -> list[Step]:
    """The updates of two drives of a fleet."""
    logs = find_logs([simulated_fleet(2, round(_KEYFRAMES_A_MINUTE * minutes), _TAGS, 1)])
    fits, steps = FitsApart(), []
    with tempfile.TemporaryDirectory() as name:
        for step in played(logs, Path(name) / "live", step_s, fits):
            steps.append(step._replace(update=Update(step.update.runs)))
            if len(steps) % round(60.0 / step_s) == 0:
                latest = [each.seconds for each in steps[-round(60.0 / step_s) :]]
                say(
                    f"{step.at_s / 60.0:.0f} min: {np.median(latest):.2f} s (median), {max(latest):.2f} s (largest); "
                    f"{len(fits.seconds)} fits up to now, the last in {fits.seconds[-1]:.1f} s"
                )
    return steps


def main(arguments: Sequence[str] | None = None) -> int:
    """The script."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=seeds_of, help="FIRST-LAST or one seed")
    parser.add_argument("--world", default="nsh", help="[nsh]")
    parser.add_argument("--robots", default="hallway,loop", help="[hallway,loop]")
    parser.add_argument("--minutes", type=float, help="of two drives of a fleet")
    parser.add_argument("--step-s", type=float, default=5.0, help="time of the drives between updates [5]")
    given = parser.parse_args(arguments)
    missed: list[str] = []
    for seed in given.seeds or ():
        sigmas, at_s, n_maps = worst_sigmas(seed, given.world, given.robots.split(","), given.step_s)
        say(f"seed {seed}: of {n_maps} maps the worst tag is off by {sigmas:.2f} sigma, after {at_s:.0f} s")
        if sigmas > MOST_SIGMAS:
            missed.append(f"seed {seed}: a tag is off by {sigmas:.2f} sigma, at most {MOST_SIGMAS:g}")
    if given.minutes:
        largest_s = max(each.seconds for each in update_times(given.minutes, given.step_s))
        if largest_s > MOST_SECONDS:
            missed.append(f"an update took {largest_s:.2f} s, at most {MOST_SECONDS:g}")
    return exit_code(missed)


if __name__ == "__main__":
    sys.exit(main())
