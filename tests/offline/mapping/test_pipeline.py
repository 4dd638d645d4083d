"""Logs in, one map out: exact where measurements are, the same in any order, in parts where nothing joins them."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.fixtures.simulate import TRUTH_FILE
from groundsbot.fixtures.worlds.world import World, load_world
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.evaluation.against_truth import evaluate
from groundsbot.offline.evaluation.truth import read_truth
from groundsbot.offline.local_map.local_map import solve_local_map
from groundsbot.offline.mapping.inputs import read_runs
from groundsbot.offline.mapping.pipeline import build_map
from groundsbot.offline.maps.result import Component, MapResult
from groundsbot.offline.measurements.run import load_run
from groundsbot.offline.measurements.segment import segments_of
from groundsbot.onboard.log.reading.reader import find_logs
from tests.benchmarks.accuracy.accuracy_study import medians, missed_bounds, run_study, study_seed
from tests.support.data.drives import HALL, MadeDrive, MadeTag, make_drive, make_robot, make_run, write_drive

ROUND = [(0.4, 0.4, 3.0), (0.5, 0.3, 4.0), (-0.2, 0.2, 5.0), (0.3, 0.5, 3.0), (0.4, 0.4, 1.5), (0.2, -0.2, 6.0)]
BACK = [(0.0, 0.0, 1.0), (-0.25, 0.25, 4.0), (0.4, 0.5, 4.0), (0.45, 0.35, 4.0), (-0.3, -0.3, 1.0), (-0.25, 0.25, 4.0)]
STARTS = {"a": [1.0, 1.5, 0.3], "b": [4.5, 2.5, 2.9], "c": [2.5, 3.0, -1.2]}
LEGS = {"a": ROUND, "b": BACK, "c": [*BACK[1:], *ROUND[:3]]}


def drive_of(name: str) -> MadeDrive:
    return make_drive(STARTS[name], LEGS[name])


def exact_log(folder: Path, name: str, tags: Sequence[MadeTag] = tuple(HALL)) -> Path:
    return write_drive(folder, drive_of(name), tags, make_robot(name))


def map_of(*logs: Path) -> MapResult:
    return build_map(read_runs(logs))


def in_frame_of(component: Component, T_frame_map: FloatArray) -> dict[object, FloatArray]:
    """Starts, trajectories and tags of a map, moved into another frame."""
    moved: dict[object, FloatArray] = {tag.tag_id: se2.apply(T_frame_map, tag.position_m) for tag in component.tags}
    return moved | {run.name: se2.compose(T_frame_map, run.T_map_base) for run in component.runs}


def assert_same(a: dict[object, FloatArray], b: dict[object, FloatArray], atol: float = 1e-6) -> None:
    assert a.keys() == b.keys()
    for key, value in a.items():
        other = b[key]
        np.testing.assert_allclose(value[..., :2], other[..., :2], atol=atol, err_msg=str(key))
        if value.shape[-1] == 3:
            np.testing.assert_allclose(se2.wrap_angle(value[..., 2] - other[..., 2]), 0.0, atol=atol, err_msg=str(key))


@pytest.mark.parametrize("names", [("a",), ("a", "b"), ("c", "b", "a")])
def test_exact_measurements_give_the_truth_back(tmp_path: Path, names: tuple[str, ...]) -> None:
    """With constant speeds between wheel readings, fine ticks and exact corners nothing is lost from log to map."""
    result = map_of(*(exact_log(tmp_path, name) for name in names))
    (component,) = result.components
    assert result.warnings == ()
    T_world_map = np.array(STARTS[names[0]])
    assert [tag.tag_id for tag in component.tags] == list(range(8))
    for tag, true in zip(component.tags, HALL, strict=True):
        np.testing.assert_allclose(se2.apply(T_world_map, tag.position_m), true.position_m[:2], atol=1e-6)
    for run, name in zip(component.runs, names, strict=True):
        true_poses = drive_of(name).at(run.stamps_ns)
        error = se2.log(se2.between(true_poses, se2.compose(T_world_map, run.T_map_base)))
        np.testing.assert_allclose(error, 0.0, atol=1e-6)
        assert run.n_keyframes > 50
    for number in result.calibration:
        assert abs(number.value) < 1e-6


def test_a_calibration_that_is_off_is_found(tmp_path: Path) -> None:
    """What the log says and what the robot truly is differ by a sigma or so; exact measurements tell which way."""
    true = make_robot("a")
    log = write_drive(tmp_path, drive_of("a"), HALL, true)
    wrong = {"radius_left_m": 0.1003, "radius_right_m": 0.0999, "track_m": 0.503, "ticks_per_turn": 1e9}
    believed = make_robot("a", wheels=wrong, mount=true.mount.model_dump() | {"yaw_rad": 0.105})
    run = replace(load_run(log), robot=believed)
    stretch = run.wheel_segments[0]
    run = replace(
        run, wheel_segments=(replace(stretch, left_m=stretch.left_m * 1.003, right_m=stretch.right_m * 0.999),)
    )
    found = {p.name: value for p, value in solve_local_map(segments_of(run, map_of(log).noise)[0]).calibration.items()}
    assert found["wheel_ratio"] == pytest.approx(0.004, abs=0.0015)
    assert found["track_scale"] == pytest.approx(0.5 / 0.503 - 1, abs=0.004)
    assert found["mount_yaw_rad"] == pytest.approx(-0.005, abs=0.003)


@pytest.fixture(scope="module")
def room_map(room: Path) -> MapResult:
    return build_map(read_runs(find_logs([room])))


def test_three_runs_merge_as_two_do(room: Path, room_map: MapResult) -> None:
    (component,) = room_map.components
    assert [run.robot_id for run in component.runs] == ["a", "b", "c"]
    assert len(component.start_to_start) == 3
    errors = evaluate(room_map, read_truth(room / TRUTH_FILE)).components[0]
    assert errors.tags_rmse_m is not None
    assert errors.tags_rmse_m < 0.15
    # Under the same noise: what is fitted to three runs differs from what two tell.
    same_noise = room_map.noise
    (two,) = build_map(read_runs(find_logs([room / "a", room / "c"])), noise=same_noise).components
    (three,) = build_map(read_runs(find_logs([room])), noise=same_noise).components
    with_two, with_three = two.start_to_start[0], three.start_to_start[1]
    assert (with_two.a, with_two.b) == (with_three.a, with_three.b)
    spread_m = np.sqrt(np.trace(with_two.covariance))
    # The third run adds what it knows of the tags; of starts that is so little that where all is linearised tells more.
    of_two, of_three = ({tag.tag_id: np.trace(tag.covariance) for tag in each.tags} for each in (two, three))
    assert all(of_three[tag_id] < variance for tag_id, variance in of_two.items())
    assert np.sqrt(np.trace(with_three.covariance)) < 1.001 * spread_m
    assert np.linalg.norm(with_two.vector_m - with_three.vector_m) < 3.0 * spread_m


@pytest.mark.parametrize("order", ["cba", "bca"])
def test_the_order_of_logs_changes_nothing_but_the_frame(room: Path, room_map: MapResult, order: str) -> None:
    (component,) = build_map(read_runs(find_logs([room / name for name in order]))).components
    (reference,) = room_map.components
    assert [run.robot_id for run in component.runs] == list(order)
    first = next(run for run in reference.runs if run.name == component.frame_run)
    assert component.frame_run == f"{order[0]}_seed3"
    assert_same(in_frame_of(component, first.T_map_start), in_frame_of(reference, np.zeros(3)))
    assert component.cost == pytest.approx(reference.cost, abs=1e-7)
    sigma = {pair.a + pair.b: pair.sigma_m for pair in reference.start_to_start}
    for pair in component.start_to_start:
        expected = sigma.get(pair.a + pair.b) or sigma[pair.b + pair.a]
        assert pair.sigma_m == pytest.approx(expected, rel=1e-4)


def test_every_tag_seen_is_in_the_map_once(room: Path, room_map: MapResult) -> None:
    seen = {key[:2] for run in read_runs(find_logs([room])) for key in run.tags}
    assert len(seen) == 8
    assert [(tag.family, tag.tag_id) for tag in room_map.components[0].tags] == sorted(seen)


def test_one_log_alone_gives_its_local_map(room: Path) -> None:
    (log,) = find_logs([room / "b"])
    result = build_map(read_runs([log]), noise=NoiseParameters())
    (component,) = result.components
    local = solve_local_map(segments_of(load_run(log), result.noise)[0])
    np.testing.assert_array_equal(component.runs[0].T_map_base, local.T_start_base)
    assert {(tag.family, tag.tag_id): tuple(tag.position_m) for tag in component.tags} == {
        (key.family, key.tag_id): tuple(place) for key, place in local.tags_m.items()
    }
    assert result.alignments == ()
    assert component.start_to_start == ()
    np.testing.assert_array_equal(component.runs[0].T_map_start, np.zeros(3))


def test_runs_that_nothing_joins_become_further_components_with_the_reason(tmp_path: Path) -> None:
    elsewhere = [replace(tag, tag_id=tag.tag_id + 100) for tag in HALL]
    result = map_of(exact_log(tmp_path, "c", elsewhere), exact_log(tmp_path, "a"), exact_log(tmp_path, "b"))
    assert [[run.robot_id for run in component.runs] for component in result.components] == [["a", "b"], ["c"]]
    assert result.warnings == (
        "component 2: c_one shares no tag with the others; drive it past two tags that another run saw",
    )
    alone = result.components[1]
    assert alone.frame_run == "c_one"
    assert {tag.tag_id for tag in alone.tags} <= {tag.tag_id for tag in elsewhere}
    np.testing.assert_array_equal(alone.runs[0].T_map_start, np.zeros(3))


def test_the_run_nearest_to_joining_tells_the_reason(tmp_path: Path) -> None:
    """Of two runs that stand apart together, one shares a tag with the rest: one more would do."""
    far = [replace(tag, tag_id=tag.tag_id + 100) for tag in HALL]
    logs = [
        exact_log(tmp_path, "a"),
        write_drive(tmp_path, drive_of("b"), far, make_robot("b")),
        write_drive(tmp_path, drive_of("c"), [*far[1:], HALL[0]], make_robot("c")),
    ]
    result = map_of(*logs)
    assert len(result.components) == 2
    assert any("shares only tag 0 with" in warning for warning in result.warnings)


def test_a_run_without_tags_is_a_trajectory_of_its_own(tmp_path: Path) -> None:
    result = map_of(exact_log(tmp_path, "a"), exact_log(tmp_path, "b", ()))
    assert [run.robot_id for component in result.components for run in component.runs] == ["a", "b"]
    blind = result.components[1]
    assert blind.tags == ()
    true = drive_of("b").at(blind.runs[0].stamps_ns)
    error = se2.log(se2.between(se2.between(true[0], true), blind.runs[0].T_map_base))
    np.testing.assert_allclose(error, 0.0, atol=1e-6)
    assert any("b_one saw no tag" in warning for warning in result.warnings)


@pytest.mark.parametrize(
    ("one", "other", "told"),
    [
        (("a_b", "c"), ("a", "b_c"), "run b_c of robot a would be named a_b_c, as run c of robot a_b in"),
        (("a", "c"), ("a", "c_stretch2"), "run c_stretch2 of robot a is named like a segment of a_c"),
        (("a", "c_stretch2"), ("a", "c"), "run c_stretch2 of robot a is named like a segment of a_c"),
    ],
)
def test_runs_of_one_name_are_refused(one: tuple[str, str], other: tuple[str, str], told: str) -> None:
    run = make_run([drive_of("a").track])
    runs = [
        replace(run, name=f"{robot_id}_{run_id}", robot_id=robot_id, run_id=run_id) for robot_id, run_id in (one, other)
    ]
    with pytest.raises(OfflineError, match=told):
        build_map(runs)


def flat_room() -> World:
    """Two drives in the room with drawn calibration, but for what a plan of the floor cannot carry.

    These are roll, pitch, height and time.
    """
    world = load_world("room")
    exact = {f"{name}_sigma": 1e-9 for name in ("z_m", "roll_rad", "pitch_rad")}
    robots = [
        robot.model_copy(
            update={"robot": {**robot.robot, "time_offset_s_sigma": 1e-9, "mount": {**robot.robot["mount"], **exact}}}
        )
        for robot in world.robots[::2]
    ]
    return world.model_copy(update={"robots": robots})


def test_errors_in_a_room_are_as_large_as_the_covariances_say() -> None:
    """Calibration drawn from its priors: then, over a small room, the joint covariance must be honest."""
    world, n_seeds = flat_room(), 16
    figures = [study_seed(seed, world, exact_calibration=False, render=False) for seed in range(n_seeds)]
    for per_dim, n in (("nees_tags", 16 * n_seeds), ("nees_start", 2 * n_seeds)):
        mean = float(np.mean([getattr(each, per_dim) for each in figures]))
        lowest, highest = (chi2(n).ppf(quantile) / n for quantile in (0.0005, 0.9995))
        assert lowest < mean < highest, (per_dim, mean)


def test_a_few_seeds_of_the_floor_hold_the_promised_bounds(capsys: pytest.CaptureFixture[str]) -> None:
    """The whole study is tests/benchmarks/accuracy/accuracy_study.py."""
    figures = run_study("nsh", range(3), exact_calibration=True, render=False)
    # Three seeds are too few for the median of the NEES: a heading that is far off makes its distribution long-tailed.
    missed = missed_bounds(figures, exact_calibration=True, render=False)
    assert [sentence for sentence in missed if "nees_tags" not in sentence] == []
    assert len(capsys.readouterr().out.splitlines()) == 4
    bad = [replace(each, nees_tags=40.0, start_percent=2.0) for each in figures]
    missed = missed_bounds(bad, exact_calibration=True, render=False)
    assert [sentence.split()[1] for sentence in missed] == ["start_percent", "nees_tags"]
    assert medians(figures)["tags_rmse_m"] < 3.0
