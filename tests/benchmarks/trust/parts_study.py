"""Maps of parts of real recordings: the sets of MRCLAM whole, thinned, and cut by time into equal parts.

    python -m tests.benchmarks.trust.parts_study [--data ../shared/data] [--parts 1,2,3] [--keep 1,10] [--jobs 2]

The same landmarks and robots, but other ways, other noise, other mistakes: more recordings than there are. Of each set
the drives of a part are imported and mapped together without options. A row each: components, tags, RMS of the
landmarks after rotation and translation and with scale too, NEES of tags, factor on the sigmas, tags named.
Exit 1 where a map has more than one component, names a tag, or the mean NEES is not between 0.7 and 1.4.
"""

import argparse
import csv
import sys
import tempfile
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from itertools import product
from multiprocessing import get_context
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from groundsbot.offline.importing.csv.importer import import_folder
from groundsbot.offline.importing.robot import ImportOptions
from groundsbot.offline.mapping.inputs import read_runs
from groundsbot.offline.mapping.pipeline import build_map
from groundsbot.offline.outliers.kinds import PHANTOM
from groundsbot.onboard.log.reading.reader import find_logs
from tests.benchmarks.command_line import exit_code, say
from tests.benchmarks.trust.ablation_study import landmarks_rms_m

SETS: Final = ("ds2", "ds4", "ds9")
HONEST_MEAN_NEES: Final = (0.7, 1.4)


class Case(NamedTuple):
    """Part `part` of `n_parts` of a set, each `keep`-th of its observations."""

    name: str
    n_parts: int
    part: int
    keep: int

    def __str__(self) -> str:
        thinned = "" if self.keep == 1 else f", each {self.keep}th observation"
        return f"{self.name} part {self.part + 1} of {self.n_parts}{thinned}"


class Row(NamedTuple):
    """What one map is like."""

    case: Case
    n_components: int
    n_tags: int
    rms_m: float
    nees: float
    sigma_factor: float
    named: tuple[str, ...]

    def __str__(self) -> str:
        return (
            f"{self.case}: {self.n_components} components, {self.n_tags} tags, RMS {self.rms_m:.3f} m, NEES "
            f"{self.nees:.2f}, sigmas times {self.sigma_factor:.2f}, named: {', '.join(self.named) or 'none'}"
        )


def _cut(source: Path, target: Path, case: Case) -> None:
    """Write the part of a drive's CSV files; times are shared out by the odometry's."""
    target.mkdir(parents=True)
    tables = {name: list(csv.reader((source / name).open())) for name in ("odometry.csv", "observations.csv")}
    first_s, last_s = (float(tables["odometry.csv"][row][0]) for row in (1, -1))
    begin_s, end_s = (first_s + (last_s - first_s) * (case.part + i) / case.n_parts for i in (0, 1))
    for name, (head, *rows) in tables.items():
        kept = [row for row in rows if begin_s <= float(row[0]) <= end_s]
        with (target / name).open("w", newline="") as file:
            csv.writer(file).writerows([head, *(kept[:: case.keep] if name == "observations.csv" else kept)])


def study(case: Case, data: Path) -> Row:
    """Import and map one case."""
    source = data / "mrclam" / case.name
    with tempfile.TemporaryDirectory() as folder:
        for drive in sorted(each for each in source.iterdir() if each.is_dir()):
            part = Path(folder) / "parts" / drive.name
            _cut(drive, part, case)
            import_folder(part, Path(folder) / "logs", ImportOptions())
        result = build_map(read_runs(find_logs([Path(folder) / "logs"])))
    rms_m, nees = landmarks_rms_m(result, source / "survey.csv")
    factor = max(each.sigma_factor for each in result.components)
    named = tuple(f"{each.tag_id} {each.kind}" for each in result.outliers if each.kind != PHANTOM)
    n_tags = sum(len(each.tags) for each in result.components)
    return Row(case, len(result.components), n_tags, rms_m, nees, factor, named)


def main(arguments: Sequence[str] | None = None) -> int:
    """The study as a program; returns its exit code."""
    parser = argparse.ArgumentParser(description="Maps of parts of real recordings.")
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--parts", default="1,2,3", help="into how many parts to cut [1,2,3]")
    parser.add_argument("--keep", default="1,10", help="each which observation; other than 1 of whole sets only [1,10]")
    parser.add_argument("--jobs", type=int, default=1, help="maps at a time [1]")
    options = parser.parse_args(arguments)
    cases = [
        Case(name, n, part, keep)
        for name, n, keep in product(SETS, map(int, options.parts.split(",")), map(int, options.keep.split(",")))
        for part in range(n)
        if keep == 1 or n == 1
    ]
    with ProcessPoolExecutor(options.jobs, get_context("spawn")) as pool:
        rows = []
        for row in pool.map(partial(study, data=options.data), cases):
            rows.append(row)
            say(str(row))
    nees = float(np.mean([row.nees for row in rows]))
    say(f"{len(rows)} maps: mean NEES {nees:.2f}")
    low, high = HONEST_MEAN_NEES
    missed = [f"{row.case}: {row.n_components} components" for row in rows if row.n_components > 1]
    missed += [f"{row.case}: named {', '.join(row.named)}" for row in rows if row.named]
    missed += [f"mean NEES {nees:.2f}, between {low} and {high}"] if not low <= nees <= high else []
    return exit_code(missed)


if __name__ == "__main__":
    sys.exit(main())
