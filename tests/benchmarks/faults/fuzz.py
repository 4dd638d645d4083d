"""Fuzzes the log reader, or the way from the port's bytes to stamped readings, guided by coverage.

    python -m tests.benchmarks.faults.fuzz log_reader|wheel_lines [--minutes 10] [--seed 1]

A second, slow parser says what is right. Ends with exit code 1 and the input in build/fuzz where something is wrong.
"""

import argparse
import sys
from pathlib import Path

from tests.support import log_reader_fuzz, wheel_line_fuzz
from tests.support.guided_fuzz import fuzz

_TARGETS = {"log_reader": log_reader_fuzz.TARGET, "wheel_lines": wheel_line_fuzz.TARGET}

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("target", choices=_TARGETS)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    done = fuzz(_TARGETS[given.target], given.seed, seconds=60.0 * given.minutes, folder=Path("build/fuzz"))
    sys.stdout.write(f"{done.runs} inputs, {len(done.corpus)} kept, {done.edges} steps reached, nothing found\n")
