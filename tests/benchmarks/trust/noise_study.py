"""Fitted noise against the noise that drives were simulated with, and maps made under it, seed by seed.

    python -m tests.benchmarks.trust.noise_study --worlds nsh,nsh_flat --seeds 0-99 --factors 0.1,10

The calibration is drawn from its priors, and the fit begins at so many times the true sigmas. A row a map: found by
true, then NEES of tags and of starts. Then, for each world and all: how often a 99 % interval holds the truth, how
often a sigma lies within 20 % of it where its redundancy is 100 or more, and mean NEES. Maps whose runs were not joined
are reported and count as missed. Exit 1 where a bound is missed.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.offline.evaluation.against_truth import evaluate
from groundsbot.offline.mapping.pipeline import build_map
from groundsbot.offline.maps.parameter_results import NOT_NEEDED, FittedParameter
from tests.benchmarks.command_line import say, seeds_of
from tests.support.data.simulated_runs import simulated_runs

ENOUGH_REDUNDANCY = 100.0
CLOSE = 0.2
LEAST_INSIDE = 0.97
TAGS_NEES = (0.85, 1.15)


@dataclass(frozen=True)
class Found:
    """One noise parameter beside the truth."""

    found: FittedParameter
    true: float

    @property
    def ratio(self) -> float:
        """Found by true."""
        return self.found.value / self.true

    @property
    def inside(self) -> bool | None:
        """Whether its own 99 % interval holds the truth; None where it states none."""
        if self.found.low is None or self.found.high is None:
            return None
        return self.found.low < self.true < self.found.high

    @property
    def mark(self) -> str:
        """A sign behind it in the table: not fitted, or truth outside of its interval."""
        return "*" if self.found.kept else " " if self.inside else "!"

    @property
    def close(self) -> bool | None:
        """Whether it is within 20 % of the truth; None where there is too little redundancy."""
        return None if self.found.redundancy < ENOUGH_REDUNDANCY else abs(self.ratio - 1.0) <= CLOSE


@dataclass(frozen=True)
class Mapped:
    """One map."""

    world: str
    seed: int
    factor: float
    parameters: tuple[Found, ...]
    nees_tags: float
    nees_start: float


def study_seed(world: str, seed: int, factors: Sequence[float]) -> list[Mapped | str]:
    """Simulates drives with the default noise, and maps them once for each factor; or says why runs were not joined."""
    true = NoiseParameters()
    rows: list[Mapped | str] = []
    runs, truth = simulated_runs(world, seed)
    for factor in factors:
        prior = NoiseParameters(**{name: factor * getattr(true, name) for name in NoiseParameters.model_fields})
        result = build_map(runs, prior_noise=prior)
        if len(result.components) > 1 or result.noise_fit is None:
            rows.append(f"{world}, seed {seed}, from {factor:g} times: {'; '.join(result.warnings)}")
            continue
        errors = evaluate(result, truth).components[0]
        fitted = [each for each in result.noise_fit.parameters if each.kept != NOT_NEEDED]
        found = tuple(Found(each, getattr(true, each.name)) for each in fitted)
        nees = _number(errors.nees_tags_per_dim), _number(errors.nees_start_per_dim)
        rows.append(Mapped(world, seed, factor, found, *nees))
    return rows


def summary(rows: Sequence[Mapped]) -> tuple[list[str], bool]:
    """A line for each parameter and one for NEES; and whether all bounds hold."""
    lines, good = [], True
    for name in dict.fromkeys(each.found.name for row in rows for each in row.parameters):
        of_name = [each for row in rows for each in row.parameters if each.found.name == name]
        inside = [each.inside for each in of_name if each.inside is not None]
        close = [each.close for each in of_name if each.close is not None]
        fitted = [each.ratio for each in of_name if not each.found.kept]
        good &= not inside or float(np.mean(inside)) >= LEAST_INSIDE
        good &= all(close)
        lines.append(
            f"{name:32s} fitted {len(fitted):4d} of {len(of_name)}"
            + (f", median ratio {np.median(fitted):6.3f}, inside {np.mean(inside):6.1%}" if fitted else "")
            + (f", within 20 % where redundant {np.mean(close):6.1%} of {len(close)}" if close else "")
        )
    tags = float(np.mean([row.nees_tags for row in rows]))
    start = float(np.mean([row.nees_start for row in rows]))
    good &= TAGS_NEES[0] <= tags <= TAGS_NEES[1]
    lines.append(f"{len(rows)} maps: mean tags NEES {tags:.3f}, mean start NEES {start:.3f}")
    return lines, good


def main(arguments: Sequence[str] | None = None) -> int:
    """The script: 0 where all bounds hold, else 1."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", default="nsh,nsh_flat", help="names of worlds [nsh,nsh_flat]")
    parser.add_argument("--seeds", type=seeds_of, default="0-9", help="FIRST-LAST [0-9]")
    parser.add_argument("--factors", default="0.1,10", help="the fit begins at so many times the truth [0.1,10]")
    given = parser.parse_args(arguments)
    worlds, factors = given.worlds.split(","), [float(each) for each in given.factors.split(",")]
    rows: list[Mapped] = []
    apart: list[str] = []
    for seed in given.seeds:
        for world in worlds:
            for row in study_seed(world, seed, factors):
                if isinstance(row, str):
                    apart.append(row)
                    say(f"not joined: {row}")
                    continue
                rows.append(row)
                ratios = " ".join(f"{each.ratio:7.3f}{each.mark}" for each in row.parameters)
                say(f"{world:9s} {seed:4d} {row.factor:5g}  {ratios}  {row.nees_tags:6.2f} {row.nees_start:6.2f}")
    all_good = not apart
    for world in worlds:
        for factor in factors:
            lines, good = summary([row for row in rows if (row.world, row.factor) == (world, factor)])
            all_good &= good
            say(f"{world}, from {factor:g} times the truth (* not fitted, ! truth outside):")
            for line in lines:
                say("  " + line)
    return 0 if all_good else 1


def _number(value: float | None) -> float:
    return float("nan") if value is None else value


if __name__ == "__main__":
    sys.exit(main())
