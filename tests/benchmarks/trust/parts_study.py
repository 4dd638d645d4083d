"""Maps of parts of real recordings, judged against bounds: the sets of MRCLAM whole and in 21 parts each.

    python -m tests.benchmarks.trust.parts_study [--data ../shared/data] [--sets ds2,ds4,ds6,ds9] [--cases ...]
        [--jobs 1] [--tape]

The same landmarks and robots, but other ways, other noise, other mistakes: more recordings than there are. Of a set
`ds6` all five robots (`ds6`), ten pairs (`ds6_p12`), halves and thirds in time (`ds6_h0`, `ds6_t0`), single robots
(`ds6_r3`), and each tenth reading (`ds6_k10`), mapped together without options. A row each: components, tags, RMSE of
the landmarks after rotation and translation and with a free scale too, scale with the map's own sigma, NEES per
dimension of the tags in their own datum, tags named (phantoms apart), processor seconds (with the solver's compilation
unless `python -m groundsbot.offline.commands.compilation` was run), exit code and verdict of `map`. `--tape` maps each
case once more with the distance between its two tags that are farthest apart.

Then the bounds, of each set and of all: leave a set out of what a change is made with, and see here what it does to it.
Exit 1 where all together miss one.
"""

import argparse
import csv
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from itertools import combinations
from multiprocessing import get_context
from pathlib import Path
from time import process_time
from typing import Final, NamedTuple

import numpy as np

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.foundation.words import plural
from groundsbot.offline.commands.map_drives import exit_code as exit_code_of_map
from groundsbot.offline.evaluation.survey_file import read_survey
from groundsbot.offline.importing.csv.importer import import_folder
from groundsbot.offline.importing.robot import ImportOptions
from groundsbot.offline.mapping.inputs import read_runs
from groundsbot.offline.mapping.pipeline import build_map
from groundsbot.offline.maps.json_document import map_as_json
from groundsbot.offline.maps.result import Component, MapResult
from groundsbot.offline.measurements.tape import TapeOptions
from groundsbot.offline.outliers.kinds import PHANTOM
from groundsbot.offline.report.verdict import verdict_sentence
from groundsbot.onboard.log.reading.reader import find_logs
from tests.benchmarks.command_line import exit_code, say

SETS: Final = ("ds2", "ds4", "ds6", "ds9")
ROBOTS: Final = (1, 2, 3, 4, 5)
KINDS: Final = ("whole", "pairs", "halves", "thirds", "single", "tenth")
MEDIAN_SHAPE_M: Final = 0.012
WORST_SHAPE_M: Final = 0.04
WORST_SCALE: Final = 0.04
SCALE_SIGMAS: Final = 2.5
SCALE_SHARE: Final = 0.95
MEAN_NEES: Final = (0.7, 1.5)
MEDIAN_NEES: Final = (0.6, 1.4)
MAPS_A_NAMED_TAG: Final = 50
DONE_SHARE: Final = 0.9
TAPE_SIGMA_M: Final = 0.01
WORST_TAPED_M: Final = 0.03

Tables = dict[str, list[list[str]]]  # of a drive's CSV files by name; the header first
Survey = Mapping[int, FloatArray]  # (2,) in m by id


class Case(NamedTuple):
    """Part `part` of `n_parts` of some robots' drives, with each `keep`-th of their observations."""

    name: str
    set_name: str
    kind: str
    robots: tuple[int, ...] = ROBOTS
    n_parts: int = 1
    part: int = 0
    keep: int = 1


class Fit(NamedTuple):
    """A component's landmarks beside the survey; NaN where there are too few.

    Attributes:
        ids: landmarks, and tags: their indices in the component.
        turn: (2, 2) directions of the survey -> map.
        centre_m, true_centre_m: (2,) mean of their positions in the map and by the survey.
        rmse_m: after rotation and translation; free_rmse_m: after scaling too.
        scale: of the map over the survey, minus 1.
        information: (2 n, 2 n) of the tags relative to each other, in axes of the map.
        nees: per dimension, by this information.
    """

    ids: list[int]
    tags: list[int]
    turn: FloatArray = np.eye(2)
    centre_m: FloatArray = np.zeros(2)
    true_centre_m: FloatArray = np.zeros(2)
    rmse_m: float = np.nan
    free_rmse_m: float = np.nan
    scale: float = np.nan
    information: FloatArray = np.zeros((0, 0))
    nees: float = np.nan


class Row(NamedTuple):
    """What one map is like; `failure`: why there is none."""

    case: Case
    is_joinable: bool
    failure: str = ""
    n_components: int = 0
    n_tags: int = 0
    rmse_m: float = np.nan
    free_rmse_m: float = np.nan
    scale: float = np.nan
    scale_sigma: float = np.nan
    nees: float = np.nan
    named: tuple[str, ...] = ()
    seconds: float = np.nan
    exit_code: int = 1
    verdict: str = ""
    taped_rmse_m: float | None = None

    @property
    def scale_sigmas(self) -> float:
        """How far the scale is off."""
        return abs(self.scale) / self.scale_sigma

    @property
    def is_good(self) -> bool:
        """Whether scale and shape are as the map says and good enough."""
        return self.scale_sigmas <= SCALE_SIGMAS and self.free_rmse_m <= WORST_SHAPE_M

    def __str__(self) -> str:
        if self.failure:
            return f"{self.case.name}: no map: {self.failure}"
        apart = "" if self.is_joinable else " (drives share no two tags)"
        taped = "" if self.taped_rmse_m is None else f", taped RMSE {self.taped_rmse_m:.3f} m"
        return (
            f"{self.case.name}: {plural(self.n_components, 'component')}{apart}, {self.n_tags} tags, RMSE "
            f"{self.rmse_m:.3f} m, free scale {self.free_rmse_m:.4f} m, scale {100.0 * self.scale:+.2f} % (sigma "
            f"{100.0 * self.scale_sigma:.2f} %, {self.scale_sigmas:.1f} sigmas), NEES {self.nees:.2f}, named: "
            f"{', '.join(self.named) or 'none'}{taped}, {self.seconds:.0f} s, exit {self.exit_code}: {self.verdict}"
        )


def cases_of(set_name: str) -> list[Case]:
    """All 22 of a set."""
    return [
        Case(set_name, set_name, "whole"),
        *(Case(f"{set_name}_p{a}{b}", set_name, "pairs", (a, b)) for a, b in combinations(ROBOTS, 2)),
        *(Case(f"{set_name}_h{i}", set_name, "halves", n_parts=2, part=i) for i in range(2)),
        *(Case(f"{set_name}_t{i}", set_name, "thirds", n_parts=3, part=i) for i in range(3)),
        *(Case(f"{set_name}_r{a}", set_name, "single", (a,)) for a in ROBOTS),
        Case(f"{set_name}_k10", set_name, "tenth", keep=10),
    ]


def read_drives(case: Case, data: Path) -> dict[str, Tables]:
    """The case's part of each robot's CSV files; times are shared out by the odometry's."""
    drives = {}
    for robot in case.robots:
        folder = data / "mrclam" / case.set_name / f"robot{robot}"
        tables = {name: list(csv.reader((folder / name).open())) for name in ("odometry.csv", "observations.csv")}
        first_s, last_s = (float(tables["odometry.csv"][row][0]) for row in (1, -1))
        begin_s, end_s = (first_s + (last_s - first_s) * (case.part + i) / case.n_parts for i in (0, 1))
        for name, (head, *rows) in tables.items():
            kept = [row for row in rows if begin_s <= float(row[0]) <= end_s]
            tables[name] = [head, *(kept[:: case.keep] if name == "observations.csv" else kept)]
        drives[folder.name] = tables
    return drives


def import_drives(drives: Mapping[str, Tables], folder: Path) -> list[Path]:
    """The logs of drives, written into a folder and imported there without options."""
    for name, tables in drives.items():
        source = folder / "drives" / name
        source.mkdir(parents=True)
        for file_name, rows in tables.items():
            with (source / file_name).open("w", newline="") as file:
                csv.writer(file).writerows(rows)
        import_folder(source, folder / "logs", ImportOptions())
    return list(find_logs([folder / "logs"]))


def map_drives(drives: Mapping[str, Tables]) -> MapResult:
    """The map of drives, without options."""
    with tempfile.TemporaryDirectory() as folder:
        return build_map(read_runs(import_drives(drives, Path(folder))))


def survey_of(set_name: str, data: Path) -> Survey:
    """The landmarks' positions."""
    entries = read_survey(data / "mrclam" / set_name / "survey.csv")
    return {entry.tag_id: entry.position_m for entry in entries}


def are_joinable(drives: Mapping[str, Tables]) -> bool:
    """Whether drives that share two tags or more, as by their readings, connect all of them."""
    apart = [{row[1] for row in tables["observations.csv"][1:]} for tables in drives.values()]
    joined, apart = [apart[0]], apart[1:]
    while near := [ids for ids in apart if any(len(ids & other) >= 2 for other in joined)]:
        joined += near
        apart = [ids for ids in apart if ids not in near]
    return not apart


def fit_survey(component: Component, survey: Survey) -> Fit:
    """A component against the survey; of an id in several places, the place with the most observations counts."""
    main: dict[int, int] = {}
    for i, tag in enumerate(component.tags):
        best = main.get(tag.tag_id)
        if tag.tag_id in survey and (best is None or tag.n_observations > component.tags[best].n_observations):
            main[tag.tag_id] = i
    ids, tags = list(main), list(main.values())
    if len(ids) < 2:
        return Fit([], [])
    found, true = np.array([component.tags[i].position_m for i in tags]), np.array([survey[each] for each in ids])
    centre_m, true_centre_m = found.mean(axis=0), true.mean(axis=0)
    found, true = found - centre_m, true - true_centre_m
    U, _, V = np.linalg.svd(found.T @ true)
    turn = U @ np.diag([1.0, np.sign(np.linalg.det(U @ V))]) @ V
    turned = true @ turn.T
    scale = float((found * turned).sum() / (turned**2).sum())
    rms_m, free_rms_m = (float(np.sqrt(((found - k * turned) ** 2).sum(axis=1).mean())) for k in (1.0, scale))
    rows = (2 * np.array(tags)[:, None] + np.arange(2)).reshape(-1)
    covariance = component.tag_covariance[np.ix_(rows, rows)]
    information, off_m = shape_information(found, covariance), (found - turned).reshape(-1)
    nees = float(off_m @ information @ off_m) / float(np.trace(information @ covariance))
    return Fit(ids, tags, turn, centre_m, true_centre_m, rms_m, free_rms_m, scale - 1.0, information, nees)


def shape_information(places_m: FloatArray, covariance: FloatArray) -> FloatArray:
    """Information (2 n, 2 n) of positions (n, 2) relative to each other: of their covariance in their own datum.

    Its product with the covariance has the rank as its trace. NaN where the covariance is unknown.
    """
    if not np.isfinite(covariance).all():
        return np.full_like(covariance, np.nan)
    away = places_m - places_m.mean(axis=0)
    turned = np.stack([-away[:, 1], away[:, 0]], axis=-1).reshape(-1)
    common = np.column_stack([np.tile(np.eye(2), (len(away), 1)), turned])
    basis = np.linalg.qr(common, mode="complete")[0][:, 3:]
    return np.asarray(basis @ np.linalg.pinv(basis.T @ covariance @ basis, hermitian=True) @ basis.T)


def named_tags(result: MapResult) -> tuple[str, ...]:
    """Tags that the map says something is wrong with."""
    return tuple(f"{each.tag_id} {each.kind}" for each in result.outliers if each.kind != PHANTOM)


def taped_rmse_m(logs: Sequence[Path], result: MapResult, survey: Survey) -> float:
    """RMSE after rotation and translation with one distance measured, of the map's two tags farthest apart."""
    ids = fit_survey(result.components[0], survey).ids
    length_m, a, b = max((float(np.linalg.norm(survey[a] - survey[b])), a, b) for a, b in combinations(ids, 2))
    tape = TapeOptions(distances=[f"{a},{b}={length_m:.4f},{TAPE_SIGMA_M}"])
    return fit_survey(build_map(read_runs(logs), tape=tape).components[0], survey).rmse_m


def study(case: Case, data: Path, *, tape: bool) -> Row:
    """Import and map one case."""
    drives, survey = read_drives(case, data), survey_of(case.set_name, data)
    row = Row(case, are_joinable(drives))
    try:
        with tempfile.TemporaryDirectory() as folder:
            return _row_of_map(row, import_drives(drives, Path(folder)), survey, tape=tape)
    except Exception as error:  # the other maps of a study of hours are wanted all the same
        return row._replace(failure=f"{type(error).__name__}: {error}")


def _row_of_map(row: Row, logs: Sequence[Path], survey: Survey, *, tape: bool) -> Row:
    begin_s = process_time()
    result = build_map(read_runs(logs))
    seconds = process_time() - begin_s
    fit = fit_survey(result.components[0], survey)
    return row._replace(
        n_components=len(result.components),
        n_tags=len(result.tags),
        rmse_m=fit.rmse_m,
        free_rmse_m=fit.free_rmse_m,
        scale=fit.scale,
        scale_sigma=result.scale_budgets[0].sigma,
        nees=fit.nees,
        named=named_tags(result),
        seconds=seconds,
        exit_code=exit_code_of_map(result),
        verdict=verdict_sentence(map_as_json(result)),
        taped_rmse_m=taped_rmse_m(logs, result, survey) if tape else None,
    )


def figures(rows: Sequence[Row]) -> str:
    """What several maps are like together."""
    found = [row for row in rows if not row.failure]
    if not found:
        return "no maps"
    shapes, nees, off = [r.free_rmse_m for r in found], [r.nees for r in found], [abs(r.scale) for r in found]
    good, poor = ([r for r in found if r.is_good is is_good] for is_good in (True, False))
    taped = [r.taped_rmse_m for r in found if r.taped_rmse_m is not None]
    words = [
        f"free-scale RMSE median {np.median(shapes):.4f} m, worst {max(shapes):.3f}",
        f"RMSE median {np.median([r.rmse_m for r in found]):.3f} m",
        f"scale off by {100.0 * max(off):.2f} % at most, {_share_within(found):.3f} within {SCALE_SIGMAS} sigmas",
        f"NEES mean {np.mean(nees):.2f}, median {np.median(nees):.2f}",
        f"{sum(len(r.named) for r in found)} named",
        f"exit 0 of {sum(r.exit_code == 0 for r in good)} in {len(good)} good maps",
        f"of {sum(r.exit_code == 0 for r in poor)} in {len(poor)} others",
        *([f"taped RMSE median {np.median(taped):.3f} m, worst {max(taped):.3f}"] if taped else []),
        f"{sum(r.seconds for r in found):.0f} s",
    ]
    return f"{plural(len(found), 'map')} of {len(rows)}: {'; '.join(words)}"


def _share_within(rows: Sequence[Row]) -> float:
    return float(np.mean([row.scale_sigmas <= SCALE_SIGMAS for row in rows]))


def missed_bounds(rows: Sequence[Row]) -> Iterator[str]:
    """Each bound that several maps miss, with the maps."""
    yield from (str(row) for row in rows if row.failure)
    found = [row for row in rows if not row.failure]
    if not found:
        return
    yield from _missed_by_single(found)
    shapes, nees = [row.free_rmse_m for row in found], [row.nees for row in found]
    if not np.median(shapes) <= MEDIAN_SHAPE_M:
        yield f"free-scale RMSE median {np.median(shapes):.4f} m, at most {MEDIAN_SHAPE_M}"
    if _share_within(found) < SCALE_SHARE:
        yield f"{_share_within(found):.3f} of scales within {SCALE_SIGMAS} sigmas, at least {SCALE_SHARE}"
    for name, value, (low, high) in (("mean", np.mean(nees), MEAN_NEES), ("median", np.median(nees), MEDIAN_NEES)):
        if not low <= value <= high:
            yield f"{name} NEES {value:.2f}, between {low} and {high}"
    named = [f"{row.case.name}: {each}" for row in found for each in row.named]
    if len(named) > max(1.0, len(found) / MAPS_A_NAMED_TAG):
        yield f"{plural(len(named), 'good tag')} named, at most one in {MAPS_A_NAMED_TAG} maps ({', '.join(named)})"
    done = [row.exit_code == 0 for row in found if row.is_good]
    if done and np.mean(done) < DONE_SHARE:
        yield f"{sum(done)} of {len(done)} good maps with exit code 0, at least {DONE_SHARE:.0%}"


def _missed_by_single(rows: Sequence[Row]) -> Iterator[str]:
    """The bounds that each map has to keep."""
    for row in rows:
        if row.is_joinable and row.n_components > 1:
            yield f"{row.case.name}: {row.n_components} components, though the drives share tags"
        if not row.free_rmse_m <= WORST_SHAPE_M:
            yield f"{row.case.name}: free-scale RMSE {row.free_rmse_m:.3f} m, at most {WORST_SHAPE_M}"
        if not abs(row.scale) <= WORST_SCALE:
            yield f"{row.case.name}: scale off by {row.scale:+.1%}, at most {WORST_SCALE:.0%}"
        if row.exit_code == 0 and not row.is_good:
            yield (
                f"{row.case.name}: exit code 0, though its scale is {row.scale_sigmas:.1f} sigmas off and its shape "
                f"{row.free_rmse_m:.3f} m"
            )
        if row.taped_rmse_m is not None and not row.taped_rmse_m <= WORST_TAPED_M:
            yield f"{row.case.name}: taped RMSE {row.taped_rmse_m:.3f} m, at most {WORST_TAPED_M}"


def _chosen(sets: Sequence[str], wanted: Sequence[str]) -> list[Case]:
    """The cases of some sets that are wanted, by name or by kind.

    Raises:
        ValueError: nothing has one of these names.
    """
    found = [case for name in sets for case in cases_of(name)]
    unknown = set(wanted) - {*KINDS, *(case.name for case in found)}
    if unknown:
        raise ValueError(f"--cases: {', '.join(sorted(unknown))}: neither cases of {', '.join(sets)} nor kinds of them")
    return [case for case in found if not wanted or case.name in wanted or case.kind in wanted]


def main(arguments: Sequence[str] | None = None) -> int:
    """The study as a program; returns its exit code."""
    parser = argparse.ArgumentParser(description="Maps of parts of real recordings.")
    parser.add_argument("--data", type=Path, default=Path("../shared/data"), help="real recordings [../shared/data]")
    parser.add_argument("--sets", default=",".join(SETS), help=f"[{','.join(SETS)}]")
    parser.add_argument("--cases", default=",".join(KINDS), help=f"names as ds6_p12, or kinds [{','.join(KINDS)}]")
    parser.add_argument("--jobs", type=int, default=1, help="maps at a time [1]")
    parser.add_argument("--tape", action="store_true", help="each map once more with one measured distance")
    options = parser.parse_args(arguments)
    try:
        cases = _chosen(options.sets.split(","), options.cases.split(","))
    except ValueError as error:
        parser.error(str(error))
    rows = []
    with ProcessPoolExecutor(options.jobs, get_context("spawn")) as pool:
        for row in pool.map(partial(study, data=options.data, tape=options.tape), cases):
            rows.append(row)
            say(str(row))
    for name in dict.fromkeys(case.set_name for case in cases):
        own = [row for row in rows if row.case.set_name == name]
        say(f"{name}: {figures(own)}")
        for sentence in missed_bounds(own):
            say(f"  {name} misses: {sentence}")
    say(f"all: {figures(rows)}")
    return exit_code([*missed_bounds(rows)])


if __name__ == "__main__":
    sys.exit(main())
