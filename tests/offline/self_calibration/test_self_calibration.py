"""Self-calibration frees what drives determine and robot.yaml has wrong, and nothing else; `calibrate` writes it."""

import json
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from groundsbot.calib.camera.file import read_camera_yaml
from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.calib.robot.parameters import FOCAL_SCALE, TAG_SCALE, WHEEL_PARAMETERS
from groundsbot.calib.robot.robot_yaml import Robot, read_robot_yaml, write_robot_yaml
from groundsbot.fixtures.simulate import TRUTH_FILE, simulate
from groundsbot.fixtures.worlds.world import load_world
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.local_map.local_map import solve_local_map
from groundsbot.offline.mapping.inputs import read_runs
from groundsbot.offline.mapping.pipeline import build_map
from groundsbot.offline.maps.files import read_map, write_map
from groundsbot.offline.maps.parameter_results import CalibrationChoice
from groundsbot.offline.maps.result import MapResult
from groundsbot.offline.measurements.run import RobotFile, load_run, read_robot_file
from groundsbot.offline.measurements.segment import segments_of
from groundsbot.offline.sam.budget import Budget
from groundsbot.offline.sam.parameters import Parameter, parameters_of_wheels
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
from groundsbot.offline.self_calibration.robot_table import AGREES, REQUESTED, WRONG, verdict_lines
from groundsbot.offline.self_calibration.section_estimates import CalibrationInformation
from groundsbot.offline.self_calibration.selection import LESS_CERTAIN, choose, is_overruled
from groundsbot.offline.self_calibration.self_calibration import empirical_sigma
from groundsbot.offline.self_calibration.words import CALIBRATION_DRIVES, refusal_lines
from groundsbot.onboard.log.reading.reader import find_logs
from tests.benchmarks.accuracy.against_bound import with_wide_priors
from tests.support.data.drives import CAMERA, MadeTag, make_drive, make_robot, picture_stamps, write_drive
from tests.support.data.simulated_runs import simulated_runs
from tests.support.programs import Run as Program

NOISE = NoiseParameters()
AUTO = Calibrate(is_on=True)
# To and fro in a room, with whole turns on the spot to either side.
LEGS = [(0.5, 0.52, 6.0), (-0.3, 0.3, 7.9), (0.5, 0.5, 6.0), (0.3, -0.3, 7.8)] * 2
TAGS = [
    MadeTag(3 * i + j, (x, y, 0.3 + 0.2 * j), yaw)
    for i, (x, y, yaw) in enumerate(
        [
            (7.0, 0.0, np.pi),
            (7.0, 3.0, np.pi),
            (-4.0, 0.5, 0.0),
            (-4.0, 3.0, 0.0),
            (2.0, -4.0, np.pi / 2),
            (2.0, 7.0, -np.pi / 2),
        ]
    )
    for j in range(2)
]


def drive_legs(folder: Path, name: str, legs: Sequence[tuple[float, float, float]]) -> Path:
    drive = make_drive([0.0, 0.0, 0.0], legs)
    pictures_ns = picture_stamps(drive, 3.7)
    return write_drive(folder, drive, TAGS, make_robot(name), corner_sigma_px=0.2, pictures_ns=pictures_ns)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("drive")
    return drive_legs(folder, "a", LEGS)


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
    assert plain.information[:, at, at].sum() > 2.0 * less.information[:, at, at].sum() > 0.0


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


def mistaken(**changes: float) -> Robot:
    """The robot's file with some numbers wrong: of wheels by a share, of the mount as they are."""
    robot = make_robot("a")
    wheels = {name: getattr(robot.wheels, name) * (1.0 + off) for name, off in changes.items() if "radius" in name}
    if "track_m" in changes:
        wheels["track_m"] = robot.wheels.track_m * (1.0 + changes["track_m"])
    mount = {name: getattr(robot.mount, name) + changes[name] for name in changes if hasattr(robot.mount, name)}
    return robot.model_copy(
        update={"wheels": robot.wheels.model_copy(update=wheels), "mount": robot.mount.model_copy(update=mount)}
    )


def map_runs(log: Path, robot: Robot, calibrate: Calibrate = AUTO, *, corners: bool = False) -> MapResult:
    files = {"a": RobotFile(robot, {"": CAMERA})}
    return build_map(read_runs([log], files), NOISE, corners=corners, calibrate=calibrate)


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


def made_information(
    values: list[list[float]], sigmas: list[list[float]], priors: dict[str, float]
) -> CalibrationInformation:
    """Segments that each determine each number by itself."""
    information = np.array([np.diag(1.0 / np.square(each)) for each in sigmas])
    vector = np.einsum("sij,sj->si", information, np.array(values))
    return CalibrationInformation(
        tuple(Parameter("r", name, (), sigma) for name, sigma in priors.items()), information, vector
    )


def choice(
    values: list[float], sigmas: list[float], prior: float = 0.01, name: str = "track_scale"
) -> CalibrationChoice:
    (found,) = choose(made_information([[each] for each in values], [[each] for each in sigmas], {name: prior}))
    return found


@pytest.mark.parametrize(
    ("values", "sigmas", "name", "reason"),
    [
        ([0.05, 0.051, 0.049], [0.001] * 3, "track_scale", ""),
        ([0.02, 0.021, 0.019], [0.001] * 3, "track_scale", "agrees"),
        ([0.03, 0.01, -0.02], [0.05] * 3, "track_scale", "less well"),
        ([0.1, 0.101, 0.099], [0.05] * 3, "track_scale", ""),  # 3.3 sigma off, and the sections confirm it
        ([0.2, 0.02], [0.03] * 2, "track_scale", "predict the others"),  # 4.7 sigma off, but only one section says so
        ([0.5, 0.1, -0.1], [0.05] * 3, "track_scale", "predict the others"),
        ([0.08, 0.02, 0.05], [0.001] * 3, "track_scale", "predict the others"),
        ([0.8, 0.801, 0.799], [0.001] * 3, "track_scale", "too much for a calibration error"),
        ([0.05, 0.0], [0.001, 9.0], "track_scale", "only one section"),
        ([0.05, 0.051, 0.049], [0.001] * 3, "time_offset_s", ""),
    ],
)
def test_each_condition_holds_a_number_back(values: list[float], sigmas: list[float], name: str, reason: str) -> None:
    found = choice(values, sigmas, name=name)
    assert found.is_freed == (not reason)
    assert reason in found.reason


def test_the_report_is_the_weighted_mean_and_its_difference_from_the_file() -> None:
    found = choice([0.05, 0.06], [0.001, 0.002])
    # A number that is freed has a wide sigma of its own.
    assert found.value == pytest.approx((0.05 + 0.06 / 4) / 1.25, rel=1e-4)
    assert found.sigma == pytest.approx(0.001 / np.sqrt(1.25), rel=1e-4)
    assert found.off_sigmas == pytest.approx(found.value / np.hypot(0.01, found.sigma), rel=1e-4)
    # By hand: each from N(the other; both variances), against N(0; its own and the prior's).
    apart, both = 0.01**2, 0.001**2 + 0.002**2
    gain = -(apart / both + np.log(both))
    gain += sum(0.5 * (x**2 / (s**2 + 1e-4) + np.log(s**2 + 1e-4)) for x, s in ((0.05, 0.001), (0.06, 0.002)))
    assert found.held_out_gain == pytest.approx(gain)


@pytest.mark.parametrize(("value", "sigma", "expected"), [(0.02, 0.03, 0.108), (0.6, 0.05, 0.5), (0.0, 1e-4, 0.01)])
def test_numbers_of_an_overruled_file_are_as_uncertain_as_sections_show(
    value: float, sigma: float, expected: float
) -> None:
    """Not wider than for any robot, nor narrower than robot.yaml has it."""
    made = replace(choice([0.0], [1.0], name="mount_x_m"), value=value, sigma=sigma, prior_sigma=0.01)
    assert empirical_sigma(made) == pytest.approx(expected, abs=1e-3)


def test_a_file_that_is_right_is_called_wrong_once_in_a_hundred_maps() -> None:
    rng = np.random.default_rng(5)
    sigmas = [0.002 * rng.uniform(0.5, 2.0, len(NAMES)) for _ in range(4)]
    n_freed = 0
    for _ in range(400):
        true = 0.01 * rng.standard_normal(len(NAMES))
        values = [(true + each * rng.standard_normal(len(NAMES))).tolist() for each in sigmas]
        choices = choose(made_information(values, [each.tolist() for each in sigmas], dict.fromkeys(NAMES, 0.01)))
        n_freed += any(each.is_freed for each in choices)
    assert n_freed <= 11  # of 400 at 1 %: more happens once in 500 times


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


def test_what_is_off_by_far_only_as_long_as_others_are_held_overrules_the_file_too() -> None:
    """Segments determine the sum of track and mount, and next to nothing of the one without the other."""
    together, mount = np.array([1.0, 0.5]), np.array([0.0, 1.0])
    ahead = [1.2, -0.9, 1.1, -1.0]
    information = np.array([np.outer(together, together) / 0.01**2 + np.outer(mount, mount) / 0.8**2] * len(ahead))
    vector = np.array([each @ np.array([-0.45 - 0.5 * m, m]) for each, m in zip(information, ahead, strict=True)])
    parameters = (Parameter("r", "track_scale", (), 0.01), Parameter("r", "mount_x_m", (), 0.005))
    choices = choose(CalibrationInformation(parameters, information, vector))
    assert is_overruled(choices)
    mild = choose(CalibrationInformation(parameters, information, 0.2 * vector))
    assert [each.is_freed for each in mild] == [True, False]
