"""Maps of robots that are not differential drives: mecanum, swerve, Ackermann.

    python -m tests.benchmarks.accuracy.drive_study --seeds 0-19 [--drives mecanum,swerve,ackermann]

Each drives 150 s over a field of 16 x 8 m with 24 tags, imported without options but the wheelbase. A row a map: RMSE
of the tags turned and moved onto the truth, and their NEES; then median and mean. Exit 1 where the mean NEES of a drive
is not between 0.85 and 1.15.
"""

import argparse
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Final, get_args

import numpy as np

from groundsbot.offline.evaluation.against_truth import evaluate
from groundsbot.offline.evaluation.truth import TrueRun, Truth
from groundsbot.offline.importing.csv.importer import import_folder
from groundsbot.offline.importing.robot import ImportOptions
from groundsbot.offline.mapping.inputs import read_runs
from groundsbot.offline.mapping.pipeline import build_map
from groundsbot.onboard.log.reading.reader import find_logs
from tests.benchmarks.command_line import exit_code, say, seeds_of
from tests.support.data.any_drive import DRIVES, WHEELBASE_M, Drive, MadeDrive, make_any_drive, write_csv
from tests.support.data.drives import FAMILY

HONEST_NEES: Final = (0.85, 1.15)


def truth_of(drive: MadeDrive, run: str) -> Truth:
    """Where the robot and the tags were, on the log's clock."""
    stamps_ns = np.rint(drive.time_s * 1e9).astype(np.int64)
    tags = {(FAMILY, i, ""): place_m for i, place_m in enumerate(drive.tags_m)}
    return Truth({run: TrueRun(stamps_ns, drive.T_world_base)}, tags, frozenset())


def study_seed(kind: Drive, seed: int, seconds: float = 150.0) -> tuple[float, float]:
    """RMSE of the tags once aligned, and their NEES per dimension."""
    drive = make_any_drive(kind, seed, seconds)
    steered = kind == "ackermann"
    with tempfile.TemporaryDirectory() as name:
        folder = write_csv(Path(name) / kind, drive, "steering" if steered else "velocities")
        import_folder(folder, Path(name) / "logs", ImportOptions(wheelbase_m=WHEELBASE_M if steered else None))
        result = build_map(read_runs(find_logs([Path(name) / "logs"])))
    errors = evaluate(result, truth_of(drive, result.components[0].runs[0].name)).components[0]
    found = (errors.tags_rmse_aligned_m, errors.nees_tags_per_dim)
    rmse_m, nees = (np.nan if each is None else each for each in found)
    return rmse_m, nees


def main(arguments: Sequence[str] | None = None) -> int:
    """The script."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=seeds_of, default="0-19", help="FIRST-LAST or one seed [0-19]")
    parser.add_argument("--drives", default=",".join(DRIVES), help=f"of {','.join(get_args(Drive))} [all]")
    given = parser.parse_args(arguments)
    missed = []
    for kind in DRIVES:
        if kind not in given.drives.split(","):
            continue
        rows = []
        for seed in given.seeds:
            rows.append(study_seed(kind, seed))
            say(f"{kind} seed {seed}: tags {rows[-1][0]:.3f} m, NEES {rows[-1][1]:.2f}")
        rmse_m, nees = np.array(rows).T
        mean = float(np.nanmean(nees))
        say(f"{kind}, {len(rows)} seeds: tags {np.median(rmse_m):.3f} m (median), NEES {mean:.2f}")
        if not HONEST_NEES[0] <= mean <= HONEST_NEES[1]:
            missed.append(f"{kind}: NEES {mean:.2f}, between {HONEST_NEES[0]} and {HONEST_NEES[1]}")
    return exit_code(missed)


if __name__ == "__main__":
    sys.exit(main())
