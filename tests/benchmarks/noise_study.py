"""Fitted noise parameters against those that drives were simulated with, seed by seed.

    python -m tests.benchmarks.noise_study --world nsh --seeds 0-9 --factor 10

The fit begins at so many times the true sigmas. A row a seed, found by true; then, for each parameter, how often its
99 % interval holds the truth and, where its redundancy is 100 or more, how often it lies within 20 % of it.
"""

import argparse
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib.noise import NoiseParameters
from fixtures.simulate import simulate
from offline.chain import chains_of
from offline.local_map import solve_local_map
from offline.noise_fit import FittedSigma, fit_noise
from offline.run import load_run
from onboard.log_reader import find_logs

ENOUGH_REDUNDANCY = 100.0
CLOSE = 0.2


@dataclass(frozen=True)
class Found:
    """One fitted parameter beside the truth."""

    fitted: FittedSigma
    true: float

    @property
    def ratio(self) -> float:
        """Found by true."""
        return self.fitted.value / self.true

    @property
    def inside(self) -> bool:
        """Whether its own 99 % interval holds the truth."""
        return self.fitted.low < self.true < self.fitted.high


def study_seed(seed: int, world: str | Path, factor: float) -> list[Found]:
    """Simulates drives with the default noise, and fits from so many times that."""
    true = NoiseParameters()
    start = NoiseParameters(**{name: factor * getattr(true, name) for name in NoiseParameters.model_fields})
    with tempfile.TemporaryDirectory() as folder:
        output = Path(folder) / "drives"
        simulate(world, seed, output, render=False)
        runs = [load_run(log) for log in find_logs([output])]
    maps = [solve_local_map(chain) for run in runs for chain in chains_of(run, start)]
    return [Found(each, getattr(true, each.name)) for each in fit_noise(maps, start).sigmas]


def main(arguments: Sequence[str] | None = None) -> int:
    """The script; 0."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--world", default="nsh", help="name or file of a world [nsh]")
    parser.add_argument("--seeds", default="0-9", help="FIRST-LAST [0-9]")
    parser.add_argument("--factor", type=float, default=10.0, help="the fit begins at so many times the truth [10]")
    given = parser.parse_args(arguments)
    first, _, last = given.seeds.partition("-")
    table: dict[str, list[Found]] = {}
    for seed in range(int(first), int(last or first) + 1):
        found = study_seed(seed, given.world, given.factor)
        for each in found:
            table.setdefault(each.fitted.name, []).append(each)
        _tell(f"seed {seed:4d}  " + "  ".join(f"{each.ratio:7.3f}" for each in found))
    for name, rows in table.items():
        close = [abs(row.ratio - 1.0) <= CLOSE for row in rows if row.fitted.redundancy >= ENOUGH_REDUNDANCY]
        _tell(
            f"{name:32s} median ratio {np.median([row.ratio for row in rows]):6.3f}  "
            f"inside its interval {np.mean([row.inside for row in rows]):6.1%}  "
            f"within 20 % where redundant {np.mean(close) if close else np.nan:6.1%} of {len(close)}"
        )
    return 0


def _tell(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
