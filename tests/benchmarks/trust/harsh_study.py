"""Maps of drives that err as real robots do, seed by seed, against the Cramer-Rao bound.

    python -m tests.benchmarks.trust.harsh_study --world nsh --seeds 0-199 [--harsh all] [--calibrate auto,off]
        [--tag-positions] [--changes] [--jobs 2]

Drives of `simulate --harsh`, mapped as `map` does. `--changes`: after the first drive one tag that both drives see is
moved by 0.5 m and two change places. A row a map: components, RMSE of the shape (tags moved and turned onto the truth),
the Cramer-Rao bound of it (`harsh_bound`), NEES of the tags, tags named that were not changed, and of those that were
changed by more than six sigmas of that bound how many are named. Then the figures over the seeds. Exit 1 where fewer
than 98 % of the maps are one component, the RMSE is above 1.3 times the bound's, NEES is not between 0.85 and 1.15,
more than one good tag in ten maps is named, fewer than 90 % of the changed ones are, or auto's RMSE is above half of
off's.
"""

import argparse
import sys
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Final

import numpy as np

from groundsbot.fixtures.drives.harsh import Harsh, harsh_switches
from groundsbot.fixtures.simulate import TRUTH_FILE, simulate
from groundsbot.offline.evaluation.against_truth import evaluate
from groundsbot.offline.evaluation.truth import read_truth
from groundsbot.offline.mapping.inputs import read_runs
from groundsbot.offline.mapping.pipeline import build_map
from groundsbot.offline.maps.result import MapResult
from groundsbot.offline.outliers.kinds import PHANTOM
from groundsbot.offline.self_calibration.option import parse_calibrate
from groundsbot.onboard.log.reading.reader import find_logs
from tests.benchmarks.command_line import exit_code, say, seeds_of
from tests.benchmarks.trust.harsh_bound import shape_bound_m, shift_sigmas

ONE_COMPONENT: Final = 0.98
MOST_TIMES_BOUND: Final = 1.3
HONEST_NEES: Final = (0.85, 1.15)
MOST_FALSE_NAMES: Final = 0.1
LEAST_FOUND: Final = 0.9
CLEAR_SIGMAS: Final = 6.0
MOST_OF_OFF: Final = 0.5
_MOVED_M: Final = (0.3, 0.4)


@dataclass(frozen=True)
class Row:
    """What one map of one seed is like."""

    seed: int
    calibrate: str
    n_components: int
    shape_m: float
    bound_m: float
    nees: float
    n_false: int
    n_changed: int
    n_found: int

    def __str__(self) -> str:
        return (
            f"seed {self.seed:4d} {self.calibrate:4s} {self.n_components} components, shape {self.shape_m:.3f} m, "
            f"bound {self.bound_m:.3f} m, NEES {self.nees:.2f}, {self.n_false} falsely named, {self.n_found} of "
            f"{self.n_changed} changed ones named"
        )


def study_seed(
    seed: int, world: str, harsh: frozenset[Harsh], calibrate: Sequence[str], *, tag_positions: bool, changes: bool
) -> list[Row]:
    """Simulates a seed and maps it in each way."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "drives"
        make = partial(simulate, world, seed, render=False, harsh=harsh, tag_positions=tag_positions)
        moved, swapped = {}, []
        if changes:
            make(Path(name) / "before")
            shared = _tags_of_all(Path(name) / "before")
            rng = np.random.default_rng(seed)
            one, *two = rng.choice(shared, 3, replace=False).tolist()
            moved, swapped = {one: _MOVED_M}, [(two[0], two[1])]
        make(folder, moved_m=moved, swapped=swapped)
        runs = read_runs(find_logs([folder]))
        bound_m = float("nan") if changes else shape_bound_m(runs, folder / TRUTH_FILE, harsh)
        changed = set(moved) | {tag for pair in swapped for tag in pair}
        sigmas = shift_sigmas(runs, folder / TRUTH_FILE, harsh) if changes else {}
        clear = {tag for tag in changed if sigmas.get(tag, 0.0) > CLEAR_SIGMAS}
        return [
            _row(
                seed,
                each,
                build_map(runs, calibrate=parse_calibrate(each)),
                folder / TRUTH_FILE,
                bound_m,
                changed,
                clear,
            )
            for each in calibrate
        ]


def _tags_of_all(folder: Path) -> list[int]:
    runs = read_runs(find_logs([folder]))
    seen = [{tag.tag_id for tag in run.tags} for run in runs]
    return sorted(set.intersection(*seen))


def _row(
    seed: int, calibrate: str, result: MapResult, truth: Path, bound_m: float, changed: set[int], clear: set[int]
) -> Row:
    errors = evaluate(result, read_truth(truth)).components[0]
    named = {each.tag_id for each in result.outliers if each.kind != PHANTOM}
    return Row(
        seed,
        calibrate,
        len(result.components),
        _number(errors.tags_rmse_aligned_m),
        bound_m,
        _number(errors.nees_tags_per_dim),
        len(named - changed),
        len(clear),
        len(named & clear),
    )


def _number(value: float | None) -> float:
    return float("nan") if value is None else value


def _rms(values: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def broken_bounds(rows: Sequence[Row]) -> Iterator[str]:
    """Says the figures of each way to map, and yields a sentence for each bound that is missed."""
    rmse: dict[str, float] = {}
    for calibrate in dict.fromkeys(each.calibrate for each in rows):
        own = [each for each in rows if each.calibrate == calibrate]
        whole = [each for each in own if each.n_components == 1 and np.isfinite(each.shape_m)]
        share = len(whole) / len(own)
        shape_m, bound_m = _rms([each.shape_m for each in own]), _rms([each.bound_m for each in own])
        rmse[calibrate] = shape_m
        nees, false = float(np.nanmean([each.nees for each in own])), float(np.mean([each.n_false for each in own]))
        n_changed, n_found = sum(each.n_changed for each in own), sum(each.n_found for each in own)
        say(
            f"{calibrate}, {len(own)} seeds: one component {share:.3f}, shape {shape_m:.3f} m (median "
            f"{np.median([each.shape_m for each in own]):.3f}), bound {bound_m:.3f} m, ratio {shape_m / bound_m:.2f} "
            f"(median {np.median([each.shape_m / each.bound_m for each in own]):.2f}), NEES {nees:.2f} (median "
            f"{np.nanmedian([each.nees for each in own]):.2f}), falsely named {false:.3f} a map, found {n_found} of "
            f"{n_changed}"
        )
        if calibrate == "off":
            continue
        if share < ONE_COMPONENT:
            yield f"{calibrate}: one component in {share:.3f}, at least {ONE_COMPONENT}"
        if np.isfinite(bound_m) and shape_m > MOST_TIMES_BOUND * bound_m:
            yield f"{calibrate}: RMSE of the shape {shape_m / bound_m:.2f} times the bound, at most {MOST_TIMES_BOUND}"
        if not HONEST_NEES[0] <= nees <= HONEST_NEES[1]:
            yield f"{calibrate}: NEES {nees:.2f}, between {HONEST_NEES[0]} and {HONEST_NEES[1]}"
        if false > MOST_FALSE_NAMES:
            yield f"{calibrate}: {false:.3f} good tags named a map, at most {MOST_FALSE_NAMES}"
        if n_found < LEAST_FOUND * n_changed:
            yield f"{calibrate}: {n_found} of {n_changed} changed tags named, at least {LEAST_FOUND:.0%}"
    if {"auto", "off"} <= rmse.keys() and rmse["auto"] > MOST_OF_OFF * rmse["off"]:
        yield f"auto: RMSE {rmse['auto'] / rmse['off']:.2f} of off's, at most {MOST_OF_OFF}"


def main(arguments: Sequence[str] | None = None) -> int:
    """The script: 0 where every bound holds, else 1."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--world", default="nsh", help="[nsh]")
    parser.add_argument("--seeds", type=seeds_of, default="0-199", help="FIRST-LAST or one seed [0-199]")
    parser.add_argument("--harsh", type=harsh_switches, default="all", help="switches, with commas [all]")
    parser.add_argument("--calibrate", default="auto", help="ways to map, with commas [auto]")
    parser.add_argument("--tag-positions", action="store_true", help="ranges and bearings instead of corners")
    parser.add_argument("--changes", action="store_true", help="move a tag and swap two after the first drive")
    parser.add_argument("--jobs", type=int, default=1, help="seeds at a time [1]")
    given = parser.parse_args(arguments)
    one = partial(
        study_seed,
        world=given.world,
        harsh=given.harsh,
        calibrate=given.calibrate.split(","),
        tag_positions=given.tag_positions,
        changes=given.changes,
    )
    rows: list[Row] = []
    with ProcessPoolExecutor(given.jobs, mp_context=get_context("spawn")) as pool:
        for found in pool.map(one, given.seeds):
            rows += found
            for row in found:
                say(str(row))
    return exit_code(list(broken_bounds(rows)))


if __name__ == "__main__":
    sys.exit(main())
