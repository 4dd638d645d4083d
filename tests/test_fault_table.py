"""Every fault of the table in the docs has a test that is named after it."""

import re
from pathlib import Path

from tests.benchmarks.fault_table import PAGE, row_of, rows_of, with_results

TABLE = """
| row | fault | what must happen | test | result |
|---|---|---|---|---|
| 1b | power cut | nothing wrong | old | old |
| 7 | footer gone | every message | | |
"""


def test_each_row_has_a_test_and_each_test_a_row() -> None:
    tests = "\n".join(path.read_text(encoding="utf-8") for path in Path(__file__).parent.glob("test_*.py"))
    tested = {row_of(name) for name in re.findall(r"^ *def (test_row_\w+)", tests, flags=re.MULTILINE)}
    rows = rows_of(PAGE.read_text(encoding="utf-8"))
    assert len(rows) == len(set(rows)) == 45
    assert tested == set(rows)


def test_results_are_written_into_their_rows() -> None:
    assert rows_of(TABLE) == ["1b", "7"]
    assert row_of("tests/test_a.py::test_row_01b_cut[3]") == "1b"
    results = {"1b": {"tests/test_a.py::test_row_01b_cut": ["passed", "failed"]}}
    lines = with_results(TABLE, results).splitlines()
    assert lines[-2] == "| 1b | power cut | nothing wrong | `test_a test_row_01b_cut` | failed (2 forms) |"
    assert lines[-1] == "| 7 | footer gone | every message | none | missing |"
