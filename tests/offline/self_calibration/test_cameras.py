"""Self-calibration of robots with several cameras: mount, clock, edge shift and focal length of each."""

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest

from groundsbot.calib.camera import write_camera_yaml
from groundsbot.calib.robot import CameraFields, NoiseParameters, Robot, write_robot_yaml
from groundsbot.fixtures.simulate import TRUTH_FILE
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.foundation.stages import Stages
from groundsbot.offline.foundation.workers import Workers
from groundsbot.offline.mapping.inputs import read_runs
from groundsbot.offline.mapping.pipeline import build_map
from groundsbot.offline.maps.result import MapResult
from groundsbot.offline.measurements.run import RobotFile, Run, read_robot_file
from groundsbot.offline.self_calibration.option import AUTO, Calibrate, parse_calibrate
from groundsbot.offline.self_calibration.robot import Correction, OwnedParameter, with_unknown_calibration
from groundsbot.offline.self_calibration.robot_table import WRONG
from groundsbot.offline.self_calibration.self_calibration import correct_focal_lengths, free_as_before, free_parameters
from groundsbot.offline.self_calibration.start_values import estimate_start_values
from groundsbot.onboard.log.reading.reader import find_logs
from tests.support.data.simulated_runs import simulated_runs
from tests.support.programs import Run as Program

WRONG_BY = {"mount_yaw_rad": 0.2, "mount_x_m": 0.05, "time_offset_s": 0.3}


@pytest.fixture(scope="module")
def runs(two_camera_drives: Path) -> list[Run]:
    return read_runs(find_logs([two_camera_drives]))


def mistaken(robot: Robot, **changes: object) -> Robot:
    """The robot's file with its left camera elsewhere and late, and other fields of it changed."""

    def fields(name: str, camera: CameraFields) -> dict[str, object]:
        if name != "left":
            return {}
        mount = {
            "yaw_rad": camera.mount.yaw_rad + WRONG_BY["mount_yaw_rad"],
            "x_m": camera.mount.x_m + WRONG_BY["mount_x_m"],
        }
        late = {"time_offset_s": camera.time_offset_s + WRONG_BY["time_offset_s"]}
        return {"mount": camera.mount.model_copy(update=mount)} | late | changes

    return robot.update_cameras(fields)


def map_mistaken(two_camera_drives: Path, runs: list[Run], **changes: object) -> MapResult:
    files = {run.robot_id: RobotFile(mistaken(run.robot, **changes), run.named_cameras) for run in runs}
    return build_map(read_runs(find_logs([two_camera_drives]), files), calibrate=parse_calibrate(AUTO))


def largest_error(result: MapResult, two_camera_drives: Path, runs: list[Run]) -> float:
    """In sigmas, of mount and clock of all cameras, from the files that they were given."""
    true = json.loads((two_camera_drives / TRUTH_FILE).read_text())["runs"]
    run_of, errors = {run.robot_id: run for run in runs}, []
    for each in result.calibration:
        name, _, camera = each.name.partition(".")
        if name in WRONG_BY:
            own = run_of[each.owner].robot.with_camera(camera)
            given = own.time_offset_s if name == "time_offset_s" else getattr(own.mount, name.removeprefix("mount_"))
            given += WRONG_BY[name] if camera == "left" else 0.0
            errors.append((given + each.value - true[run_of[each.owner].name]["parameters"][each.name]) / each.sigma)
    assert len(errors) == 3 * 2 * len(WRONG_BY)
    return float(max(map(abs, errors)))


def test_a_camera_elsewhere_and_late_is_found(two_camera_drives: Path, runs: list[Run]) -> None:
    """Its numbers are freed and said to be wrong; those of the other camera stay near robot.yaml."""
    result = map_mistaken(two_camera_drives, runs)
    assert largest_error(result, two_camera_drives, runs) < 4.0
    wrong = {each.name for each in result.robot_numbers if each.verdict == WRONG}
    assert {"mount_yaw_rad.left", "time_offset_s.left"} <= wrong
    assert not [name for name in wrong if name.endswith(".front")]
    assert {each.what for each in result.robot_numbers} >= {"left: mount.yaw_rad", "front: time_offset_s"}


def test_a_clock_left_open_is_estimated(two_camera_drives: Path, runs: list[Run]) -> None:
    """With a sigma of its time offset as in files of robots that were not measured."""
    mount = mistaken(runs[0].robot).cameras["left"].mount.model_copy(update={"yaw_rad_sigma": 0.3, "x_m_sigma": 0.3})
    result = map_mistaken(two_camera_drives, runs, time_offset_s_sigma=0.3, mount=mount)
    assert largest_error(result, two_camera_drives, runs) < 4.0
    late = [each for each in result.choices if each.name == "time_offset_s.left"]
    assert [each.is_freed for each in late] == [True] * 3


def test_the_command_writes_each_camera(two_camera_drives: Path, runs: list[Run], tmp_path: Path, run: Program) -> None:
    """Files that the next drive is mapped with; a camera's option names its parameters."""
    options: list[str | Path] = []
    for each in runs:
        path = tmp_path / f"{each.robot_id}.yaml"
        options += ["--robot", path]
        for name, model in each.named_cameras.items():
            write_camera_yaml(model, tmp_path / each.robot.cameras[name].camera)
        write_robot_yaml(mistaken(each.robot), path)
    found = run("calibrate", two_camera_drives, *options, "-o", tmp_path / "new")
    assert found.code == 0, found.err
    assert re.search(
        r"^a +left: mount.yaw +101\.\d+ +90\.\d+ +0\.\d+ +deg  robot\.yaml is wrong$", found.out, re.MULTILINE
    )
    files = [f"{robot}{part}.yaml" for robot in "abc" for part in ("", "_camera_front", "_camera_left")]
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == sorted(files)
    for each in runs:
        written = read_robot_file(tmp_path / "new" / f"{each.robot_id}.yaml")
        left = written.robot.cameras["left"]
        assert left.camera == f"{each.robot_id}_camera_left.yaml"
        assert left.mount.yaw_rad == pytest.approx(1.57, abs=0.03)
        assert left.mount.yaw_rad_sigma < each.robot.cameras["left"].mount.yaw_rad_sigma
        assert left.time_offset_s == pytest.approx(0.0, abs=0.02)
        assert {name: replace(model, name="") for name, model in written.cameras.items()} == {
            name: replace(model, name="") for name, model in each.named_cameras.items()
        }
    again = run("calibrate", two_camera_drives, "-o", tmp_path / "new")
    assert again.code == 1
    assert "exists already" in again.err


def test_a_parameter_of_one_camera_is_asked_for(runs: list[Run], two_camera_drives: Path) -> None:
    result = build_map(runs, calibrate=parse_calibrate("mount_yaw_rad.left"))
    assert {each.name for each in result.choices if each.is_freed} == {"mount_yaw_rad.left"}
    with pytest.raises(OfflineError, match=r"--calibrate: mount_x_m.rear: no robot .*'rear'; .* are front, left$"):
        build_map(runs, calibrate=Calibrate(is_on=True, names=("mount_x_m.rear",)))
    with pytest.raises(OfflineError, match=r"'track_scale.left' is neither off nor auto"):
        parse_calibrate("track_scale.left")


def test_the_clock_of_each_camera_is_searched() -> None:
    ((run,), _) = simulated_runs("nsh", 0, ["loop"], two_cameras=True)
    late = run.shift_stamps(0.0, WRONG_BY["time_offset_s"])
    opened = replace(late, robot=with_unknown_calibration(late.robot))
    found = estimate_start_values([opened], NoiseParameters()).corrections
    for name, off_s in (("time_offset_s.front", 0.0), ("time_offset_s.left", -WRONG_BY["time_offset_s"])):
        assert found[name].sigma < 0.05
        assert found[name].value == pytest.approx(off_s, abs=3.0 * found[name].sigma)


def test_parts_of_a_drive_keep_what_was_freed(runs: list[Run]) -> None:
    """As `live` maps a drive again and again while it is under way."""
    wrong = [replace(run, robot=mistaken(run.robot)).shift_stamps(0.0, WRONG_BY["time_offset_s"]) for run in runs]
    freed = free_parameters(wrong, NoiseParameters(), (), Stages(), Workers(), corners=False)
    assert any(each.is_freed for each in freed.choices)
    again = free_as_before(wrong, freed).runs
    for first, second in zip(freed.runs, again, strict=True):
        assert first.robot == second.robot
        assert (first.picture_stamps_ns == second.picture_stamps_ns).all()


def test_focal_lengths_are_corrected_by_camera(runs: list[Run]) -> None:
    run = runs[0]
    changed = correct_focal_lengths(run, {OwnedParameter(run.robot_id, "focal_scale.left"): Correction(0.02, 0.001)})
    assert changed.named_cameras["front"] == run.named_cameras["front"]
    assert changed.named_cameras["left"].fx_px == pytest.approx(1.02 * run.named_cameras["left"].fx_px)
    assert changed.camera == run.camera
