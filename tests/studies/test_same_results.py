"""What `same_results` takes for the same, and what it says of what is not."""

from pathlib import Path

import numpy as np
import pytest

from tests.benchmarks.same_results import Side, relative_difference, report
from tests.support.data.drives import MadeTag, made_drive, made_robot, write_drive


def two_files(folder: Path, name: str, old: str, new: str) -> tuple[Path, Path]:
    paths = folder / f"old-{name}", folder / f"new-{name}"
    for path, text in zip(paths, (old, new), strict=True):
        path.write_text(text, encoding="utf-8")
    return paths


def test_numbers_in_text_count_by_the_larger(tmp_path: Path) -> None:
    assert relative_difference(*two_files(tmp_path, "a.json", '{"x": 2.0, "y": -1e-3}', '{"x": 2.0, "y": -0.001}')) == 0
    found = relative_difference(*two_files(tmp_path, "b.csv", "7,1.0\n", "7,1.000000001\n"))
    assert found == pytest.approx(1e-9, rel=1e-6)


def test_other_words_or_more_numbers_are_no_small_difference(tmp_path: Path) -> None:
    assert relative_difference(*two_files(tmp_path, "a.txt", "tag 7 moved", "tag 7 stayed")) == np.inf
    assert relative_difference(*two_files(tmp_path, "b.txt", "1 2", "1 2 3")) == np.inf


def test_arrays_and_logs_are_looked_into(tmp_path: Path) -> None:
    old, new = tmp_path / "old.npz", tmp_path / "new.npz"
    np.savez(old, place=np.array([1.0, 4.0]), names=np.array(["a"]))
    np.savez(new, place=np.array([1.0, 4.0 + 4e-9]), names=np.array(["a"]))
    assert relative_difference(old, new) == pytest.approx(1e-9, rel=1e-3)
    np.savez(new, place=np.array([1.0, 4.0]), names=np.array(["b"]))
    assert relative_difference(old, new) == np.inf


def test_messages_of_logs_are_looked_into(tmp_path: Path) -> None:
    drive, tag = made_drive([0.0, 0.0, 0.0], [(0.3, 0.3, 2.0)]), MadeTag(1, (4.0, 0.2, 0.5), np.pi)
    logs = [
        write_drive(tmp_path / str(seed), drive, [tag], made_robot("a"), corner_sigma_px=0.1, seed=seed)
        for seed in (0, 1)
    ]
    files = [log / "0000.core.mcap" for log in logs]
    assert relative_difference(files[0], files[0]) == 0.0
    assert 0.0 < relative_difference(*files) < 0.1


def test_files_on_one_side_only_and_other_bytes_count(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sides = [Side(tmp_path, tmp_path / name) for name in ("old", "new")]
    for side, number in zip(sides, ("1.0", "1.1"), strict=True):
        side.folder.mkdir()
        (side.folder / "same.txt").write_text("the same")
        (side.folder / "number.txt").write_text(number)
    (sides[0].folder / "gone.txt").write_text("")
    assert report(sides, relative=0.0) == 2
    assert report(sides, relative=0.2) == 1
    assert "only in REVISION: gone.txt" in capsys.readouterr().out
