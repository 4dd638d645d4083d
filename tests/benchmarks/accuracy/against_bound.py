"""How accurate maps of simulated drives are, method by method, against the Cramer-Rao bound.

    python -m tests.benchmarks.accuracy.against_bound --worlds nsh,nsh_flat,room,nsh_rough --seeds 0-199

Drives without rendering, calibration drawn from the priors of robot.yaml; for methods that are to find the calibration,
from wide ones: radii 2 %, track 3 %, yaw of the mount 1 degree, time offset 20 ms, tag sizes exact. A line a method and
seed, then the table: RMSE over the seeds of the vectors from the first start to the others, of tags and trajectories,
all as the map stands, beside the Cramer-Rao bound of the same seeds, and mean NEES (docs/accuracy.md). The table goes
to `build/benchmarks/accuracy.jsonl` too, null where a method states no covariance. Exit 1 where a promise is missed or
a map came out in parts.
"""

import argparse
import math
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np
from pydantic import BaseModel

from groundsbot.fixtures.simulate import TRUTH_FILE, simulate
from groundsbot.fixtures.worlds.world import World, load_world
from groundsbot.offline.evaluation.truth import Truth, read_truth
from groundsbot.offline.mapping.pipeline import build_map
from groundsbot.offline.maps.result import MapResult
from groundsbot.offline.measurements.run import Run, load_run
from groundsbot.offline.self_calibration.option import Calibrate
from groundsbot.onboard.log.reading.reader import find_logs
from tests.benchmarks.accuracy.accuracy_study import Figures, figures_of
from tests.benchmarks.accuracy.baselines import dead_reckoning, paper_scheme
from tests.benchmarks.accuracy.cramer_rao import Bound
from tests.benchmarks.accuracy.cramer_rao_world import bound_of
from tests.benchmarks.accuracy.from_truth import most_likely_from_truth
from tests.benchmarks.command_line import exit_code, say, seeds_of, write_report

OUTPUT: Final = Path("build/benchmarks/accuracy.jsonl")
# What is found may be off so many times as much as the most likely map, which is looked for from the truth.
MOST_TIMES_LIKELIEST: Final = 1.02
_FOUND, _LIKELIEST = "corners", "corners from the truth"
# At so many times the bound a method's RMSE may lie, and its tags' NEES between these.
HONEST_NEES: Final = (0.85, 1.15)
_SURE: Final = 1e-4

Model = TypeVar("Model", bound=BaseModel)


@dataclass(frozen=True)
class Drives:
    """One seed's drives of one world."""

    world: World
    seed: int
    folder: Path

    @cached_property
    def runs(self) -> list[Run]:
        """What the logs hold."""
        return [load_run(log) for log in find_logs([self.folder])]

    @cached_property
    def truth(self) -> Truth:
        """The true state."""
        return read_truth(self.folder / TRUTH_FILE)

    @cached_property
    def bound(self) -> Bound:
        """The Cramer-Rao bound of the drives."""
        return bound_of(self.world, self.seed, exact_calibration=False)


@dataclass(frozen=True)
class Method:
    """A way from drives to a map.

    `most_times_bound`: its RMSE may be so many times the bound, and its NEES must then be consistent; None: no promise.
    `wide`: tried on drives whose calibration is drawn from wide priors.
    """

    estimate: Callable[[Drives], MapResult]
    most_times_bound: float | None = None
    wide: bool = False


METHODS: Final[dict[str, Method]] = {
    "dead reckoning": Method(lambda drives: dead_reckoning(drives.runs)),
    "paper": Method(lambda drives: paper_scheme(drives.runs)),
    "2D": Method(lambda drives: build_map(drives.runs)),
    "corners": Method(lambda drives: build_map(drives.runs, corners=True), most_times_bound=1.1),
    "corners from the truth": Method(lambda drives: most_likely_from_truth(drives.runs, drives.truth)),
    "corners wide held": Method(lambda drives: build_map([exact(run) for run in drives.runs], corners=True), wide=True),
    "corners wide self-calibrated": Method(
        lambda drives: build_map(drives.runs, corners=True, calibrate=Calibrate(is_on=True)),
        most_times_bound=1.2,
        wide=True,
    ),
}


@dataclass
class Tally:
    """What the seeds of one world gave one method so far."""

    world: str
    method: str
    figures: list[Figures] = field(default_factory=list)
    bounds: list[Bound] = field(default_factory=list)
    in_parts: list[int] = field(default_factory=list)  # seeds

    def row(self) -> dict[str, Any]:
        """As `accuracy.jsonl` has it."""
        return {
            "world": self.world,
            "method": self.method,
            "seeds": len(self.figures),
            "start_to_start_rmse_m": _rms([each.start_rmse_m for each in self.figures]),
            "tags_rmse_m": _rms([each.tags_rmse_m for each in self.figures]),
            "trajectory_rmse_m": _rms([each.trajectory_rmse_m for each in self.figures]),
            "bound_start_to_start_m": _rms([each.start_to_start_m for each in self.bounds]),
            "bound_tags_m": _rms([each.tags_m for each in self.bounds]),
            "nees_tags_per_dim": _mean([each.nees_tags for each in self.figures]),
            "nees_start_per_dim": _mean([each.nees_start for each in self.figures]),
        }

    def broken_bounds(self) -> list[str]:
        """A sentence for each promise that is not kept."""
        who, row, most = f"{self.world}, {self.method}", self.row(), METHODS[self.method].most_times_bound
        found = [f"{who}, seed {seed}: the map is in parts" for seed in self.in_parts]
        if most is None or not self.figures:
            return found
        for what in ("start_to_start", "tags"):
            times = row[f"{what}_rmse_m"] / row[f"bound_{what}_m"]
            if times > most:
                found.append(f"{who}: {what}_rmse_m is {times:.3f} times the bound, at most {most:g} is promised")
        nees = row["nees_tags_per_dim"]
        if nees is None or not HONEST_NEES[0] <= nees <= HONEST_NEES[1]:
            lowest, highest = HONEST_NEES
            found.append(f"{who}: nees_tags_per_dim is {nees}, between {lowest:g} and {highest:g} is promised")
        return found


def broken_pairs(tallies: Sequence[Tally]) -> list[str]:
    """A sentence for each figure of a world that is worse than the most likely map's, over the same seeds."""
    by = {(each.world, each.method): each for each in tallies if each.figures}
    sentences = []
    for (world, method), found in by.items():
        likeliest = by.get((world, _LIKELIEST))
        if method != _FOUND or likeliest is None:
            continue
        seeds = {each.seed for each in found.figures} & {each.seed for each in likeliest.figures}
        for what in ("start", "tags"):
            ours, theirs = (
                _rms([getattr(each, f"{what}_rmse_m") for each in tally.figures if each.seed in seeds])
                for tally in (found, likeliest)
            )
            if ours is not None and theirs is not None and ours > MOST_TIMES_LIKELIEST * theirs:
                sentences.append(
                    f"{world}: {what}_rmse_m is {ours / theirs:.3f} times that of the most likely map, at most "
                    f"{MOST_TIMES_LIKELIEST:g} is promised"
                )
    return sentences


def study_worlds() -> dict[str, World]:
    """The worlds by the names that the table has."""
    worlds = {name: load_world(name) for name in ("nsh", "nsh_flat", "room")}
    return worlds | {"nsh_rough": rough(worlds["nsh"])}


def rough(world: World, tilt_deg: float = 0.3, readout_s: float = 0.02) -> World:
    """On a floor that rolls and pitches the base by this sigma in each picture, with rolling shutters."""
    noise = world.noise.model_copy(update={"sigma_tilt_rad": math.radians(tilt_deg)})
    robots = [each.model_copy(update={"robot": {**each.robot, "readout_s": readout_s}}) for each in world.robots]
    return world.model_copy(update={"name": f"{world.name}_rough", "noise": noise, "robots": robots})


def with_wide_priors(world: World) -> World:
    """Robots whose calibration is open, except for the size of their tags."""

    def widened(robot: dict[str, Any]) -> dict[str, Any]:
        wheels, mount = robot["wheels"], robot.get("mount", {})
        radii = {f"{name}_sigma": 0.02 * wheels[name] for name in ("radius_left_m", "radius_right_m")}
        return {
            **robot,
            "wheels": {**wheels, **radii, "track_m_sigma": 0.03 * wheels["track_m"]},
            "mount": {**mount, "yaw_rad_sigma": math.radians(1.0)},
            "time_offset_s_sigma": 0.02,
            "tags": [{**batch, "sigma_size_m": 1e-9} for batch in robot["tags"]],
        }

    robots = [each.model_copy(update={"robot": widened(each.robot)}) for each in world.robots]
    return world.model_copy(update={"robots": robots})


def exact(run: Run) -> Run:
    """The run of a robot whose file is taken for exact but for a 10,000th of its sigmas."""

    def sure(part: Model) -> Model:
        sigmas = {name: value for name, value in part if name.endswith("_sigma") and value is not None}
        return part.model_copy(update={name: _SURE * value for name, value in sigmas.items()})

    robot = sure(run.robot)
    return replace(run, robot=robot.model_copy(update={"wheels": sure(robot.wheels), "mount": sure(robot.mount)}))


def study_seed(name: str, world: World, seed: int, tallies: Sequence[Tally]) -> None:
    """Simulates one seed, gives it to the method of each tally, and returns the errors."""
    for wide in (False, True):
        chosen = [each for each in tallies if METHODS[each.method].wide is wide]
        if not chosen:
            continue
        drawn_from = with_wide_priors(world) if wide else world
        with tempfile.TemporaryDirectory() as folder:
            drives = Drives(drawn_from, seed, Path(folder) / "drives")
            simulate(drawn_from, seed, drives.folder, render=False)
            for tally in chosen:
                try:
                    figures = figures_of(seed, METHODS[tally.method].estimate(drives), drives.truth)
                except ValueError as error:
                    tally.in_parts.append(seed)
                    say(f"{name}, {tally.method}: {error}")
                    continue
                tally.figures.append(figures)
                tally.bounds.append(drives.bound)
                say(_line(name, tally.method, seed, _numbers(figures, drives.bound)))


def run_study(worlds: dict[str, World], methods: Sequence[str], seeds: Sequence[int], output: Path) -> list[Tally]:
    """All seeds of all worlds; the table in `output` is as far as the study."""
    tallies = [Tally(name, method) for name in worlds for method in methods]
    say(_line("world", "method", "seed", _COLUMNS))
    for seed in seeds:
        for name, world in worlds.items():
            study_seed(name, world, seed, [each for each in tallies if each.world == name])
            write_report(output, [each.row() for each in tallies if each.figures])
    return tallies


def main(arguments: Sequence[str] | None = None) -> int:
    """The script: 0 where every promise is kept, else 1."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", default="nsh,nsh_flat,room,nsh_rough", help="[nsh,nsh_flat,room,nsh_rough]")
    parser.add_argument("--methods", default=",".join(METHODS), help=f"[{','.join(METHODS)}]")
    parser.add_argument("--seeds", type=seeds_of, default="0-199", help="FIRST-LAST or one seed [0-199]")
    parser.add_argument("--output", type=Path, default=OUTPUT, help=f"[{OUTPUT}]")
    given = parser.parse_args(arguments)
    known = study_worlds()
    worlds = {name: known[name] for name in given.worlds.split(",")}
    tallies = run_study(worlds, given.methods.split(","), given.seeds, given.output)
    say("")
    say(_line("world", "method", "seeds", _COLUMNS))
    for each in tallies:
        row = each.row()
        say(_line(each.world, each.method, row["seeds"], list(row.values())[3:]))
    return exit_code([sentence for each in tallies for sentence in each.broken_bounds()] + broken_pairs(tallies))


_COLUMNS: Final = ("start m", "tags m", "path m", "bound: start", "tags", "NEES: tags", "start")


def _numbers(figures: Figures, bound: Bound) -> list[float]:
    found = [figures.start_rmse_m, figures.tags_rmse_m, figures.trajectory_rmse_m]
    return [*found, bound.start_to_start_m, bound.tags_m, figures.nees_tags, figures.nees_start]


def _line(world: str, method: str, seed: object, values: Sequence[object]) -> str:
    told = [f"{each:12.3f}" if isinstance(each, float) else f"{'-' if each is None else each:>12}" for each in values]
    return f"{world:10s} {method:32s} {seed:>5} " + " ".join(told)


def _rms(values: Sequence[float]) -> float | None:
    return float(np.sqrt(np.mean(np.square(values)))) if values else None


def _mean(values: Sequence[float]) -> float | None:
    """None where nothing is stated."""
    return float(np.mean(values)) if values and np.isfinite(values).all() else None


if __name__ == "__main__":
    sys.exit(main())
