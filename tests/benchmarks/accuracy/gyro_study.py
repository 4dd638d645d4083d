"""What a gyro does for maps of simulated drives, against the Cramer-Rao bound.

    python -m tests.benchmarks.accuracy.gyro_study --world nsh --seeds 0-99 [--gyro none,good,restless,gaps]

Drives without pictures, calibration drawn from its priors; the gyro is like an ICM-20948, `restless` walks ten times as
much, `gaps` misses 2 s twice a run. A row a map; then of each gyro RMSE beside the Cramer-Rao bound of the same seeds
(`tests.benchmarks.accuracy.cramer_rao`), medians and mean NEES. Exit 1 where a gyro's promise is missed, or a map came
out in parts; of few seeds chance alone can miss it.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from groundsbot.calib.robot import Gyro
from groundsbot.fixtures.worlds import load_world
from groundsbot.offline.mapping.pipeline import build_map
from tests.benchmarks.accuracy.accuracy_study import Figures, figures_of
from tests.benchmarks.accuracy.against_bound import HONEST_NEES
from tests.benchmarks.accuracy.cramer_rao import Bound
from tests.benchmarks.accuracy.cramer_rao_gyro import GyroNoise
from tests.benchmarks.accuracy.cramer_rao_world import bound_of
from tests.benchmarks.command_line import exit_code, say, seeds_of
from tests.support.data.gyros import SimulatedGyro, gyro_runs

GYROS: Final = {
    "none": None,
    "good": SimulatedGyro(),
    "restless": SimulatedGyro(times_walk=10.0),
    "gaps": SimulatedGyro(n_gaps=2),
}
# What a map with a gyro promises: RMSE at most so many times the bound, and in the median tags as they stand to so
# much. Twice 2 s by the wheels alone cost more than that, by the bound itself.
MOST_TIMES_BOUND: Final = 1.1
MOST_MEDIAN_M: Final = 0.25
_WITHOUT_MEDIAN: Final = ("gaps",)


@dataclass
class Tally:
    """What the seeds of one world gave with one gyro so far."""

    world: str
    gyro: str
    figures: list[Figures] = field(default_factory=list)
    bounds: list[Bound] = field(default_factory=list)
    in_parts: list[int] = field(default_factory=list)  # seeds

    def of(self, name: str) -> list[float]:
        """A figure of each seed."""
        return [getattr(each, name) for each in self.figures]

    def rmse_m(self, name: str) -> tuple[float, float]:
        """RMSE over the seeds, and the bound on it."""
        least = [getattr(each, {"start": "start_to_start_m", "tags": "tags_m"}[name]) for each in self.bounds]
        return _rms(self.of(f"{name}_rmse_m")), _rms(least)

    def told(self) -> str:
        """A line."""
        beside_bound = ", ".join(
            f"{what} {found:.3f} m ({found / least:.2f} times the bound, {least:.3f} m)"
            for what, (found, least) in ((each, self.rmse_m(each)) for each in ("start", "tags"))
        )
        medians = ", ".join(
            f"{what} {np.median(self.of(name)):.3f} m"
            for what, name in (
                ("start", "start_rmse_m"), ("tags as they stand", "tags_rmse_m"), ("aligned", "tags_rmse_aligned_m")
            )
        )  # fmt: skip
        nees = f"NEES tags {np.mean(self.of('nees_tags')):.2f}, start {np.mean(self.of('nees_start')):.2f}"
        return f"{self.world} {self.gyro}, {len(self.figures)} seeds: RMSE {beside_bound}; medians {medians}; {nees}"

    def broken_promises(self) -> list[str]:
        """A sentence for each; without a gyro there is none but that the map is in one part."""
        who = f"{self.world} {self.gyro}"
        found = [f"{who}, seed {seed}: the map is in parts" for seed in self.in_parts]
        if GYROS[self.gyro] is None or not self.figures:
            return found
        for what in ("start", "tags"):
            rmse_m, least_m = self.rmse_m(what)
            if not rmse_m <= MOST_TIMES_BOUND * least_m:
                found.append(f"{who}: {what} is {rmse_m / least_m:.3f} times the bound, at most {MOST_TIMES_BOUND:g}")
        nees, (lowest, highest) = np.mean(self.of("nees_tags")), HONEST_NEES
        if not lowest <= nees <= highest:
            found.append(f"{who}: tags NEES is {nees:.3f}, between {lowest:g} and {highest:g} is promised")
        median_m = np.median(self.of("tags_rmse_m"))
        if self.gyro not in _WITHOUT_MEDIAN and not median_m <= MOST_MEDIAN_M:
            found.append(f"{who}: median tags as they stand are {median_m:.3f} m off, at most {MOST_MEDIAN_M:g} m")
        return found


def gyro_bound(world_name: str, seed: int, gyro: SimulatedGyro | None) -> Bound:
    """The bound for the drives of `gyro_runs`; of the gyro, scale and bias are unknown, its stamps exact."""
    world = load_world(world_name)
    if gyro is None:
        return bound_of(world, seed, exact_calibration=False)
    nominal, gaps = Gyro(), np.linspace(0.0, 1.0, gyro.n_gaps + 2)[1:-1]
    walk = gyro.times_walk * nominal.bias_walk_rad_s_per_sqrt_s
    noise = GyroNoise(nominal.noise_rad_per_sqrt_s, walk, gyro.bias_sigma_rad_s, gyro.scale_sigma)
    return bound_of(world, seed, exact_calibration=False, gyro=noise, gyro_gaps=gaps)


def study_seed(tally: Tally, seed: int) -> None:
    """Simulates one seed, maps it, and returns the errors."""
    gyro = GYROS[tally.gyro]
    runs, truth = gyro_runs(tally.world, seed, gyro)
    try:
        figures = figures_of(seed, build_map(runs), truth)
    except ValueError as error:
        tally.in_parts.append(seed)
        say(f"{tally.world} {tally.gyro}: {error}")
        return
    bound = gyro_bound(tally.world, seed, gyro)
    tally.figures.append(figures)
    tally.bounds.append(bound)
    say(
        f"{tally.world} {tally.gyro} seed {seed}:"
        f" start {figures.start_rmse_m:.3f} m (bound {bound.start_to_start_m:.3f}),"
        f" tags {figures.tags_rmse_m:.3f} m (bound {bound.tags_m:.3f}), aligned {figures.tags_rmse_aligned_m:.3f} m,"
        f" NEES {figures.nees_tags:.2f}, {figures.nees_start:.2f}"
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """The script: 0 where every promise is kept, else 1."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--world", default="nsh")
    parser.add_argument("--seeds", type=seeds_of, default="0-19", help="FIRST-LAST or one seed [0-19]")
    parser.add_argument("--gyro", default="none,good", help=f"of {','.join(GYROS)} [none,good]")
    given = parser.parse_args(arguments)
    tallies = [Tally(given.world, name) for name in given.gyro.split(",")]
    for tally in tallies:
        for seed in given.seeds:
            study_seed(tally, seed)
        if tally.figures:
            say(tally.told())
    return exit_code([sentence for each in tallies for sentence in each.broken_promises()])


def _rms(values: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


if __name__ == "__main__":
    sys.exit(main())
