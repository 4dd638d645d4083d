"""Takes out what protects from each fault, one after the other, and sees that a test of that fault's row fails.

    python -m tests.benchmarks.faults.mutations [--row ROW ...]

Each protection is a few lines of the program, put out of order in a copy of it. A test that fails then proves something
only if it passes while nothing is taken out: so each is run once in the whole copy first, and one that fails there is
reported as red without mutation. Writes the last column of the table in docs/faults.md for the rows that were run. Ends
with exit code 1 if a test still passes without its protection, or fails with it.
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

from tests.benchmarks.faults.table import PAGE, row_of, rows_of, with_proofs
from tests.support.paths import ROOT
from tests.support.protections import PROTECTIONS, Protection

_LIMIT_S: Final = 600.0  # without its protection a recorder may hang; that is a failure too
_PASSED, _FAILED = 0, 1  # pytest's words for it; others are of tests that could not be run
_FAILS: Final = "fails"
_STILL_PASSES: Final = "STILL PASSES"
_RED_BEFORE: Final = "RED WITHOUT MUTATION"
_COPIED: Final = ("groundsbot", "calib", "fixtures", "offline", "onboard", "tests", "docs", "pyproject.toml")


def main() -> int:
    """Takes a protection out, runs its tests, and returns the result."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--row", action="append", help="repeatable; all of them unless given")
    wanted = parser.parse_args().row
    proofs: defaultdict[str, list[str]] = defaultdict(list)
    green: dict[tuple[str, str], bool] = {}
    n_unproven = 0
    with tempfile.TemporaryDirectory() as name:
        copy = Path(name)
        _copy(copy)
        for each in PROTECTIONS:
            if wanted and each.row not in wanted:
                continue
            found = verdict(each, copy, green)
            n_unproven += found != _FAILS
            proofs[each.row].append(f"{each.what}: {found}")
            sys.stdout.write(f"row {each.row:3} {proofs[each.row][-1]}\n")
            sys.stdout.flush()
    page = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(with_proofs(page, proofs), encoding="utf-8")
    return int(n_unproven > 0 or (not wanted and set(rows_of(page)) != set(proofs)))


def verdict(protection: Protection, copy: Path, green: dict[tuple[str, str], bool]) -> str:
    """What the tests of a row say of its protection.

    Args:
        protection: what is taken out.
        copy: of the program, whole.
        green: whether tests pass in the whole copy, by row and word of their names; what is not known yet is found out.
    """
    tests = protection.row, protection.test
    if tests not in green:
        green[tests] = _pytest(copy, *tests) == _PASSED
    if not green[tests]:
        return _RED_BEFORE
    file = copy / protection.file
    whole = file.read_bytes()
    file.write_text(protection.take_out_of(whole.decode()), encoding="utf-8")
    try:
        return _FAILS if _pytest(copy, *tests) == _FAILED else _STILL_PASSES
    finally:
        file.write_bytes(whole)


def _copy(copy: Path) -> None:
    for name in _COPIED:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, copy / name, symlinks=True, ignore=shutil.ignore_patterns("solver-*"))
        else:
            shutil.copy2(ROOT / name, copy / name)


def _tests_of(row: str, copy: Path) -> list[str]:
    """The files that hold tests of a row."""
    return [
        str(path.relative_to(copy))
        for path in sorted((copy / "tests").rglob("test_*.py"))
        if any(row_of(line) == row for line in path.read_text(encoding="utf-8").splitlines() if "def test_row" in line)
    ]


def _pytest(copy: Path, row: str, test: str) -> int:
    """What pytest says of a row's tests that have a word in their names, ended by the first that fails.

    One that never ends has failed.
    """
    name = f"test_row_{row.rstrip('b'):0>2}{'b' * row.endswith('b')}_ and {test or 'test'}"
    command = [sys.executable, "-m", "pytest", "-q", "-n0", "-x", "-p", "no:cacheprovider", "-k", name]
    process = subprocess.Popen(
        [*command, *_tests_of(row, copy)],
        cwd=copy,
        # A mutation of the same size within the same second would be hidden by bytecode of the source before.
        env={**os.environ, "PYTHONPATH": str(copy), "PYTHONDONTWRITEBYTECODE": "1"},
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
