"""Fuzzes the way from the port's bytes to stamped readings, guided by coverage.

    python -m tests.benchmarks.faults.fuzz_wheel_lines [--minutes 10] [--seed 1]

Ends with exit code 1 and the input in build/fuzz where something is wrong.
"""

import sys
from pathlib import Path

from tests.support.guided_fuzz import Findings, fuzz, fuzz_for_minutes
from tests.support.wheel_line_fuzz import MODULES, check, renumber, seal, seeds


def run(seed: int, seconds: float) -> Findings:
    """Fuzzes for so many seconds."""
    return fuzz(
        check,
        seeds(),
        MODULES,
        seed=seed,
        seconds=seconds,
        mutations=(seal, renumber),
        findings_folder=Path("build/fuzz"),
    )


if __name__ == "__main__":
    sys.exit(fuzz_for_minutes(run, __doc__))
