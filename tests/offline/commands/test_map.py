"""`map` as a person meets it: what it says, and what it leaves behind."""

import json
from dataclasses import replace
from html import unescape
from importlib.util import find_spec
from pathlib import Path

import pytest

from groundsbot.offline.commands.map_drives import summary
from groundsbot.offline.maps.files import read_map
from groundsbot.offline.maps.result import MapResult
from tests.support.data.drives import make_robot, write_drive
from tests.support.data.map_cases import DRIVES, TAGS
from tests.support.data.maps import make_component, make_map
from tests.support.programs import Run


def test_two_logs_become_one_map_and_are_left_alone(map_to: Run, logs: dict[str, Path], tmp_path: Path) -> None:
    recorded = {path: path.read_bytes() for path in (tmp_path / "logs").rglob("*.mcap")}
    outcome = map_to(logs["a"], logs["b"])
    assert (outcome.code, outcome.err) == (0, "")
    assert {path: path.read_bytes() for path in (tmp_path / "logs").rglob("*") if path.is_file()} == recorded
    for part in (
        "a_one: ",
        "Tags are known to ",
        " relative to each other",
        "start of a_one to start of b_one: 1.118 m",
        "4 tags in one map",
    ):
        assert part in outcome.out
    names = {path.name for path in (tmp_path / "out").iterdir()}
    report = {"report.html"} if find_spec("plotly") else set()
    files = {"map.json", "map.npz", "tags.csv", "map.png", "map.mcap", "a_one.tum", "b_one.tum"}
    assert names == files | report
    assert [tag.tag_id for tag in read_map(tmp_path / "out").components[0].tags] == [0, 1, 2, 3]


def test_the_frame_may_be_the_tags_own(run: Run, map_to: Run, logs: dict[str, Path], tmp_path: Path) -> None:
    outcome = map_to(logs["a"], logs["b"], "--frame", "tags")
    assert (outcome.code, outcome.err) == (0, "")
    for part in ("all sigmas refer to the tags' own axes", "4 tags in one map, in the frame of the tags\n"):
        assert part in outcome.out
    (component,) = read_map(tmp_path / "out").components
    assert component.frame_name == "the tags' own axes"
    if find_spec("plotly"):
        assert "all sigmas refer to the tags' own axes" in unescape((tmp_path / "out" / "report.html").read_text())
    exported = run("export", tmp_path / "out", "--format", "csv", "-o", tmp_path / "csv")
    assert (exported.code, exported.err) == (0, "")
    assert "2 runs, 4 tags, in the frame of the tags" in exported.out
    another = write_drive(tmp_path / "more", DRIVES["a"], TAGS, make_robot("c"))
    located = run("localize", another, "--map", tmp_path / "out", "-o", tmp_path / "located")
    assert (located.code, located.err) == (0, "")
    assert json.loads((tmp_path / "located" / "localization.json").read_text())["frame_run"] is None


def test_a_measured_start_is_from_the_first_ones_in_any_frame(map_to: Run, logs: dict[str, Path]) -> None:
    start = "b_one=0.55,0.99,-0.3,0.01,0.01,0.01"
    outcome = map_to(logs["a"], logs["b"], "--frame", "tags", "--start", start)
    assert (outcome.code, outcome.err) == (0, "")
    assert "measured start of b_one from that of a_one: x 0.6" in outcome.out


def test_files_are_the_same_however_many_workers_share_out_the_drives(
    run: Run, logs: dict[str, Path], tmp_path: Path
) -> None:
    for n in (1, 2):
        outcome = run("map", logs["a"], logs["b"], "-o", tmp_path / str(n), "--workers", n)
        assert (outcome.code, outcome.err) == (0, "")
    files = sorted(path.name for path in (tmp_path / "1").iterdir())
    assert files == sorted(path.name for path in (tmp_path / "2").iterdir())
    for name in files:
        assert (tmp_path / "1" / name).read_bytes() == (tmp_path / "2" / name).read_bytes(), name


def test_a_terminal_shows_five_lines_that_ask_for_action(made_map_with_warnings: MapResult) -> None:
    short = summary(made_map_with_warnings, Path("out"))
    assert [line for line in short if line.startswith("warning: ")] == [f"warning: w{i}" for i in range(5)]
    assert "4 more: in the report, or with -v" in short
    long = summary(made_map_with_warnings, Path("out"), verbose=True)
    assert len([line for line in long if line.startswith("warning: ")]) == 9


@pytest.fixture
def made_map_with_warnings() -> MapResult:
    return replace(make_map(make_component()), warnings=tuple(f"w{i}" for i in range(9)), advice=())


def test_several_components_end_with_exit_3_and_the_reason(map_to: Run, logs: dict[str, Path], tmp_path: Path) -> None:
    far = [replace(tag, tag_id=tag.tag_id + 50) for tag in TAGS]
    alone = write_drive(tmp_path / "logs", DRIVES["a"], far, make_robot("c"))
    outcome = map_to(logs["a"], logs["b"], alone)
    assert outcome.code == 3
    assert "c_one shares no tag with the others" in outcome.out
    assert len(read_map(tmp_path / "out").components) == 2


def test_a_map_is_replaced_only_when_told_so(map_to: Run, logs: dict[str, Path], tmp_path: Path) -> None:
    assert map_to(logs["a"]).code == 0
    assert map_to(logs["a"], logs["b"]).code == 1
    assert len(read_map(tmp_path / "out").runs) == 1
    assert map_to(logs["a"], logs["b"], "--overwrite").code == 0
    assert len(read_map(tmp_path / "out").runs) == 2
