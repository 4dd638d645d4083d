"""Runs the tests of the faults and writes their results into the table of docs/faults.md.

    python -m tests.benchmarks.faults.table [--long]

A test belongs to row 7 if its name begins with test_row_07. Rows and faults are written by hand, in the page, and the
last column by tests.benchmarks.faults.mutations; --long runs the full forms of shortened tests too. Ends with exit code
1 if a row has no test or one that does not pass.
"""

import argparse
import os
import re
import sys
from collections import defaultdict
from collections.abc import Mapping, Sequence

import pytest

from tests.support.paths import ROOT

PAGE = ROOT / "docs" / "faults.md"
_ROW = re.compile(r"^\| (\d+b?) \| (.*?) \| (.*?) \| (.*?) ?\| (.*?) ?\| (.*?) ?\|$")
_NAME = re.compile(r"test_row_0*(\d+b?)_")

Results = Mapping[str, Mapping[str, Sequence[str]]]  # by row and test: the outcome of each of its forms


class _Recorder:
    """Notes how each test of a row ended."""

    def __init__(self) -> None:
        self.results: defaultdict[str, defaultdict[str, list[str]]] = defaultdict(lambda: defaultdict(list))

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Called by pytest for setup, call and teardown of each test."""
        row = row_of(report.nodeid)
        if row is not None and (report.when == "call" or report.outcome != "passed"):
            test = report.nodeid.split("[")[0]
            self.results[row][test].append(report.outcome)


def row_of(name: str) -> str | None:
    """The row that a test's name names."""
    found = _NAME.search(name)
    return found[1] if found else None


def rows_of(page: str) -> list[str]:
    """The rows of the page's table."""
    return [found[1] for line in page.splitlines() if (found := _ROW.match(line))]


def with_results(page: str, results: Results) -> str:
    """The page with the tests of each row and how they ended."""
    lines = []
    for line in page.splitlines():
        found = _ROW.match(line)
        if found:
            tests = results.get(found[1], {})
            names = "<br>".join(f"`{test.removeprefix('tests/').replace('.py::', ' ')}`" for test in sorted(tests))
            ends = "<br>".join(_lines(tests[test]) for test in sorted(tests))
            line = f"| {' | '.join((*found.groups()[:3], names or 'none', ends or 'missing', found[6]))} |"
        lines.append(line)
    return "\n".join(lines) + "\n"


def with_proofs(page: str, proofs: Mapping[str, Sequence[str]]) -> str:
    """The page with what was taken out of the program for some rows, and what their tests said then."""
    lines = []
    for line in page.splitlines():
        found = _ROW.match(line)
        if found and found[1] in proofs:
            line = f"| {' | '.join((*found.groups()[:5], '<br>'.join(proofs[found[1]])))} |"
        lines.append(line)
    return "\n".join(lines) + "\n"


def _lines(outcomes: Sequence[str]) -> str:
    count = f" ({len(outcomes)} forms)" if len(outcomes) > 1 else ""
    worst = next((each for each in ("failed", "skipped") if each in outcomes), "passed")
    return f"{worst}{count}"


def main() -> int:
    """Runs the tests and rewrites the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--long", action="store_true")
    long = ["--long"] if parser.parse_args().long else []
    recorder = _Recorder()
    os.chdir(ROOT)
    pytest.main(["-q", "-n0", "-k", "test_row_", *long, "tests"], plugins=[recorder])
    page = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(with_results(page, recorder.results), encoding="utf-8")
    ends = [end for tests in recorder.results.values() for outcomes in tests.values() for end in outcomes]
    return int("failed" in ends or set(rows_of(page)) != set(recorder.results))


if __name__ == "__main__":
    sys.exit(main())
