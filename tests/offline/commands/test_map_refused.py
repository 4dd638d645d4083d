"""`map` says in one line what stands in the way, and leaves nothing behind."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from google.protobuf.message import Message

from groundsbot.calib.camera.file import write_camera_yaml
from groundsbot.calib.robot.robot_yaml import write_robot_yaml
from groundsbot.onboard.log.messages import WheelEncoders
from tests.support.data.drives import CAMERA, FAMILY, START_NS, MadeTag, S, make_robot, write_drive
from tests.support.data.map_cases import DRIVES, TAGS, imported_log, rewritten
from tests.support.programs import Run


def test_no_log(refused: Callable[..., str], tmp_path: Path) -> None:
    assert "nothing-here: no such log" in refused(tmp_path / "nothing-here")
    (tmp_path / "empty").mkdir()
    assert "holds no .mcap file" in refused(tmp_path / "empty")


def test_a_log_without_wheels(refused: Callable[..., str], logs: dict[str, Path], tmp_path: Path) -> None:
    log = rewritten(logs["a"], tmp_path / "no", lambda message: not isinstance(message, WheelEncoders))
    text = refused(logs["b"], log)
    for part in (str(log), "/wheels", "0 messages", "encoder port"):
        assert part in text


def test_a_frame_that_is_none(refused: Callable[..., str], logs: dict[str, Path], tmp_path: Path) -> None:
    assert "--frame north: must be start, start:RUN, tags or survey:FILE" in refused(logs["a"], "--frame", "north")
    missing = tmp_path / "none.csv"
    assert f"{missing}: " in refused(logs["a"], "--frame", f"survey:{missing}")
    assert "there is no run 'c_one'; the runs are a_one" in refused(logs["a"], "--frame", "start:c_one")


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


def test_a_tag_size_that_is_negative(refused: Callable[..., str], logs: dict[str, Path], tmp_path: Path) -> None:
    path = tmp_path / "robot.yaml"
    write_robot_yaml(make_robot("a"), path)
    path.write_text(path.read_text().replace("default_size_m: 0.15", "default_size_m: -0.15"))
    text = refused(logs["a"], "--robot", path)
    for part in (str(path), "default_size_m", "-0.15", "above 0"):
        assert part in text.replace("greater than 0", "above 0")


def test_logs_that_disagree_about_a_size(refused: Callable[..., str], logs: dict[str, Path], tmp_path: Path) -> None:
    other = make_robot("b", tags=[{"family": FAMILY, "default_size_m": 0.16}])
    log = write_drive(tmp_path / "other", DRIVES["b"], TAGS, other)
    text = refused(logs["a"], log)
    for part in (str(log), "tag 0", "0.16", "0.15", "--robot"):
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

    monkeypatch.setattr("groundsbot.offline.commands.map_drives.write_picture", full)
    assert "No space left on device" in refused(logs["b"], "--overwrite")
    assert {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir()} == before
    assert "No space left on device" in refused(logs["b"], output=tmp_path / "new")


def test_odometry_that_is_no_number(refused: Callable[..., str], tmp_path: Path) -> None:
    for i, value in enumerate((np.nan, np.inf, 1e300)):
        log = imported_log(tmp_path / "logs" / str(i), odometry_m=value)
        text = refused(log)
        for part in (str(log), "/odometry", "wheels.left_m", f"{value:g}", "reading 3"):
            assert part in text


def test_ticks_that_no_wheel_can_count(refused: Callable[..., str], logs: dict[str, Path], tmp_path: Path) -> None:
    def leap(message: Message) -> object:
        if isinstance(message, WheelEncoders) and message.stamp_ns == START_NS + S:
            message.ticks_left = 2**61
        return True

    log = rewritten(logs["a"], tmp_path / "leap", leap)
    text = refused(log)
    for part in (str(log), "/wheels", "100 m/s"):
        assert part in text


def test_a_family_without_a_size_is_refused(refused: Callable[..., str], tmp_path: Path) -> None:
    both = [*TAGS, MadeTag(0, (6.0, 0.2, 0.7), np.pi, family="tag25h9")]
    log = write_drive(tmp_path / "logs", DRIVES["a"], both, make_robot("a"))
    text = refused(log)
    for part in (str(log), "tag25h9", "size"):
        assert part in text
