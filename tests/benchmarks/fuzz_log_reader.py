"""Fuzzes the log reader, guided by coverage; a slow search for whole chunks says what is right.

    python -m tests.benchmarks.fuzz_log_reader [--minutes 10] [--seed 1]

Ends with exit code 1 and the input in build/fuzz where something is wrong.
"""

import argparse
import sys
from pathlib import Path

from tests.guided_fuzz import fuzz
from tests.log_reader_fuzz import LONGEST_BYTES, MODULES, MUTATIONS, check, seeds


def main() -> int:
    """Fuzzes for as long as asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    done = fuzz(
        check,
        seeds(),
        MODULES,
        seed=arguments.seed,
        seconds=60.0 * arguments.minutes,
        mutations=MUTATIONS,
        findings_folder=Path("build/fuzz"),
        longest=LONGEST_BYTES,
    )
    sys.stdout.write(f"{done.runs} inputs, {len(done.corpus)} kept, {done.edges} steps reached, nothing found\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
