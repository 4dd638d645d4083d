"""What a gyro does for maps of simulated drives.

    python -m tests.benchmarks.accuracy.gyro_study --world nsh --seeds 0-19 [--gyro none,good,restless,gaps]

Drives without pictures, calibration drawn from its priors; the gyro is like an ICM-20948, `restless` walks ten times as
much, `gaps` misses 2 s twice a run. A row a map; then medians and mean NEES of each gyro.
"""

import argparse
import sys
from collections.abc import Sequence
from typing import Final

import numpy as np

from groundsbot.offline.evaluation.against_truth import evaluate
from groundsbot.offline.mapping.pipeline import build_map
from tests.benchmarks.command_line import say, seeds_of
from tests.support.data.gyros import SimulatedGyro, gyro_runs

GYROS: Final = {
    "none": None,
    "good": SimulatedGyro(),
    "restless": SimulatedGyro(times_walk=10.0),
    "gaps": SimulatedGyro(n_gaps=2),
}
_FIGURES: Final = ("tags as they stand", "tags aligned", "start vector", "tags NEES", "start NEES")


def study(world: str, seed: int, name: str) -> list[float]:
    """The figures of one map."""
    runs, truth = gyro_runs(world, seed, GYROS[name])
    errors = evaluate(build_map(runs), truth).components[0]
    start_m = errors.starts[0].vector_error_m if errors.starts else np.nan
    figures = [
        errors.tags_rmse_m, errors.tags_rmse_aligned_m, start_m, errors.nees_tags_per_dim, errors.nees_start_per_dim
    ]  # fmt: skip
    return [np.nan if each is None else float(each) for each in figures]


def main(arguments: Sequence[str] | None = None) -> int:
    """The script."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--world", default="nsh")
    parser.add_argument("--seeds", type=seeds_of, default="0-19", help="FIRST-LAST or one seed [0-19]")
    parser.add_argument("--gyro", default="none,good", help=f"of {','.join(GYROS)} [none,good]")
    given = parser.parse_args(arguments)
    for name in given.gyro.split(","):
        rows = []
        for seed in given.seeds:
            rows.append(study(given.world, seed, name))
            say(f"{given.world} {name} seed {seed}: " + ", ".join(f"{v:.3f}" for v in rows[-1]))
        table = np.array(rows)
        say(
            f"{given.world} {name}, {len(rows)} seeds, medians: "
            + ", ".join(f"{what} {v:.3f} m" for what, v in zip(_FIGURES[:3], np.nanmedian(table, axis=0), strict=False))
            + "; means: "
            + ", ".join(
                f"{what} {v:.2f}" for what, v in zip(_FIGURES[3:], np.nanmean(table[:, 3:], axis=0), strict=True)
            )
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
