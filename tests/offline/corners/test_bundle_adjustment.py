"""Maps refined on tag corners: exact for exact corners, on the floor for undetermined ones."""

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from groundsbot.calib.geometry import se2
from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.offline.corners import bundle_adjustment
from groundsbot.offline.corners.factors import SpatialState
from groundsbot.offline.corners.problem import CornerProblem
from groundsbot.offline.corners.solver import CornerSolution, solve_corners
from groundsbot.offline.mapping.inputs import read_runs
from groundsbot.offline.mapping.pipeline import build_map
from groundsbot.offline.maps.files import read_map, write_map
from groundsbot.offline.maps.model import MapModel
from groundsbot.offline.maps.result import FloorSigmas, MapResult
from groundsbot.offline.measurements.run import Run, load_run
from tests.support.data.drives import HALL, MadeDrive, MadeTag, make_drive, make_robot, seen_corners_px, write_drive
from tests.support.programs import Run as Program

ROUND = [(0.4, 0.4, 2.0), (0.5, 0.3, 2.0), (-0.3, 0.3, 5.0)]
STARTS = {"a": [1.0, 1.5, 0.3], "b": [1.4, 2.2, -0.2]}
# Upright, rolled, and leaning: the last two give wrong poses if they are assumed to be upright.
TAGS = [
    *HALL[:6],
    MadeTag(6, (4.3, 4.0, 0.7), -np.pi / 2, pitch_rad=-0.5),
]
NOISE = NoiseParameters()
CORNERS = np.array([[-0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.5, -0.5, 0.0], [-0.5, -0.5, 0.0]])


def drive_of(name: str) -> MadeDrive:
    return make_drive(STARTS[name], ROUND)


@pytest.fixture(scope="module")
def exact(tmp_path_factory: pytest.TempPathFactory) -> MapResult:
    folder = tmp_path_factory.mktemp("exact")
    logs = [write_drive(folder, drive_of(name), TAGS, make_robot(name)) for name in STARTS]
    return build_map(read_runs(logs), noise=NOISE, corners=True)


def assert_hang_as_made(result: MapResult, atol: float) -> None:
    """All four corners of each tag where they were made, in the world."""
    x, y, theta = STARTS["a"]
    turn = Rotation.from_euler("z", theta)
    for tag, made in zip(result.components[0].tags, TAGS, strict=True):
        assert tag.pose is not None
        corners = Rotation.from_quat(tag.pose.quaternion_xyzw).apply(0.15 * CORNERS)
        in_world = turn.apply(corners + np.append(tag.position_m, tag.pose.height_m)) + np.array([x, y, 0.0])
        np.testing.assert_allclose(in_world, made.corners_m(), atol=atol, err_msg=str(made))


def test_exact_corners_give_the_true_pose_of_every_tag(exact: MapResult) -> None:
    (component,) = exact.components
    assert component.model is MapModel.CORNERS
    assert [warning for warning in exact.warnings if "upright" not in warning] == []
    assert_hang_as_made(exact, atol=1e-6)
    for run in component.runs:
        true = se2.between(STARTS["a"], drive_of(run.robot_id).at(run.stamps_ns))
        np.testing.assert_allclose(se2.log(se2.between(true, run.T_map_base)), 0.0, atol=1e-6)
    assert {number.name for number in exact.calibration} >= {"mount_z_m", "mount_roll_rad", "time_offset_s"}


def test_a_refined_map_gives_no_advice_by_other_sigmas_than_its_own(exact: MapResult) -> None:
    assert exact.advice == ()


def test_a_refined_map_is_read_back_as_it_was_written(exact: MapResult, tmp_path: Path) -> None:
    write_map(exact, tmp_path)
    again = read_map(tmp_path)
    assert again.components[0].model is MapModel.CORNERS
    assert again.components[0].floor == exact.components[0].floor == FloorSigmas(0.0, 0.0)
    assert again.noise == exact.noise
    rows = list(csv.DictReader((tmp_path / "tags.csv").open()))
    for tag, found, made, row in zip(exact.components[0].tags, again.components[0].tags, TAGS, rows, strict=True):
        assert tag.pose is not None
        assert found.pose is not None
        assert found.pose.height_m == pytest.approx(tag.pose.height_m)
        np.testing.assert_allclose(found.pose.quaternion_xyzw, tag.pose.quaternion_xyzw)
        np.testing.assert_allclose(found.pose.covariance, tag.pose.covariance)
        np.testing.assert_array_equal(found.position_m, tag.position_m)
        np.testing.assert_allclose(found.covariance, tag.pose.covariance[:2, :2])
        assert float(row["z_m"]) == pytest.approx(made.position_m[2], abs=2e-6)
        apart = float(row["yaw_rad"]) - (made.yaw_rad - STARTS["a"][2])
        assert np.sin(apart / 2) == pytest.approx(0.0, abs=2e-6)


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory) -> Run:
    drive = make_drive(STARTS["a"], ROUND[:2])
    return load_run(
        write_drive(tmp_path_factory.mktemp("short"), drive, TAGS[:3], make_robot("a"), corner_sigma_px=0.2)
    )


def rolled_run(tmp_path: Path, readout_s: float) -> Run:
    """A drive whose pictures are read out row by row, each corner seen from where the robot was by then."""
    drive, robot = drive_of("a"), make_robot("a", readout_s=readout_s)
    run = load_run(write_drive(tmp_path, drive, TAGS, robot))
    camera = run.camera
    assert camera is not None
    corners_px, whole = run.detections.corners_px.copy(), np.ones(len(run.detections.tag), dtype=np.bool_)
    for i, (stamp_ns, tag) in enumerate(zip(run.detections.stamps_ns, run.detections.tag, strict=True)):
        for corner in range(4):
            for _ in range(2):
                share = corners_px[i, corner, 1] / (camera.height_px - 1) - 0.5
                pose = drive.at(np.array([stamp_ns + round(share * readout_s * 1e9)]))[0]
                seen = seen_corners_px(TAGS[run.tags[tag].tag_id], pose, robot, camera)
                whole[i] &= seen is not None
                if seen is not None:
                    corners_px[i, corner] = seen[corner]
    detections = run.detections
    kept = replace(detections.where(whole), corners_px=corners_px[whole])
    return replace(run, detections=kept)


def test_each_row_is_seen_from_where_the_wheels_say_that_the_robot_was(tmp_path: Path) -> None:
    run = rolled_run(tmp_path, readout_s=0.03)
    mapped = build_map([run], noise=NOISE, corners=True)
    assert mapped.components[0].model is MapModel.CORNERS, mapped.warnings
    # Where speeds change between a stamp and a row, one arc is not quite what was driven.
    assert mapped.components[0].cost < 1.0
    assert_hang_as_made(mapped, atol=2e-3)
    global_shutter = run.robot.model_copy(update={"readout_s": 0.0})
    ignored = build_map([replace(run, robot=global_shutter)], noise=NOISE, corners=True)
    assert ignored.components[0].cost > 20.0


@pytest.mark.parametrize("pitched_deg", [-5.0, 5.0])
def test_a_camera_pitched_by_ten_sigmas_is_found(pitched_deg: float, tmp_path: Path) -> None:
    """Tags are upright; no tag is reported as tilted, and none is left in the wrong one of its two poses."""
    upright = [replace(tag, roll_rad=0.0) for tag in HALL[:6]]
    runs = []
    for name in STARTS:
        run = load_run(write_drive(tmp_path, drive_of(name), upright, make_robot(name), corner_sigma_px=0.2))
        mount = run.robot.mount
        wrong = mount.model_copy(update={"pitch_rad": mount.pitch_rad + np.radians(pitched_deg)})
        runs.append(replace(run, robot=run.robot.model_copy(update={"mount": wrong})))
    result = build_map(runs, noise=NOISE, corners=True)
    (component,) = result.components
    assert component.model is MapModel.CORNERS, result.warnings
    assert not [warning for warning in result.warnings if "upright" in warning]
    found = [number.value for number in result.calibration if number.name == "mount_pitch_rad"]
    np.testing.assert_allclose(np.degrees(found), -pitched_deg, atol=0.1)
    to_a = se2.between(STARTS["a"], np.array([[*tag.position_m[:2], 0.0] for tag in upright]))[:, :2]
    errors_m = np.array([tag.position_m for tag in component.tags]) - to_a
    assert np.sqrt((errors_m**2).sum(axis=1).mean()) < 0.015


@pytest.mark.parametrize("what", ["no end", "no fit"])
def test_undetermined_corners_leave_the_map_on_the_floor(
    what: str, short: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stopped(problem: CornerProblem, start: SpatialState) -> CornerSolution:
        return replace(solve_corners(problem, start), factor=None, reason="no step lowers the cost")

    def unfit(problem: CornerProblem, start: SpatialState) -> CornerSolution:
        found = solve_corners(problem, start)
        off = problem.corners.observations._replace(corners_px=problem.corners.observations.corners_px + 20.0)
        return replace(found, problem=replace(problem, corners=replace(problem.corners, observations=off)))

    monkeypatch.setattr(bundle_adjustment, "solve_corners", {"no end": stopped, "no fit": unfit}[what])
    result = build_map([short], noise=NOISE, corners=True)
    assert result.components[0].model is MapModel.FLOOR
    assert all(tag.pose is None for tag in result.components[0].tags)
    (said,) = [warning for warning in result.warnings if "not refined on tag corners" in warning]
    assert ("no step lowers the cost" if what == "no end" else "100 % of the tag detections are outliers") in said
    assert said.endswith("the map has planar tag positions only")


def test_the_command_offers_both_models(run: Program, short: Run, tmp_path: Path) -> None:
    for model in MapModel:
        outcome = run("map", short.log, "-o", tmp_path / model, "--model", model)
        assert outcome.code == 0, outcome
        assert read_map(tmp_path / model).components[0].model is model
    assert run("map", short.log, "-o", tmp_path / "other", "--model", "3d").code == 2
