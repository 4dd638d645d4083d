"""Every fault of the table in the docs has a test that is named after it."""

import ast
import re
from pathlib import Path

from tests.benchmarks.faults.mutations import verdict
from tests.benchmarks.faults.table import PAGE, row_of, rows_of, with_proofs, with_results
from tests.support.paths import ROOT
from tests.support.protections import PROTECTIONS, Protection

TABLE = """
| row | fault | what must happen | test | result | taken out |
|---|---|---|---|---|---|
| 1b | power cut | nothing wrong | old | old | a sync: fails |
| 7 | footer gone | every message | | | |
"""

# A program whose row 7 has a test that needs its limit, one that does not, and one that is red anyway.
MADE = """
from pathlib import Path
from program import LIMIT
def test_row_07_bounded():
    Path("ran").open("a").write("bounded ")
    assert LIMIT == 3
def test_row_07_careless():
    Path("ran").open("a").write("careless ")
def test_row_07_red_anyway():
    Path("ran").open("a").write("red ")
    assert LIMIT == 4
"""


def test_each_row_has_a_test_and_each_test_a_row() -> None:
    tests = "\n".join(path.read_text(encoding="utf-8") for path in (ROOT / "tests").rglob("test_*.py"))
    tested = {row_of(name) for name in re.findall(r"^ *def (test_row_\w+)", tests, flags=re.MULTILINE)}
    rows = rows_of(PAGE.read_text(encoding="utf-8"))
    assert len(rows) == len(set(rows)) == 52
    assert tested == set(rows)


def test_results_are_written_into_their_rows() -> None:
    assert rows_of(TABLE) == ["1b", "7"]
    assert row_of("tests/test_a.py::test_row_01b_cut[3]") == "1b"
    results = {"1b": {"tests/test_a.py::test_row_01b_cut": ["passed", "failed"]}}
    lines = with_results(TABLE, results).splitlines()
    assert (
        lines[-2] == "| 1b | power cut | nothing wrong | `test_a test_row_01b_cut` | failed (2 forms) | a sync: fails |"
    )
    assert lines[-1] == "| 7 | footer gone | every message | none | missing |  |"


def test_what_was_taken_out_is_written_into_its_row() -> None:
    lines = with_proofs(TABLE, {"7": ["an index: fails", "a footer: fails"]}).splitlines()
    assert lines[-2] == "| 1b | power cut | nothing wrong | old | old | a sync: fails |"
    assert lines[-1] == "| 7 | footer gone | every message |  |  | an index: fails<br>a footer: fails |"


def test_each_row_has_a_protection_that_can_be_taken_out() -> None:
    assert {each.row for each in PROTECTIONS} == set(rows_of(PAGE.read_text(encoding="utf-8")))
    for each in PROTECTIONS:
        source = (ROOT / each.file).read_text(encoding="utf-8")
        ast.parse(each.take_out_of(source))


def test_what_fails_without_mutation_proves_nothing_and_each_test_is_first_run_once(tmp_path: Path) -> None:
    (tmp_path / "tests").mkdir()
    (tmp_path / "tests" / "test_made.py").write_text(MADE)
    (tmp_path / "program.py").write_text("LIMIT = 3\n")
    green: dict[tuple[str, str], bool] = {}
    found = [
        verdict(Protection("7", "a limit", "program.py", "3", new, test), tmp_path, green)
        for test, new in (("bounded", "4"), ("bounded", "5"), ("careless", "4"), ("red", "4"), ("absent", "4"))
    ]
    red = "RED WITHOUT MUTATION"  # one that could not be run, too
    assert found == ["fails", "fails", "STILL PASSES", red, red]
    assert (tmp_path / "ran").read_text().split() == ["bounded"] * 3 + ["careless"] * 2 + ["red"]
    assert (tmp_path / "program.py").read_text() == "LIMIT = 3\n"
