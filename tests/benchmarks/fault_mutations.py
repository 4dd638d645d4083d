"""Takes out what protects from each fault, one after the other, and sees that a test of that fault's row fails.

    python -m tests.benchmarks.fault_mutations [--row ROW ...]

Each protection is a few lines of the program, put out of order in a copy of it. Writes the last column of the table in
docs/faults.md for the rows that were run. Ends with exit code 1 if a test still passes without its protection.
"""

import argparse
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections import defaultdict
from contextlib import suppress
from pathlib import Path
from typing import Final

from tests.benchmarks.fault_table import PAGE, ROOT, row_of, rows_of, with_proofs
from tests.protections import PROTECTIONS, Protection

_LIMIT_S: Final = 600.0  # without its protection a recorder may hang; that is a failure too
_FAILED: Final = 1  # pytest's word for it; others are of tests that could not be run
_COPIED: Final = ("calib", "fixtures", "offline", "onboard", "tests", "docs", "pyproject.toml")


def main() -> int:
    """Takes out, runs, tells."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--row", action="append", help="repeatable; all of them unless given")
    wanted = parser.parse_args().row
    proofs: defaultdict[str, list[str]] = defaultdict(list)
    n_green = 0
    with tempfile.TemporaryDirectory() as name:
        copy = Path(name)
        _copy(copy)
        for each in PROTECTIONS:
            if wanted and each.row not in wanted:
                continue
            fails = fails_without(each, copy)
            n_green += not fails
            proofs[each.row].append(f"{each.what}: {'fails' if fails else 'STILL PASSES'}")
            sys.stdout.write(f"row {each.row:3} {proofs[each.row][-1]}\n")
            sys.stdout.flush()
    page = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(with_proofs(page, proofs), encoding="utf-8")
    return int(n_green > 0 or (not wanted and set(rows_of(page)) != set(proofs)))


def fails_without(protection: Protection, copy: Path) -> bool:
    """Whether a test of the row fails in a copy of the program from which its protection is taken out meanwhile."""
    file = copy / protection.file
    whole = file.read_bytes()
    file.write_text(protection.taken_out_of(whole.decode()), encoding="utf-8")
    try:
        return _pytest(copy, protection) == _FAILED
    finally:
        file.write_bytes(whole)


def _copy(copy: Path) -> None:
    for name in _COPIED:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, copy / name, ignore=shutil.ignore_patterns("solver-*"))
        else:
            shutil.copy2(ROOT / name, copy / name)


def _tests_of(row: str) -> list[str]:
    """The files that hold tests of a row."""
    return [
        str(path.relative_to(ROOT))
        for path in sorted((ROOT / "tests").glob("test_*.py"))
        if any(row_of(line) == row for line in path.read_text(encoding="utf-8").splitlines() if "def test_row" in line)
    ]


def _pytest(copy: Path, protection: Protection) -> int:
    """What pytest says of the tests, ended by the first that fails; one that never ends has failed."""
    row = protection.row
    name = f"test_row_{row.rstrip('b'):0>2}{'b' * row.endswith('b')}_ and {protection.test or 'test'}"
    process = subprocess.Popen(
        [sys.executable, "-m", "pytest", "-q", "-n0", "-x", "-p", "no:cacheprovider", "-k", name, *_tests_of(row)],
        cwd=copy,
        env={**os.environ, "PYTHONPATH": str(copy)},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    try:
        return process.wait(_LIMIT_S)
    except subprocess.TimeoutExpired:
        return _FAILED
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


if __name__ == "__main__":
    sys.exit(main())
