"""`calibrate` writes what drives determine; `map --calibrate` says what was freed."""

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest

from groundsbot.calib.camera.file import read_camera_yaml
from groundsbot.calib.robot.robot_yaml import read_robot_yaml, write_robot_yaml
from groundsbot.offline.measurements.run import read_robot_file
from groundsbot.offline.self_calibration.robot_table import WRONG
from tests.offline.self_calibration.calibrated_drives import LEGS, drive_legs, mistaken
from tests.support.data.drives import CAMERA
from tests.support.programs import Run as Program


def test_the_command_writes_files_that_the_next_drive_is_mapped_with(log: Path, tmp_path: Path, run: Program) -> None:
    wrong = tmp_path / "wrong.yaml"
    write_robot_yaml(mistaken(track_m=0.08).model_copy(update={"camera": None}), wrong)
    output = tmp_path / "new" / "robot.yaml"
    found = run("calibrate", log, "--robot", wrong, "-o", output)
    assert found.code == 0, found.err
    assert re.search(
        r"^a +track +540\.00 +(49|50)\d\.\d\d +\d\.\d\d +mm  robot\.yaml is wrong$", found.out, re.MULTILINE
    )
    assert re.search(r"\nto determine .*: give a measured --distance", found.out)
    assert "scale: known to" in found.out
    camera = read_robot_file(output).camera
    assert camera is not None
    assert replace(camera, name=CAMERA.name) == CAMERA
    assert read_robot_yaml(output).wheels.track_m == pytest.approx(0.5, rel=1e-2)
    refused = run("calibrate", log, "-o", output)
    assert refused.code == 1
    assert "exists already" in refused.err


def test_robots_get_a_file_each_in_a_folder(log: Path, tmp_path: Path, run: Program) -> None:
    other = drive_legs(tmp_path, "b", LEGS[:2])
    refused = run("calibrate", log, other, "-o", tmp_path / "robot.yaml")
    assert refused.code == 1
    assert "several robots (a, b)" in refused.err
    assert not (tmp_path / "robot.yaml").exists()
    found = run("calibrate", log, other, "-o", tmp_path / "learnt", "--model", "corners", "--json")
    assert found.code == 0, found.err
    document = json.loads(found.out)
    assert sorted(Path(each).name for each in document["files"]) == [
        "a.yaml",
        "a_camera.yaml",
        "b.yaml",
        "b_camera.yaml",
    ]
    assert {each["owner"] for each in document["learnt"]} == {"a", "b", "default tag36h11"}
    camera = read_camera_yaml(tmp_path / "learnt" / "a_camera.yaml")
    assert replace(camera, name=CAMERA.name) == CAMERA


def test_the_map_says_what_was_freed(log: Path, tmp_path: Path, run: Program) -> None:
    wrong = tmp_path / "wrong.yaml"
    write_robot_yaml(mistaken(track_m=0.08).model_copy(update={"camera": None}), wrong)
    found = run("map", log, "--robot", wrong, "--calibrate", "auto", "-o", tmp_path / "map")
    assert re.search(r"a  track_m +0\.5400 ->   0\.(49|50)\d\d  0\.00\d\d  robot\.yaml is wrong", found.out)
    document = json.loads((tmp_path / "map" / "map.json").read_text())
    assert [each["name"] for each in document["choices"] if each["is_freed"]] == ["track_scale"]
    (row,) = [each for each in document["robot_numbers"] if each["name"] == "track_scale"]
    assert (row["verdict"], row["in_file"]) == (WRONG, pytest.approx(0.54))
    assert row["found"] == pytest.approx(0.5, abs=0.002)
    assert "groundsbot-offline calibrate" in row["to_do"]
    report = (tmp_path / "map" / "report.html").read_text()
    assert "Robot parameters estimated from these drives" in report
    assert "Search for time offsets" in report
    off = run("map", log, "--calibrate", "none", "-o", tmp_path / "off")
    assert (off.code, off.err.startswith("error: --calibrate: 'none'")) == (1, True)
