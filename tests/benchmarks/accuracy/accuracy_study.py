"""How accurate maps of simulated drives are, seed by seed, against the bounds that the project promises.

    python -m tests.benchmarks.accuracy.accuracy_study --world nsh --seeds 0-19 --exact-calibration --no-render --jobs 2
    python -m tests.benchmarks.accuracy.accuracy_study --world nsh --gyro --two-cameras --corners

A row a seed, then the medians and the mean NEES; exit 1 where a bound is missed. The options of the
second line add the sensors that docs/sensors.md compares.
"""

import argparse
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import astuple, dataclass, fields
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.fixtures.worlds.world import World
from groundsbot.offline.evaluation.against_truth import evaluate
from groundsbot.offline.evaluation.truth import Truth
from groundsbot.offline.mapping.pipeline import build_map
from groundsbot.offline.maps.result import MapResult
from tests.benchmarks.command_line import exit_code, say, seeds_of
from tests.support.data.simulated_runs import simulated_runs

# Medians over seeds. With the calibration drawn the paper's own figure is 1.8 %.
START_PERCENT_DRAWN = 1.0
START_PERCENT_EXACT = 0.5
VECTOR_SIGMAS_EXACT = 3.0
TAGS_NEES_EXACT = (0.3, 3.0)
_NEES = ("nees_tags", "nees_start")


@dataclass(frozen=True)
class Figures:
    """What one seed gave; of the worst pair of starts where there are several, but for `start_rmse_m`."""

    seed: int
    start_percent: float
    vector_error_m: float
    vector_sigma_m: float  # root of the trace of the vector's covariance
    start_rmse_m: float  # of the vectors from the frame's start to all others
    tags_rmse_m: float
    tags_rmse_aligned_m: float
    trajectory_rmse_m: float
    nees_tags: float
    nees_start: float


def study_seed(seed: int, world: World | str | Path, *, corners: bool = False, **drives: Any) -> Figures:
    """Simulates, maps and compares one seed; `drives` are options of `simulate`.

    Raises:
        ValueError: the map is in several parts, so that there is no figure.
    """
    runs, truth = simulated_runs(world, seed, **drives)
    return figures_of(seed, build_map(runs, corners=corners), truth)


def figures_of(seed: int, result: MapResult, truth: Truth) -> Figures:
    """How far off a map is.

    Raises:
        ValueError: it is in several parts, so that there is no figure.
    """
    errors = evaluate(result, truth).components[0]
    worst = errors.worst_start
    if worst is None or len(result.components) > 1:
        raise ValueError(f"seed {seed}: {len(result.components)} components; {'; '.join(result.warnings)}")
    sigmas = {(p.a, p.b): float(np.sqrt(np.trace(p.covariance))) for p in result.components[0].start_to_start}
    from_frame = [pair.vector_error_m for pair in errors.starts if pair.a == errors.frame_run]
    return Figures(
        seed,
        _number(worst.percent),
        worst.vector_error_m,
        sigmas.get((worst.a, worst.b), float("nan")),
        float(np.sqrt(np.mean(np.square(from_frame)))),
        _number(errors.tags_rmse_m),
        _number(errors.tags_rmse_aligned_m),
        _number(errors.trajectory_rmse_m),
        _number(errors.nees_tags_per_dim),
        _number(errors.nees_start_per_dim),
    )


def medians(figures: Sequence[Figures]) -> dict[str, float]:
    """Median of each figure, and of the vector error in its own sigmas."""
    table: FloatArray = np.array([astuple(each)[1:] for each in figures])
    found = dict(zip((f.name for f in fields(Figures)[1:]), np.median(table, axis=0).tolist(), strict=True))
    sigmas = [each.vector_error_m / each.vector_sigma_m for each in figures]
    return found | {"vector_error_sigmas": float(np.median(sigmas))}


def missed_bounds(figures: Sequence[Figures], *, exact_calibration: bool, render: bool) -> list[str]:
    """A sentence for each bound that the medians miss."""
    found = medians(figures)
    bounds = [("start_percent", 0.0, START_PERCENT_EXACT if exact_calibration else START_PERCENT_DRAWN)]
    if exact_calibration:
        bounds.append(("vector_error_sigmas", 0.0, VECTOR_SIGMAS_EXACT))
        if not render:
            bounds.append(("nees_tags", *TAGS_NEES_EXACT))
    return [
        f"median {name} is {found[name]:.3f}, must lie between {lowest:g} and {highest:g}"
        for name, lowest, highest in bounds
        if not lowest <= found[name] <= highest
    ]


def run_study(world: World | str | Path, seeds: Sequence[int], *, jobs: int = 1, **options: Any) -> list[Figures]:
    """All seeds, several at a time where asked for; rows go to the standard output as they come."""
    one: Callable[[int], Figures] = partial(study_seed, world=world, **options)
    say(" ".join(f"{f.name:>20}" for f in fields(Figures)))
    found = []
    if jobs == 1:
        for seed in seeds:
            found.append(one(seed))
            say(_row(found[-1]))
        return found
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        for each in pool.map(one, seeds):
            found.append(each)
            say(_row(each))
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    """The script: 0 where every bound holds, else 1."""
    parser = argparse.ArgumentParser(description="Accuracy of maps over simulated seeds, against the bounds.")
    parser.add_argument("--world", default="nsh", help="name or file of a world [nsh]")
    parser.add_argument("--seeds", type=seeds_of, default=range(20), help="FIRST-LAST or one seed [0-19]")
    parser.add_argument("--exact-calibration", action="store_true", help="robots are what robot.yaml says")
    parser.add_argument("--render", action=argparse.BooleanOptionalAction, default=False, help="real pictures")
    parser.add_argument("--gyro", action="store_true", help="robots have a gyro")
    parser.add_argument("--two-cameras", action="store_true", help="robots have a camera that looks to the left, too")
    parser.add_argument("--corners", action="store_true", help="maps are refined on corners")
    parser.add_argument("--jobs", type=int, default=1, help="seeds at a time [1]")
    given = parser.parse_args(arguments)
    how = {"exact_calibration": given.exact_calibration, "render": given.render}
    sensors = {"gyro": given.gyro, "two_cameras": given.two_cameras, "corners": given.corners}
    found = run_study(given.world, given.seeds, **how, **sensors, jobs=given.jobs)
    say("medians: " + ", ".join(f"{name} {value:.4g}" for name, value in medians(found).items()))
    say(", ".join(f"mean {name} {np.mean([getattr(each, name) for each in found]):.2f}" for name in _NEES))
    return exit_code(missed_bounds(found, **how))


def _number(value: float | None) -> float:
    return float("nan") if value is None else value


def _row(figures: Figures) -> str:
    seed, *values = astuple(figures)
    return " ".join([f"{seed:>20}", *(f"{value:>20.4f}" for value in values)])


if __name__ == "__main__":
    sys.exit(main())
