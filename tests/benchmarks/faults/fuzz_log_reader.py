"""Fuzzes the log reader, guided by coverage; a slow search for whole chunks says what is right.

    python -m tests.benchmarks.faults.fuzz_log_reader [--minutes 10] [--seed 1]

Ends with exit code 1 and the input in build/fuzz where something is wrong.
"""

import sys
from pathlib import Path

from tests.support.guided_fuzz import Findings, fuzz, fuzz_for_minutes
from tests.support.log_reader_fuzz import LONGEST_BYTES, MODULES, MUTATIONS, check, seeds


def run(seed: int, seconds: float) -> Findings:
    """Fuzzes for so many seconds."""
    return fuzz(
        check,
        seeds(),
        MODULES,
        seed=seed,
        seconds=seconds,
        mutations=MUTATIONS,
        findings_folder=Path("build/fuzz"),
        longest=LONGEST_BYTES,
    )


if __name__ == "__main__":
    sys.exit(fuzz_for_minutes(run, __doc__))
