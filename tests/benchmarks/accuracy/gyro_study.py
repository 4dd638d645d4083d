"""What a gyro does for maps of simulated drives, against the Cramer-Rao bound.

    python -m tests.benchmarks.accuracy.gyro_study --world nsh --seeds 0-99 [--gyro none,good,restless,gaps]

Drives without pictures, calibration drawn from its priors; the gyro is like an ICM-20948, `restless` walks ten times as
much, `gaps` misses 2 s twice a run. With `--skid` the wheels skid in turns (`tests.support.data.gyros`), and the
bound beside a gyro is that of wheels that measure distances alone; without a gyro, of wheels that do not skid. With
`--corners` maps are refined on corners. A row a map; then of each gyro RMSE beside the Cramer-Rao bound of the same
seeds (`tests.benchmarks.accuracy.cramer_rao`), medians and mean NEES. Exit 1 where a gyro's promise is missed, or a map
came out in parts; of few seeds chance alone can miss it.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
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
from tests.support.data.gyros import SimulatedGyro, gyro_runs, on_skid_steer

GYROS: Final = {
    "none": None,
    "good": SimulatedGyro(),
    "restless": SimulatedGyro(times_walk=10.0),
    "gaps": SimulatedGyro(n_gaps=2),
}


@dataclass(frozen=True)
class Promise:
    """What maps with a gyro promise.

    Attributes:
        times_bound: RMSE at most so many times the bound, of `start` and `tags`.
        nees: least and most of the tags' mean NEES.
        median_m: most of tags as they stand.
    """

    times_bound: dict[str, float]
    nees: tuple[float, float]
    median_m: float = np.inf


_GOOD: Final = Promise({"start": 1.1, "tags": 1.1}, HONEST_NEES, median_m=0.25)
PROMISES: Final = {
    "good": _GOOD,
    "restless": _GOOD,
    "gaps": replace(_GOOD, median_m=np.inf),  # 2 s by the wheels alone cost more, by the bound itself
}
SKID_PROMISE: Final = Promise({"start": 1.3}, (0.8, 1.25))


@dataclass
class Tally:
    """What the seeds of one world gave with one gyro so far."""

    world: str
    gyro: str
    figures: list[Figures] = field(default_factory=list)
    bounds: list[Bound] = field(default_factory=list)
    in_parts: list[int] = field(default_factory=list)  # seeds
    skids: bool = False
    corners: bool = False

    @property
    def name(self) -> str:
        """Of the world, the drive, the gyro and the map."""
        named = {"skid": self.skids, self.gyro: True, "corners": self.corners}
        return " ".join([self.world, *(name for name, is_so in named.items() if is_so)])

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
        return f"{self.name}, {len(self.figures)} seeds: RMSE {beside_bound}; medians {medians}; {nees}"

    def broken_promises(self) -> list[str]:
        """A sentence for each; without a gyro there is none but that the map is in one part."""
        found = [f"{self.name}, seed {seed}: the map is in parts" for seed in self.in_parts]
        if GYROS[self.gyro] is None or not self.figures:
            return found
        promise = SKID_PROMISE if self.skids else PROMISES[self.gyro]
        for what, most in promise.times_bound.items():
            rmse_m, least_m = self.rmse_m(what)
            if not rmse_m <= most * least_m:
                found.append(f"{self.name}: {what} is {rmse_m / least_m:.3f} times the bound, at most {most:g}")
        nees, (lowest, highest) = np.mean(self.of("nees_tags")), promise.nees
        if not lowest <= nees <= highest:
            found.append(f"{self.name}: tags NEES is {nees:.3f}, between {lowest:g} and {highest:g} is promised")
        median_m, most_m = np.median(self.of("tags_rmse_m")), promise.median_m
        if not median_m <= most_m:
            found.append(f"{self.name}: median tags as they stand are {median_m:.3f} m off, at most {most_m:g} m")
        return found


def gyro_bound(world_name: str, seed: int, gyro: SimulatedGyro | None, *, wheels_turn: bool = True) -> Bound:
    """The bound for the drives of `gyro_runs`; of the gyro, scale and bias are unknown, its stamps exact."""
    world = load_world(world_name)
    if gyro is None:
        return bound_of(world, seed, exact_calibration=False)
    nominal, gaps = Gyro(), np.linspace(0.0, 1.0, gyro.n_gaps + 2)[1:-1]
    walk = gyro.times_walk * nominal.bias_walk_rad_s_per_sqrt_s
    noise = GyroNoise(nominal.noise_rad_per_sqrt_s, walk, gyro.bias_sigma_rad_s, gyro.scale_sigma)
    return bound_of(world, seed, exact_calibration=False, gyro=noise, gyro_gaps=gaps, wheels_turn=wheels_turn)


def study_seed(tally: Tally, seed: int) -> None:
    """Simulates one seed, maps it, and returns the errors."""
    gyro = GYROS[tally.gyro]
    runs, truth = gyro_runs(tally.world, seed, gyro)
    if tally.skids:
        runs = on_skid_steer(runs, truth, seed)
    try:
        figures = figures_of(seed, build_map(runs, corners=tally.corners), truth)
    except ValueError as error:
        tally.in_parts.append(seed)
        say(f"{tally.name}: {error}")
        return
    bound = gyro_bound(tally.world, seed, gyro, wheels_turn=not tally.skids)
    tally.figures.append(figures)
    tally.bounds.append(bound)
    say(
        f"{tally.name} seed {seed}:"
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
    parser.add_argument("--skid", action="store_true", help="wheels skid in turns")
    parser.add_argument("--corners", action="store_true", help="maps are refined on corners")
    given = parser.parse_args(arguments)
    tallies = [Tally(given.world, name, skids=given.skid, corners=given.corners) for name in given.gyro.split(",")]
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
