"""The map by the joint estimate is complete, whatever drives saw: all that reports, exports and later drives need."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
import pytest

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.commands.map_drives import exit_code
from groundsbot.offline.mapping.frame import parse_frame
from groundsbot.offline.mapping.pipeline import build_map
from groundsbot.offline.maps.files import read_map, write_map
from groundsbot.offline.maps.result import Component, MapResult
from groundsbot.offline.measurements.run import Run
from groundsbot.offline.measurements.tape import TapeOptions
from tests.offline.estimate.made_drives import PLACES, Truth, fit, make_drive

TRUTH: Final = Truth(distance=-0.02, mount=(0.1, 0.0, 0.03), delay_s=0.1, depth=1.0)
ELSEWHERE: Final = {20 + tag_id: place for tag_id, place in PLACES.items()}
SECONDS: Final = 60.0


def run_of(name: str, places: dict[int, tuple[float, float]] | None = None) -> Run:
    return make_drive(name, 1, SECONDS, TRUTH, places or PLACES).run


def with_readings(run: Run, n: int) -> Run:
    """The run with so many of its readings, from the middle on."""
    first = len(run.positions.tag) // 2
    which = np.zeros(len(run.positions.tag), dtype=np.bool_)
    which[first : first + n] = True
    positions = run.positions.where(which)
    seen, tag = np.unique(positions.tag, return_inverse=True)
    return replace(run, tags=tuple(run.tags[i] for i in seen), positions=replace(positions, tag=tag))


@pytest.fixture(scope="module")
def both() -> MapResult:
    """Of two drives."""
    return build_map([run_of("a"), run_of("b")])


@pytest.fixture(scope="module")
def mixed() -> MapResult:
    """Of these two, one that reads no tag, one with a single reading, and one past tags of its own."""
    few = [with_readings(run_of("c"), 0), with_readings(run_of("d"), 1)]
    return build_map([run_of("a"), *few, run_of("b"), run_of("e", ELSEWHERE)])


def assert_complete(component: Component) -> None:
    """Everything is there and finite; nothing but the frame is certain."""
    n = 3 * len(component.runs) + 2 * len(component.tags)
    joint = component.joint_covariance
    assert joint.shape == (n, n)
    np.testing.assert_allclose(joint, joint.T, atol=1e-12 * np.abs(joint).max(initial=0.0))
    np.testing.assert_allclose(component.runs[0].T_map_start, 0.0, atol=1e-12)
    assert np.abs(joint[:3]).max() < 1e-12
    if n > 3:
        sigma = np.sqrt(np.diag(joint)[3:])
        assert np.linalg.eigvalsh(joint[3:, 3:] / np.outer(sigma, sigma)).min() > 0.0
    assert component.frame_run == component.runs[0].name
    for k, run in enumerate(component.runs):
        np.testing.assert_array_equal(run.covariance, joint[3 * k : 3 * k + 3, 3 * k : 3 * k + 3])
        np.testing.assert_array_equal(run.T_map_start, run.T_map_base[0])
        assert len(run.stamps_ns) == len(run.T_map_base)
        assert (np.diff(run.stamps_ns) > 0).all()
        assert run.distance_m > 10.0
    assert component.converged


def test_two_drives_are_one_component_with_their_ten_tags(both: MapResult) -> None:
    (component,) = both.components
    assert_complete(component)
    assert [run.name for run in component.runs] == ["a_one", "b_one"]
    assert [tag.tag_id for tag in component.tags] == sorted(PLACES)
    placed = fit(np.array([tag.position_m for tag in component.tags]), np.array([PLACES[i] for i in sorted(PLACES)]))
    assert placed.rms_m < 0.04
    assert placed.scale == pytest.approx(1.0, abs=0.05)
    assert all(tag.size_m is None and tag.n_observations > 0 for tag in component.tags)
    assert {tag.runs for tag in component.tags} <= {("a_one", "b_one"), ("a_one",), ("b_one",)}
    assert len(component.start_to_start) == 1


def test_sigmas_are_those_of_the_errors(both: MapResult) -> None:
    """Of starts and tags in the frame of the first start, of which the truth is known."""
    (component,) = both.components
    made = {name: make_drive(name, 1, SECONDS, TRUTH) for name in "ab"}
    starts = [made[name].T_world_base[0] for name in "ab"]
    error = [se2.between(component.runs[1].T_map_start, se2.between(starts[0], starts[1]))]
    true = se2.apply(se2.inverse(starts[0]), np.array([PLACES[tag.tag_id] for tag in component.tags]))
    error += list(np.array([tag.position_m for tag in component.tags]) - true)
    off = np.concatenate(error)
    off[:2] = component.runs[1].T_map_start[:2] - se2.between(starts[0], starts[1])[:2]
    per_dimension = off @ np.linalg.solve(component.joint_covariance[3:, 3:], off) / len(off)
    assert 0.3 < per_dimension < 2.0


def test_the_rest_of_the_result_is_there(both: MapResult) -> None:
    (component,) = both.components
    assert both.warnings == ()
    assert both.outliers == ()
    assert exit_code(both) == 0
    (alignment,) = both.alignments
    assert (alignment.from_run, alignment.to_run) == ("a_one", "b_one")
    assert alignment.n_inliers == alignment.n_shared > 5
    assert alignment.inlier_rmse_m < 0.05
    np.testing.assert_allclose(alignment.T_from_to, component.runs[1].T_map_start, atol=1e-9)
    (budget,) = both.scale_budgets
    assert 0.005 < budget.sigma < 0.05
    assert sum(budget.shares.values()) == pytest.approx(1.0)
    assert both.noise_fit is not None
    fitted = {each.name: each.value for each in both.noise_fit.parameters}
    assert fitted["sigma_bearing_rad"] == pytest.approx(0.01, rel=0.5)
    assert both.noise.sigma_bearing_rad == pytest.approx(fitted["sigma_bearing_rad"])
    assert len(both.advice) > 0
    assert both.components[0].calibration is not None


def test_numbers_of_robots_files_have_their_corrections(both: MapResult) -> None:
    """In the terms of robot.yaml: metres, radians, seconds, and relative excess of wheels, track and tags."""
    found = {(each.owner, each.name): each for each in both.calibration}
    for robot in "ab":
        for name, true in (("mount_x_m", 0.1), ("mount_y_m", 0.0), ("mount_yaw_rad", 0.03), ("time_offset_s", 0.1)):
            each = found[robot, name]
            assert abs(each.value - true) < 4.0 * each.sigma, (robot, name)
        wheels = found[robot, "wheel_scale"]
        assert abs(wheels.value - np.expm1(TRUTH.distance)) < 4.0 * wheels.sigma
    archived = both.components[0].calibration
    assert archived is not None
    n = len(archived.values)
    assert archived.covariance.shape == (n, n)
    assert archived.with_tags.shape == (n, 2 * len(both.tags))
    np.testing.assert_allclose(np.sqrt(np.diag(archived.covariance)), [each.sigma for each in both.calibration])
    np.testing.assert_allclose(archived.values, [each.value for each in both.calibration])


def assert_equal(a: Component, b: Component) -> None:
    np.testing.assert_array_equal(a.joint_covariance, b.joint_covariance)
    for mine, other in zip(a.runs, b.runs, strict=True):
        np.testing.assert_allclose(mine.T_map_base, other.T_map_base, atol=1e-8)  # a text file
        np.testing.assert_array_equal(mine.stamps_ns, other.stamps_ns)
    for tag, read in zip(a.tags, b.tags, strict=True):
        assert tag.full_label == read.full_label
        np.testing.assert_array_equal(tag.position_m, read.position_m)


def test_the_map_is_written_and_read_back(both: MapResult, tmp_path: Path) -> None:
    write_map(both, tmp_path)
    read = read_map(tmp_path)
    assert_equal(read.components[0], both.components[0])
    assert read.calibration == both.calibration
    assert read.noise == both.noise
    assert len(read.archived_segments) == 2


def test_a_later_drive_extends_the_map_that_was_read_back(tmp_path: Path) -> None:
    runs = {name: make_drive(name, 1, SECONDS).run for name in "abc"}
    before = build_map([runs["a"], runs["b"]])
    write_map(before, tmp_path)
    (component,) = build_map([runs["c"]], extending=read_map(tmp_path)).components
    assert [run.name for run in component.runs] == ["a_one", "b_one", "c_one"]
    for tag in component.tags:
        assert np.hypot(*(tag.position_m - before.tag(tag.tag_id).position_m)) < 0.1


def test_the_map_of_all_kinds_of_drives_is_written_and_read_back(mixed: MapResult, tmp_path: Path) -> None:
    write_map(mixed, tmp_path)
    read = read_map(tmp_path)
    for a, b in zip(mixed.components, read.components, strict=True):
        assert_equal(a, b)
    assert len(read.archived_segments) == 5


def shape(component: Component) -> FloatArray:
    """Distances between all tags."""
    places = np.array([tag.position_m for tag in component.tags])
    return np.asarray(np.linalg.norm(places[:, None] - places, axis=2))


def test_the_tags_can_be_the_frame(both: MapResult) -> None:
    (framed,) = build_map([run_of("a"), run_of("b")], frame=parse_frame("shape")).components
    assert framed.frame_run is None
    assert framed.datum is not None
    np.testing.assert_allclose(shape(framed), shape(both.components[0]), atol=1e-9)
    common = np.tile(np.eye(2), (len(framed.tags), 1))
    np.testing.assert_allclose(framed.tag_covariance @ common, 0.0, atol=1e-10)  # no shift of all is uncertain
    assert np.trace(framed.tag_covariance) < np.trace(both.components[0].tag_covariance)


def test_another_start_can_be_the_frame(both: MapResult) -> None:
    (framed,) = build_map([run_of("a"), run_of("b")], frame=parse_frame("start:b_one")).components
    assert framed.frame_run == "b_one"
    np.testing.assert_allclose(framed.run("b_one").T_map_start, 0.0, atol=1e-12)
    np.testing.assert_allclose(framed.run("b_one").covariance, 0.0, atol=1e-10)
    np.testing.assert_allclose(shape(framed), shape(both.components[0]), atol=1e-9)


def test_a_drive_alone_is_a_map() -> None:
    result = build_map([run_of("a")])
    (component,) = result.components
    assert_complete(component)
    assert len(component.tags) == 9  # that it saw
    assert result.alignments == ()
    assert len(result.archived_segments) == 1


def by_first_run(result: MapResult) -> dict[str, Component]:
    return {component.runs[0].name: component for component in result.components}


def test_drives_that_nothing_joins_are_components_of_their_own(mixed: MapResult) -> None:
    found = by_first_run(mixed)
    assert mixed.components[0].runs[0].name == "a_one"
    assert {name: len(each.tags) for name, each in found.items()} == {"a_one": 10, "c_one": 0, "d_one": 1, "e_one": 10}
    assert [run.name for run in found["a_one"].runs] == ["a_one", "b_one"]
    for name in ("c_one", "d_one", "e_one"):
        assert sum(name in warning for warning in mixed.warnings) >= 1


@pytest.mark.parametrize("name", ["a_one", "e_one", "c_one", "d_one"])
def test_each_component_is_complete(mixed: MapResult, name: str) -> None:
    assert_complete(by_first_run(mixed)[name])


def test_drives_that_saw_little_change_nothing_for_the_others(mixed: MapResult, both: MapResult) -> None:
    a, b = mixed.components[0], both.components[0]
    np.testing.assert_allclose(shape(a), shape(b), atol=1e-6)
    np.testing.assert_allclose(a.joint_covariance, b.joint_covariance, rtol=1e-3, atol=1e-8)


@pytest.mark.parametrize("n_drives", [1, 2])
def test_drives_without_any_reading_are_trajectories(n_drives: int) -> None:
    runs = [with_readings(run_of(name), 0) for name in "ab"[:n_drives]]
    result = build_map(runs)
    assert len(result.components) == n_drives
    for component in result.components:
        assert_complete(component)
        assert component.tags == ()


def distance(result: MapResult, a: int, b: int) -> float:
    return float(np.hypot(*(result.tag(a).position_m - result.tag(b).position_m)))


def map_with(*distances: str, runs: Sequence[str] = ("a", "b")) -> MapResult:
    return build_map([run_of(name) for name in runs], tape=TapeOptions(distances=distances))


def test_a_measured_distance_gives_the_scale(both: MapResult) -> None:
    true_m = float(np.hypot(*np.subtract(PLACES[0], PLACES[4])))
    result = map_with(f"0,4={true_m:.4f},0.01")
    (told,) = result.measurements
    assert (told.kind, told.component, told.contradicts) == ("distance", 0, False)
    assert told.in_map is not None
    assert distance(result, 0, 4) == pytest.approx(told.in_map[0], abs=1e-6)
    assert distance(result, 0, 4) == pytest.approx(true_m, abs=0.03)
    places = np.array([tag.position_m for tag in result.tags])
    assert fit(places, np.array([PLACES[tag.tag_id] for tag in result.tags])).scale == pytest.approx(1.0, abs=0.006)
    assert result.scale_budgets[0].sigma < 0.3 * both.scale_budgets[0].sigma


def test_a_wrong_distance_is_told_to_contradict_the_map(both: MapResult) -> None:
    wrong_m = distance(both, 8, 9) + 1.0
    told = map_with(f"8,9={wrong_m:.3f},0.01").measurements[0]
    assert told.contradicts
    assert told.off_sigmas is not None
    assert told.off_sigmas > 4.0
