"""Self-calibration frees what drives determine and robot.yaml has wrong, and nothing else."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from groundsbot.calib.robot.parameters import FOCAL_SCALE, TAG_SCALE, WHEEL_PARAMETERS
from groundsbot.fixtures.simulate import TRUTH_FILE, simulate
from groundsbot.fixtures.worlds.world import load_world
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.local_map.local_map import solve_local_map
from groundsbot.offline.mapping.inputs import read_runs
from groundsbot.offline.mapping.pipeline import build_map
from groundsbot.offline.maps.files import read_map, write_map
from groundsbot.offline.maps.result import MapResult
from groundsbot.offline.measurements.run import RobotFile, load_run
from groundsbot.offline.measurements.segment import segments_of
from groundsbot.offline.sam.budget import Budget
from groundsbot.offline.sam.parameters import parameters_of_wheels
from groundsbot.offline.self_calibration.information import robot_information, stack_information
from groundsbot.offline.self_calibration.option import NAMES, Calibrate, parse_calibrate
from groundsbot.offline.self_calibration.robot import (
    FREED_SIGMAS,
    Correction,
    OwnedParameter,
    correct_robot,
    open_parameters,
    with_unknown_calibration,
)
from groundsbot.offline.self_calibration.robot_table import AGREES, REQUESTED, verdict_lines
from groundsbot.offline.self_calibration.selection import LESS_CERTAIN, choose
from groundsbot.offline.self_calibration.words import CALIBRATION_DRIVES, refusal_lines
from groundsbot.onboard.log.reading.reader import find_logs
from tests.benchmarks.accuracy.against_bound import with_wide_priors
from tests.offline.self_calibration.calibrated_drives import AUTO, LEGS, NOISE, drive_legs, map_runs, mistaken
from tests.support.data.drives import CAMERA, make_robot
from tests.support.data.sections import dense_of
from tests.support.data.simulated_runs import simulated_runs


@pytest.mark.parametrize("corners", [False, True])
def test_correlated_corner_errors_give_less_information_than_their_scatter(log: Path, corners: bool) -> None:
    (segment,) = segments_of(load_run(log), NOISE)
    found = solve_local_map(segment)
    bias_px = [0.0, 0.2] if corners else [0.2, 0.0]  # either is asked only by what it spoils
    observations = replace(segment.observations, corner_bias_px=np.tile(bias_px, (len(segment.observations), 1)))
    biased = replace(found, segment=replace(segment, observations=observations))
    budgets = [Budget(1e11, 1e9)]
    plain, less = (
        stack_information([robot_information([each], segment.run.robot, NOISE, budgets, corners=corners)])
        for each in (found, biased)
    )
    (at,) = (i for i, each in enumerate(plain.parameters) if each.name == "tag_scale")
    told, told_less = (dense_of(each)[0][:, at, at].sum() for each in (plain, less))
    assert told > 2.0 * told_less > 0.0


def test_sections_do_not_have_the_camera_ahead_of_its_place() -> None:
    """The mean of two drives; with the bias of joint estimates in it (`sam.bias`) it is three sigmas off."""
    off = []
    for seed in (0, 1):
        ((run,), _) = simulated_runs("nsh", seed, ["loop"], exact_calibration=True)
        opened = replace(run, robot=with_unknown_calibration(run.robot))
        maps = [solve_local_map(segment, noise_is_open=True) for segment in segments_of(opened, NOISE)]
        budgets = [Budget(1e11, 1e9) for _ in maps]
        told = stack_information([robot_information(maps, run.robot, NOISE, budgets, corners=False)])
        (ahead,) = (each for each in choose(told) if each.name == "mount_x_m")
        off.append(ahead.value / ahead.sigma)
    assert np.abs(np.mean(off)) < 2.0


def freed_names(result: MapResult) -> set[str]:
    return {each.name for each in result.choices if each.is_freed}


def value_of(result: MapResult, name: str) -> float:
    return next(each.value for each in result.calibration if each.name == name)


def test_a_file_that_is_right_keeps_all_its_numbers(log: Path) -> None:
    result = map_runs(log, make_robot("a"))
    assert {each.name for each in result.choices} == set(NAMES) - {FOCAL_SCALE}
    assert freed_names(result) == set()
    assert all(each.reason for each in result.choices)
    assert AGREES in {each.verdict for each in result.robot_numbers}
    assert verdict_lines(result.robot_numbers) == [
        "robot parameters: these drives agree with robot.yaml in all of them"
    ]
    off = map_runs(log, make_robot("a"), Calibrate())
    assert off.choices == ()
    for a, b in zip(off.components[0].tags, result.components[0].tags, strict=True):
        np.testing.assert_allclose(a.position_m, b.position_m, atol=1e-9)


@pytest.fixture(scope="module")
def overruled(log: Path) -> MapResult:
    return map_runs(log, mistaken(track_m=0.08, yaw_rad=0.06))


def test_what_is_wrong_by_many_sigmas_is_freed_and_found(overruled: MapResult) -> None:
    result = overruled
    assert freed_names(result) == {"track_scale", "mount_yaw_rad"}
    assert value_of(result, "track_scale") == pytest.approx(1.0 / 1.08 - 1.0, abs=2e-3)
    assert value_of(result, "mount_yaw_rad") == pytest.approx(-0.06, abs=3e-3)
    prior = {each.name: each.prior_sigma for each in result.calibration}
    assert prior["track_scale"] == FREED_SIGMAS["track_scale"]
    assert prior["mount_x_m"] == make_robot("a").mount.x_m_sigma


def test_a_late_camera_is_found_where_turns_determine_it(log: Path) -> None:
    result = map_runs(log, make_robot("a").model_copy(update={"time_offset_s": -0.02}))
    assert freed_names(result) == {"time_offset_s"}
    assert value_of(result, "time_offset_s") == pytest.approx(0.02, abs=2e-3)


def test_a_driver_with_a_reaction_time_makes_no_camera_appear_late(tmp_path: Path) -> None:
    drives = tmp_path / "drives"
    simulate(with_wide_priors(load_world("nsh")), 1001, drives, ["hallway"], render=False)
    result = build_map(read_runs(find_logs([drives])), NOISE, calibrate=AUTO)
    (truth,) = json.loads((drives / TRUTH_FILE).read_text())["runs"].values()
    (found,) = (each for each in result.calibration if each.name == "time_offset_s")
    assert found.sigma < 0.005  # of 0.02 that robot.yaml leaves open
    assert found.value == pytest.approx(truth["parameters"]["time_offset_s"], abs=3.3 * found.sigma)


def test_wheels_and_tags_cannot_both_be_freed_and_the_better_known_one_holds_the_scale(log: Path) -> None:
    long_wheels = mistaken(radius_left_m=0.05, radius_right_m=0.05)
    assert freed_names(map_runs(log, long_wheels)) == {
        TAG_SCALE,
        "track_scale",
    }  # robot.yaml trusts wheels to 0.35 %, tags to 0.5 %
    sure = [each.model_copy(update={"sigma_size_m": 1e-4}) for each in long_wheels.tags]
    result = map_runs(log, long_wheels.model_copy(update={"tags": sure}))
    assert freed_names(result) == {"wheel_scale"}
    assert value_of(result, "wheel_scale") == pytest.approx(1.0 / 1.05 - 1.0, abs=3e-3)
    (metre,) = result.scale_budgets
    assert metre.shares["tags"] > 0.9


def test_a_named_parameter_is_freed_alone_and_only_where_drives_determine_it(log: Path) -> None:
    result = map_runs(log, make_robot("a"), Calibrate(is_on=True, names=("wheel_ratio", "wheel_scale")))
    assert freed_names(result) == {"wheel_ratio"}
    reasons = {each.name: each.reason for each in result.choices}
    assert reasons["wheel_scale"] == LESS_CERTAIN
    assert {each.name for each in result.robot_numbers if each.verdict == REQUESTED} == {"wheel_ratio"}
    (refused_line,) = refusal_lines(result)
    assert refused_line.startswith("not freed: wheel_scale of a: kept at robot.yaml's sigma")
    assert "--distance" in refused_line
    assert reasons["track_scale"] == "it was not requested"


def test_corners_determine_the_focal_length_and_the_tilt_of_the_camera(log: Path) -> None:
    camera = replace(CAMERA, fx_px=CAMERA.fx_px / 1.03, fy_px=CAMERA.fy_px / 1.03)
    robot = mistaken(pitch_rad=0.06).model_copy(update={"focal_scale_sigma": 0.002})
    files = {"a": RobotFile(robot, {"": camera})}
    result = build_map(read_runs([log], files), NOISE, corners=True, calibrate=AUTO)
    assert freed_names(result) >= {FOCAL_SCALE, "mount_pitch_rad"}
    assert value_of(result, FOCAL_SCALE) == pytest.approx(0.03, abs=3e-3)
    assert value_of(result, "mount_pitch_rad") == pytest.approx(-0.06, abs=1e-3)
    assert "mount_z_m" not in {each.name for each in result.choices}
    assert result.warnings == ()


def test_a_robot_that_was_corrected_needs_no_more_correction(log: Path) -> None:
    wrong = mistaken(track_m=0.08, radius_left_m=0.02, yaw_rad=0.06, pitch_rad=-0.01)
    result = map_runs(log, wrong)
    learnt = {OwnedParameter(each.owner, each.name): Correction(each.value, each.sigma) for each in result.calibration}
    better = correct_robot(wrong, learnt)
    assert better.wheels.radius_left_m == pytest.approx(0.1, rel=1e-2)
    assert better.wheels.radius_left_m / better.wheels.radius_right_m == pytest.approx(1.0, rel=2e-3)
    assert better.wheels.track_m == pytest.approx(0.5, rel=1e-2)
    again = map_runs(log, better, Calibrate())
    for each in again.calibration:
        assert abs(each.value) < each.sigma, each  # the same drive determines it once more
        assert each.prior_sigma == pytest.approx(learnt[OwnedParameter(each.owner, each.name)].sigma, rel=1e-2)


def test_what_was_learnt_of_edges_is_written() -> None:
    robot = make_robot("a", edge_shift_px=0.02)
    better = correct_robot(robot, {OwnedParameter("a", "edge_shift_px"): Correction(-0.05, 0.004)})
    assert (better.edge_shift_px, better.edge_shift_px_sigma) == pytest.approx((-0.03, 0.004))
    assert open_parameters(robot, {OwnedParameter("a", "edge_shift_px"): 1.0}).edge_shift_px_sigma == 1.0


def test_every_number_that_may_be_freed_can_be_opened() -> None:
    assert set(NAMES) == set(FREED_SIGMAS) == set(CALIBRATION_DRIVES)
    robot = make_robot("a")
    batch = OwnedParameter(f"{robot.tags[0].batch} {robot.tags[0].family}", TAG_SCALE)
    everything = open_parameters(
        robot, {OwnedParameter("a", name): sigma for name, sigma in FREED_SIGMAS.items()} | {batch: 0.15}
    )
    sigmas = dict(zip(WHEEL_PARAMETERS, [each.sigma for each in parameters_of_wheels(everything)], strict=True))
    assert sigmas == pytest.approx({name: FREED_SIGMAS[name] for name in WHEEL_PARAMETERS})
    assert everything.tags[0].relative_sigma == pytest.approx(FREED_SIGMAS[TAG_SCALE])
    assert everything.mount.roll_rad_sigma == FREED_SIGMAS["mount_roll_rad"]
    assert everything.mount.z_m_sigma == robot.mount.z_m_sigma
    assert open_parameters(robot, {}) == robot
    assert open_parameters(robot, {OwnedParameter("another", "track_scale"): 0.1}) == robot


def test_a_name_that_is_none_is_refused() -> None:
    assert parse_calibrate("off") == Calibrate()
    assert parse_calibrate("track_scale, mount_yaw_rad").names == ("track_scale", "mount_yaw_rad")
    with pytest.raises(OfflineError, match=r"--calibrate: 'track' is neither off nor auto .* track_scale"):
        parse_calibrate("track")


def test_choices_are_kept_with_the_map_and_a_kept_map_is_not_calibrated(overruled: MapResult, tmp_path: Path) -> None:
    other = drive_legs(tmp_path / "logs", "b", LEGS[:1])
    write_map(overruled, tmp_path)
    again = read_map(tmp_path)
    assert again.choices == overruled.choices
    with pytest.raises(OfflineError, match="--calibrate: the map to extend is calibrated already"):
        build_map(read_runs([other]), extending=again, calibrate=Calibrate(is_on=True, names=("track_scale",)))
