"""`map` refuses bad inputs in one line, and leaves nothing behind."""

from collections.abc import Callable
from pathlib import Path

import pytest

from groundsbot.calib.camera.file import write_camera_yaml
from groundsbot.calib.robot.robot_yaml import write_robot_yaml
from tests.support.data.drives import CAMERA, FAMILY, make_robot, write_drive
from tests.support.data.map_cases import DRIVES, TAGS, rewritten
from tests.support.programs import Run


def test_no_log(refused: Callable[..., str], tmp_path: Path) -> None:
    assert "nothing-here: no such log" in refused(tmp_path / "nothing-here")
    (tmp_path / "empty").mkdir()
    assert "holds no .mcap file" in refused(tmp_path / "empty")


def test_files_to_import_first(refused: Callable[..., str], tmp_path: Path) -> None:
    (tmp_path / "odometry.csv").touch()
    assert f"{tmp_path}: holds no .mcap file; " in refused(tmp_path)
    assert "files of other programs become logs by `groundsbot-offline import`" in refused(tmp_path)


def test_a_frame_that_is_none(refused: Callable[..., str], logs: dict[str, Path], tmp_path: Path) -> None:
    assert "--frame north: must be start, start:RUN, shape, two tags A,B, or a survey" in refused(
        logs["a"], "--frame", "north"
    )
    missing = tmp_path / "none.csv"
    assert f"{missing}: " in refused(logs["a"], "--frame", f"survey:{missing}")
    assert "the logs hold no run 'c_one'; use one of a_one" in refused(logs["a"], "--frame", "start:c_one")


def test_unreadable_files(refused: Callable[..., str], logs: dict[str, Path], tmp_path: Path) -> None:
    text_file = tmp_path / "notes.mcap"
    for content, reason in (("these are my notes", "is not an MCAP file"), ("", "is empty (0 bytes)")):
        text_file.write_text(content)
        text = refused(text_file)
        assert str(text_file) in text
        assert reason in text
        assert str(text_file) in refused(logs["a"], text_file)


def test_a_camera_file_of_another_size(refused: Callable[..., str], logs: dict[str, Path], tmp_path: Path) -> None:
    write_robot_yaml(make_robot("a"), tmp_path / "robot.yaml")
    write_camera_yaml(CAMERA.resize(0.5), tmp_path / "camera.yaml")
    text = refused(logs["a"], "--robot", tmp_path / "robot.yaml")
    for part in (str(logs["a"]), "1280x720", "640x360", "--robot"):
        assert part in text
    (tmp_path / "camera.yaml").unlink()
    assert "camera.yaml" in refused(logs["a"], "--robot", tmp_path / "robot.yaml")


def test_a_tag_size_that_is_missing(refused: Callable[..., str], tmp_path: Path) -> None:
    robot = make_robot("a", tags=[{"family": FAMILY, "sizes_m": {0: 0.15, 1: 0.15, 2: 0.15}}])
    log = write_drive(tmp_path / "logs", DRIVES["a"], TAGS, robot)
    text = refused(log)
    for part in (str(log), FAMILY, "tag 3", "default_size_m", "robot.yaml"):
        assert part in text


def test_the_same_run_twice(refused: Callable[..., str], logs: dict[str, Path], tmp_path: Path) -> None:
    copy = rewritten(logs["a"], tmp_path / "copy", lambda _message: True)
    for twice in ([logs["a"], logs["a"]], [logs["a"], logs["a"] / "0000.core.mcap"], [logs["a"], copy]):
        text = refused(*twice)
        for part in ("run one of robot a", "twice", "leave one out"):
            assert part in text


def test_an_output_folder_that_is_not_empty(
    refused: Callable[..., str], map_to: Run, logs: dict[str, Path], tmp_path: Path
) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "thesis.tex").write_text("years of work")
    text = refused(logs["a"])
    for part in (str(out), "not empty", "--overwrite"):
        assert part in text
    assert "map.json" in refused(logs["a"], "--overwrite")
    assert (out / "thesis.tex").read_text() == "years of work"
    text = refused(logs["a"], output=out / "thesis.tex")
    assert "is a file" in text
    assert "inputs are not changed" in refused(logs["a"], output=logs["a"])


def test_a_disk_that_is_full_leaves_everything_as_it_was(
    map_to: Run, refused: Callable[..., str], logs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert map_to(logs["a"]).code == 0
    before = {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir()}

    def full(_result: object, path: Path) -> None:
        path.write_bytes(b"half a pic")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("groundsbot.offline.report.write_picture", full)
    assert "No space left on device" in refused(logs["b"], "--overwrite")
    assert {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir()} == before
    assert "No space left on device" in refused(logs["b"], output=tmp_path / "new")
