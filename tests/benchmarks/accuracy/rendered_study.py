"""Whether corners better the solve on the floor where all is real pictures: both on the same logs, seed by seed.

    python -m tests.benchmarks.accuracy.rendered_study --seeds 0-23 --jobs 2

Drives of `nsh` with rendered pictures, calibration drawn from the priors of robot.yaml. Two rows a seed, then what is
promised, figure by figure; exit 1 where one is missed. A seed takes minutes to render: with `--drives` they are kept,
and those that are there are taken.
"""

import argparse
import sys
import tempfile
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Final

import numpy as np
from scipy.stats import chi2

from groundsbot.fixtures.simulate import TRUTH_FILE, simulate
from groundsbot.fixtures.worlds.world import World
from groundsbot.offline.evaluation.truth import read_truth
from groundsbot.offline.mapping.inputs import read_runs
from groundsbot.offline.mapping.pipeline import build_map
from groundsbot.onboard.log.reading.reader import find_logs
from tests.benchmarks.accuracy.accuracy_study import Figures, figures_of
from tests.benchmarks.command_line import say, seeds_of

_VECTOR_TIMES: Final = 0.8  # of the floor's, in the median
_TAGS_NEARER: Final = 0.75  # of seeds, at least
_DISTANCE_PERCENT: Final = 0.3  # in the median, at most
_OUTSIDE: Final = 0.001  # of consistent maps lie outside the interval,
_WIDENED: Final = 1.3  # which is wider by this where it is held against rendered pictures
_COLUMNS: Final = ("distance %", "vector m", "tags m", "NEES tags")


@dataclass(frozen=True)
class Pair:
    """One seed, mapped twice; `n_tags` of the map."""

    floor: Figures
    corners: Figures
    n_tags: int


@dataclass(frozen=True)
class Promise:
    """One figure, and whether it is what was promised."""

    words: str
    is_kept: bool


def study_seed(seed: int, world: World | str, kept: Path | None = None) -> Pair:
    """Renders one seed's drives, where they are not among those kept, and maps them on the floor and on corners.

    Raises:
        ValueError: a map is in several parts.
    """
    with tempfile.TemporaryDirectory() as folder:
        drives = (kept or Path(folder)) / f"seed_{seed}"
        if not drives.exists():
            simulate(world, seed, drives, render=True)
        runs, truth = read_runs(find_logs([drives])), read_truth(drives / TRUTH_FILE)
        floor, corners = build_map(runs), build_map(runs, corners=True)
    return Pair(figures_of(seed, floor, truth), figures_of(seed, corners, truth), len(corners.components[0].tags))


def promises(pairs: Sequence[Pair]) -> list[Promise]:
    """What the pairs say of each."""
    floor_m, corners_m = (
        float(np.median([each.vector_error_m for each in figures]))
        for figures in ([pair.floor for pair in pairs], [pair.corners for pair in pairs])
    )
    nearer = sum(pair.corners.tags_rmse_m < pair.floor.tags_rmse_m for pair in pairs)
    percent = float(np.median([pair.corners.start_percent for pair in pairs]))
    outside = [pair.corners.seed for pair in pairs if not _is_honest(pair)]
    mean_nees = float(np.mean([pair.corners.nees_tags for pair in pairs]))
    return [
        Promise(
            f"start vector off by {corners_m:.3f} m in the median, {corners_m / floor_m:.3f} times what the floor's is "
            f"(at most {_VECTOR_TIMES:g})",
            corners_m <= _VECTOR_TIMES * floor_m,
        ),
        Promise(
            f"tags nearer than the floor's in {nearer} of {len(pairs)} seeds (at least {_TAGS_NEARER:.0%})",
            nearer >= _TAGS_NEARER * len(pairs),
        ),
        Promise(
            f"distance of starts off by {percent:.3f} % in the median (at most {_DISTANCE_PERCENT:g})",
            percent <= _DISTANCE_PERCENT,
        ),
        Promise(
            f"tags NEES {mean_nees:.2f} in the mean; outside its interval times {_WIDENED:g} in seeds "
            f"{', '.join(map(str, outside)) or 'none'}",
            not outside,
        ),
    ]


def _is_honest(pair: Pair) -> bool:
    n = 2 * pair.n_tags
    lowest, highest = (chi2.ppf(p, n) / n for p in (_OUTSIDE / 2.0, 1.0 - _OUTSIDE / 2.0))
    return bool(lowest / _WIDENED <= pair.corners.nees_tags <= highest * _WIDENED)


def main(arguments: Sequence[str] | None = None) -> int:
    """The script: 0 where every promise is kept, else 1."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--world", default="nsh", help="name or file of a world [nsh]")
    parser.add_argument("--seeds", type=seeds_of, default="0-23", help="FIRST-LAST or one seed [0-23]")
    parser.add_argument("--jobs", type=int, default=1, help="seeds at a time [1]")
    parser.add_argument("--drives", type=Path, help="folder that keeps the drives [they are not kept]")
    given = parser.parse_args(arguments)
    pairs: list[Pair] = []
    say(f"{'seed':>4} {'model':8}" + "".join(f"{name:>14}" for name in _COLUMNS))
    with ProcessPoolExecutor(given.jobs, mp_context=get_context("spawn")) as pool:
        one = partial(study_seed, world=given.world, kept=given.drives)
        for pair in pool.map(one, given.seeds):
            pairs.append(pair)
            say(_row("floor", pair.floor))
            say(_row("corners", pair.corners))
    found = promises(pairs)
    for each in found:
        say(f"{'kept' if each.is_kept else 'missed'}: {each.words}")
    return 0 if all(each.is_kept for each in found) else 1


def _row(model: str, figures: Figures) -> str:
    values = (figures.start_percent, figures.vector_error_m, figures.tags_rmse_m, figures.nees_tags)
    return f"{figures.seed:4d} {model:8}" + "".join(f"{value:14.3f}" for value in values)


if __name__ == "__main__":
    sys.exit(main())
