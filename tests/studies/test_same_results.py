"""What `same_results` takes for the same, and what it says of what is not."""

import importlib
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.main import get_command

from tests.benchmarks.same_results import COMMANDS, INPUTS, PAPER, Side, relative_difference, report
from tests.support.data.drives import MadeTag, make_drive, make_robot, write_drive


def two_files(folder: Path, name: str, old: str, new: str) -> tuple[Path, Path]:
    paths = folder / f"old-{name}", folder / f"new-{name}"
    for path, text in zip(paths, (old, new), strict=True):
        path.write_text(text, encoding="utf-8")
    return paths


def test_numbers_in_text_count_by_the_larger(tmp_path: Path) -> None:
    assert relative_difference(*two_files(tmp_path, "a.json", '{"x": 2.0, "y": -1e-3}', '{"x": 2.0, "y": -0.001}')) == 0
    found = relative_difference(*two_files(tmp_path, "b.csv", "7,1.0\n", "7,1.000000001\n"))
    assert found == pytest.approx(1e-9, rel=1e-6)


def test_whole_numbers_are_ids_counts_and_stamps(tmp_path: Path) -> None:
    stamps = two_files(tmp_path, "a.json", '{"t_ns": 1700000000000000000}', '{"t_ns": 1700000000000000100}')
    assert relative_difference(*stamps) == np.inf


def test_other_words_or_more_numbers_are_no_small_difference(tmp_path: Path) -> None:
    assert relative_difference(*two_files(tmp_path, "a.txt", "tag 7 moved", "tag 7 stayed")) == np.inf
    assert relative_difference(*two_files(tmp_path, "b.txt", "1 2", "1 2 3")) == np.inf


def test_arrays_and_logs_are_compared_by_content(tmp_path: Path) -> None:
    old, new = tmp_path / "old.npz", tmp_path / "new.npz"
    np.savez(old, place=np.array([1.0, 4.0]), names=np.array(["a"]))
    np.savez(new, place=np.array([1.0, 4.0 + 4e-9]), names=np.array(["a"]))
    assert relative_difference(old, new) == pytest.approx(1e-9, rel=1e-3)
    for place, name in (([1.0, 4.0], "b"), ([1.0, np.nan], "a"), (np.array([1, 4], dtype=np.float32), "a")):
        np.savez(new, place=place, names=np.array([name]))
        assert relative_difference(old, new) == np.inf


def test_messages_of_logs_are_compared_by_content(tmp_path: Path) -> None:
    drive, tag = make_drive([0.0, 0.0, 0.0], [(0.3, 0.3, 2.0)]), MadeTag(1, (4.0, 0.2, 0.5), np.pi)
    logs = [
        write_drive(tmp_path / str(seed), drive, [tag], make_robot("a"), corner_sigma_px=0.1, seed=seed)
        for seed in (0, 1)
    ]
    files = [log / "0000.core.mcap" for log in logs]
    assert relative_difference(files[0], files[0]) == 0.0
    assert 0.0 < relative_difference(*files) < 0.1


def test_files_on_one_side_only_and_other_bytes_count(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sides = [Side(tmp_path, tmp_path / name) for name in ("old", "new")]
    for side, number, notation in zip(sides, ("1.0", "1.1"), ("1.0", "1.00"), strict=True):
        side.folder.mkdir()
        (side.folder / "same.txt").write_text("the same")
        (side.folder / "number.txt").write_text(number)
        (side.folder / "notation.txt").write_text(notation)
    (sides[0].folder / "gone.txt").write_text("")
    assert report(sides, relative=0.0) == 3
    assert report(sides, relative=0.2) == 1
    assert "only in REVISION: gone.txt" in capsys.readouterr().out


def test_a_command_that_fails_on_both_sides_compares_nothing(tmp_path: Path) -> None:
    sides = [Side(tmp_path, tmp_path / name) for name in ("old", "new")]
    for side in sides:
        side.folder.mkdir()
        (side.folder / "00-offline.printed").write_text("offline map x\nexit 2\nno such option")
    assert report(sides, relative=1e-9) == 1


@pytest.mark.parametrize("command", [line for text in (INPUTS, COMMANDS, PAPER) for line in text.strip().splitlines()])
def test_commands_are_those_that_the_programs_have(command: str) -> None:
    program, word, *words = shlex.split(command)
    module = "groundsbot.fixtures.__main__" if program == "fixtures" else f"groundsbot.{program}.cli"
    group: Any = get_command(importlib.import_module(module).app)
    group.commands[word].make_context(word, words)
