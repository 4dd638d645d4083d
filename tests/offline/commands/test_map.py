"""`map` as a person meets it: what it says, and what it leaves behind."""

import json
import shutil
import sys
import time
from contextlib import suppress
from dataclasses import replace
from errno import ENOSPC
from html import unescape
from importlib.util import find_spec
from io import StringIO
from math import ceil
from os import strerror
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from groundsbot.offline.commands import map_drives
from groundsbot.offline.commands.map_summary import summary
from groundsbot.offline.commands.terminal import echo_lines
from groundsbot.offline.maps.files import read_map
from groundsbot.offline.maps.fit_results import OutlierTag
from groundsbot.offline.maps.mcap import MAP_FILE
from groundsbot.offline.maps.parameter_results import RobotNumber
from groundsbot.offline.maps.result import MapResult
from groundsbot.offline.self_calibration.robot_table import WRONG
from tests.support.data.drives import make_robot, write_drive
from tests.support.data.map_cases import DRIVES, TAGS
from tests.support.data.maps import make_component, make_map, make_run
from tests.support.programs import Run


def test_two_logs_become_one_map_and_are_left_alone(map_to: Run, logs: dict[str, Path], tmp_path: Path) -> None:
    recorded = {path: path.read_bytes() for path in (tmp_path / "logs").rglob("*.mcap")}
    outcome = map_to(logs["a"], logs["b"])
    assert (outcome.code, outcome.err) == (0, "")
    assert {path: path.read_bytes() for path in (tmp_path / "logs").rglob("*") if path.is_file()} == recorded
    for part in (
        "Tags are known to ",
        " relative to each other",
        "From the start of a_one to that of b_one it is 1.12 m",
        "2 runs, ",
        "; 4 tags in one map",
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
    for part in ("All sigmas refer to the tags' own axes", "4 tags in one map, in the frame of the tags\n"):
        assert part in outcome.out
    (component,) = read_map(tmp_path / "out").components
    assert component.frame_name == "the tags' own axes"
    if find_spec("plotly"):
        assert "All sigmas refer to the tags' own axes" in unescape((tmp_path / "out" / "report.html").read_text())
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


def write_for_seconds(what: tuple[MapResult, Path]) -> None:
    """In a worker, again and again, with the folder where that is gone."""
    end_s = time.monotonic() + 5.0
    while time.monotonic() < end_s:
        with suppress(OSError):  # removed meanwhile
            what[1].parent.mkdir(exist_ok=True)
            what[1].touch()


def test_nothing_is_left_of_a_map_that_cannot_be_written_while_workers_write_parts_of_it(
    run: Run, logs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fill_disk(_result: MapResult, folder: Path) -> None:
        while not (folder / MAP_FILE).exists():
            time.sleep(0.001)
        raise OSError(ENOSPC, strerror(ENOSPC))

    def remove_in_time(path: Path, **options: Any) -> None:
        remove(path, **options)
        time.sleep(0.5)  # in which a worker that is still there writes again

    remove = shutil.rmtree
    monkeypatch.setattr(shutil, "rmtree", remove_in_time)
    monkeypatch.setattr(map_drives, "_write_messages", write_for_seconds)
    monkeypatch.setattr(map_drives, "write_map", fill_disk)
    outcome = run("map", logs["a"], logs["b"], "-o", tmp_path / "out", "--workers", 2)
    assert outcome.code == 1
    assert "out: cannot be written (No space left on device)" in outcome.err
    assert [each.name for each in tmp_path.iterdir()] == ["logs"]


def test_a_terminal_shows_five_lines_that_ask_for_action(made_map_with_warnings: MapResult) -> None:
    short = summary(made_map_with_warnings, Path("out"))
    assert [line for line in short if line.startswith("warning: ")] == [f"warning: w{i}" for i in range(5)]
    assert "4 more: in the report, or with -v" in short
    long = summary(made_map_with_warnings, Path("out"), verbose=True)
    assert len([line for line in long if line.startswith("warning: ")]) == 9


def test_two_runs_and_eleven_fit_one_screen(made_map_with_warnings: MapResult) -> None:
    component = make_component()
    names = [f"robot{i}_day" for i in range(11)]
    runs = tuple(make_run(name, np.zeros(3), np.zeros((3, 3))) for name in names)
    many = replace(component, runs=runs, joint_covariance=1e-3 * np.eye(3 * 11 + 2 * 3))
    seen = f"in {', '.join(names)} (488 observations)"
    outliers = tuple(OutlierTag("tag36h11", i, "moved", (names[0],), f"by 0.80 m: {seen}") for i in range(4))
    number = RobotNumber("red", "track_scale", 0, "track_m", 0.54, 0.5, 0.001, WRONG, "")
    crowded = replace(
        made_map_with_warnings,
        components=(many,),
        outliers=outliers,
        losses=("x" * 120,),
        warnings=tuple(f"w{i} " + 30 * "abc defg " for i in range(9)),
        robot_numbers=12 * (number,),
    )
    apart = replace(make_map(*(make_component(f"a{i}_one", f"b{i}_one") for i in range(11))), warnings=("w",) * 10)
    wordy = replace(crowded, outliers=(), losses=())
    for result in (made_map_with_warnings, crowded, wordy, apart):
        lines = summary(result, Path("out"))
        assert sum(ceil(len(line) / 100) for line in lines) < 24
        asking = [line for line in lines if line.startswith(("lost: ", "suspect: ", "warning: "))]
        assert 1 <= len(asking) <= 5
        long = summary(result, Path("out"), verbose=True)
        assert long[0] == lines[0]
        assert len(long) > len(lines)
    assert any(line.startswith("suspect: tag 0 (tag36h11) moved: by 0.80 m") for line in summary(crowded, Path("out")))
    assert seen in summary(crowded, Path("out"), verbose=True)[2]


def test_verbose_puts_pairs_of_runs_in_tables() -> None:
    lines = summary(make_map(), Path("out"), verbose=True)
    at = lines.index("alignment of  with      tags that fit  RMS (m)  x (m)  y (m)  turn (deg)")
    assert lines[at + 1] == "red_one       blue_two         2 of 2     0.03  10.00   2.00        90.0"
    at = lines.index("start of  to start of  distance (m)  sigma (m)")
    assert lines[at + 1].startswith("red_one   blue_two           10.198      0.")
    assert "red_one          20         1.9     2" in lines


@pytest.mark.parametrize(
    ("is_terminal", "no_color", "is_coloured"), [(True, "", True), (True, "1", False), (False, "", False)]
)
def test_colour_is_for_terminals_only(
    is_terminal: bool, no_color: str, is_coloured: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    stream = StringIO()
    monkeypatch.setattr(stream, "isatty", lambda: is_terminal)
    monkeypatch.setattr(sys, "stdout", stream)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("NO_COLOR", no_color)
    echo_lines(["Use this map with care, because", "warning: \x1b[2J", "2 runs"])
    yellow = ("\x1b[33m\x1b[1m", "\x1b[0m") if is_coloured else ("", "")
    assert stream.getvalue() == (
        "{}Use this map with care{}, because\n{}warning:{} \\x1b[2J\n2 runs\n".format(*yellow, *yellow)
    )


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


def test_a_map_is_replaced_only_with_overwrite(map_to: Run, logs: dict[str, Path], tmp_path: Path) -> None:
    assert map_to(logs["a"]).code == 0
    assert map_to(logs["a"], logs["b"]).code == 1
    assert len(read_map(tmp_path / "out").runs) == 1
    assert map_to(logs["a"], logs["b"], "--overwrite").code == 0
    assert len(read_map(tmp_path / "out").runs) == 2
