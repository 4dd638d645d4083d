"""Whether self-calibration spoils a map whose robot.yaml is right, seed by seed.

    python -m tests.benchmarks.trust.gating_study --worlds room,nsh,nsh_flat,nsh_rough --seeds 0-99

Drives without rendering, calibration drawn from the priors of robot.yaml; each is mapped with `--calibrate off` and
`auto`, under the true noise and under one three times too small and too large. A row a map: RMSE of the starts and of
the tags, as the map stands, and what was freed. Then RMSE over the seeds. Exit 1 where auto's is above 1.05 times
off's, where one error of auto is above three times off's RMSE, or where a map came out in parts.

    python -m tests.benchmarks.trust.gating_study --worlds nsh --seeds 0-23 --drives 4

With `--drives N`, calibration exactly as in robot.yaml: N drives of each robot are judged together, without a map. A
row a robot and group of N seeds: errors of all numbers and their sigmas. Then mean, its standard error, its predicted
sigma and the RMS of errors over sigmas. Exit 1 where a number was freed.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.fixtures.worlds.world import World
from groundsbot.offline.foundation import Stages, Workers
from groundsbot.offline.mapping.pipeline import build_map
from groundsbot.offline.maps import CalibrationChoice
from groundsbot.offline.self_calibration.option import Calibrate
from groundsbot.offline.self_calibration.self_calibration import free_parameters
from tests.benchmarks.accuracy.accuracy_study import figures_of
from tests.benchmarks.accuracy.against_bound import study_worlds
from tests.benchmarks.command_line import say, seeds_of
from tests.support.data.simulated_runs import simulated_runs

MOST_RMSE: Final = 1.05
MOST_SINGLE: Final = 3.0
FACTORS: Final = (1.0, 1.0 / 3.0, 3.0)


@dataclass(frozen=True)
class Pair:
    """Errors of one seed's map in m, starts and tags (2,), with self-calibration off and on."""

    world: str
    seed: int
    factor: float
    off: tuple[float, float]
    auto: tuple[float, float]
    freed: tuple[str, ...]


def study_seed(world: World, seed: int, factors: Sequence[float] = FACTORS) -> list[Pair | str]:
    """A pair for each noise, or why there is none."""
    true, rows = NoiseParameters(), list[Pair | str]()
    runs, truth = simulated_runs(world, seed)
    for factor in factors:
        noise = NoiseParameters(**{name: factor * value for name, value in true})
        try:
            off, auto = (build_map(runs, noise, calibrate=Calibrate(is_on=is_on)) for is_on in (False, True))
            errors = [(f.start_rmse_m, f.tags_rmse_m) for f in (figures_of(seed, each, truth) for each in (off, auto))]
        except ValueError as error:
            rows.append(f"{world.name}, seed {seed}, noise {factor:.2g} times: {error}")
            continue
        freed = tuple(f"{each.name} of {each.owner}" for each in auto.choices if each.is_freed)
        rows.append(Pair(world.name, seed, factor, errors[0], errors[1], freed))
    return rows


def summary(pairs: Sequence[Pair]) -> tuple[list[str], bool]:
    """A line for each world and noise, and whether all bounds hold."""
    lines, good = [], True
    for world, factor in dict.fromkeys((each.world, each.factor) for each in pairs):
        some = [each for each in pairs if (each.world, each.factor) == (world, factor)]
        off, auto = np.array([each.off for each in some]), np.array([each.auto for each in some])
        rmse = np.sqrt((off**2).mean(axis=0))
        ratio, worst = np.sqrt((auto**2).mean(axis=0)) / rmse, auto.max(axis=0) / rmse
        good &= bool((ratio <= MOST_RMSE).all() and (worst <= MOST_SINGLE).all())
        n_freed = sum(bool(each.freed) for each in some)
        lines.append(
            f"{world:10s} noise {factor:5.2f} times, {len(some)} seeds: auto over off, starts {ratio[0]:.3f}, tags "
            f"{ratio[1]:.3f}; largest error of auto over RMSE of off {worst[0]:.2f}, {worst[1]:.2f}; freed in {n_freed}"
        )
    return lines, good


@dataclass(frozen=True)
class Group:
    """What self-calibration says of one robot by drives of some seeds, its robot.yaml being right."""

    world: str
    robot: str
    seeds: range
    choices: tuple[CalibrationChoice, ...]

    def __str__(self) -> str:
        found = (f"{c.name} {c.value:.5f} +- {c.sigma:.5f}{' freed' * c.is_freed}" for c in self.choices)
        return f"{self.world}, {self.robot}, seeds {self.seeds[0]}-{self.seeds[-1]}: {', '.join(found)}"


def study_group(world: World, robot: str, seeds: range) -> Group:
    """The judgement of one robot by one drive of each seed, calibration as in robot.yaml."""
    runs = [run for seed in seeds for run in simulated_runs(world, seed, [robot], exact_calibration=True)[0]]
    found = free_parameters(runs, NoiseParameters(), (), Stages(), Workers(), corners=False)
    return Group(world.name, robot, seeds, found.choices)


def bias_lines(groups: Sequence[Group]) -> list[str]:
    """A line for each world, robot and number: the mean error over groups, and how large it should be."""
    lines = []
    for world, robot in dict.fromkeys((each.world, each.robot) for each in groups):
        own = [each.choices for each in groups if (each.world, each.robot) == (world, robot)]
        for same in zip(*own, strict=True):
            value, sigma = np.array([(each.value, each.sigma) for each in same]).T
            error = value.std(ddof=1) / len(same) ** 0.5 if len(same) > 1 else np.nan
            lines.append(
                f"{world:10s} {robot:8s} {same[0].name:16s} mean {value.mean():8.5f} +- {error:.5f}, predicted "
                f"{np.sqrt((sigma**2).mean() / len(same)):.5f}; RMS of errors over sigmas "
                f"{np.sqrt(((value / sigma) ** 2).mean()):.2f}; freed in {sum(each.is_freed for each in same)}"
            )
    return lines


def _judge_groups(worlds: Sequence[World], seeds: range, n_drives: int) -> int:
    """Judge all whole groups of seeds; 1 where a number was freed."""
    groups = []
    for world in worlds:
        for robot in world.robots:
            for first in range(seeds[0], seeds[-1] + 2 - n_drives, n_drives):
                groups.append(study_group(world, robot.id, range(first, first + n_drives)))
                say(str(groups[-1]))
    for line in bias_lines(groups):
        say(line)
    return int(any(choice.is_freed for each in groups for choice in each.choices))


def main(arguments: Sequence[str] | None = None) -> int:
    """The script: 0 where every bound holds, else 1."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    known = study_worlds()
    parser.add_argument("--worlds", default=",".join(known), help=f"[{','.join(known)}]")
    parser.add_argument("--seeds", type=seeds_of, default="0-99", help="FIRST-LAST or one seed [0-99]")
    parser.add_argument("--drives", type=int, help="drives of each robot that are judged together [one map a seed]")
    given = parser.parse_args(arguments)
    if given.drives is not None and not 1 <= given.drives <= len(given.seeds):
        parser.error(f"--drives is {given.drives}, but --seeds has {len(given.seeds)}; give 1 to that many")
    if given.drives:
        return _judge_groups([known[name] for name in given.worlds.split(",")], given.seeds, given.drives)
    pairs, failed = [], False
    for name in given.worlds.split(","):
        for seed in given.seeds:
            for row in study_seed(known[name], seed):
                say(str(row))
                failed |= isinstance(row, str)
                pairs += [row] if isinstance(row, Pair) else []
    lines, good = summary(pairs)
    for line in lines:
        say(line)
    return 0 if good and not failed else 1


if __name__ == "__main__":
    sys.exit(main())
