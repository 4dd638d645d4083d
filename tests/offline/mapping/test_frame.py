"""The frame that `--frame` chooses: the same map in it, with covariances that errors confirm."""

import json
from copy import deepcopy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

import groundsbot
from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.offline.evaluation.against_truth import evaluate
from groundsbot.offline.evaluation.truth import TrueRun, Truth
from groundsbot.offline.localization.localization import localize, localize_maps
from groundsbot.offline.localization.map_prior import prior_from_map
from groundsbot.offline.localization.online.prior import CalibrationNumbers, OnlinePrior
from groundsbot.offline.mapping.frame import in_frame, parse_frame
from groundsbot.offline.mapping.pipeline import build_map
from groundsbot.offline.mapping.workings import Diagnostics
from groundsbot.offline.maps.fit_results import Misfit
from groundsbot.offline.maps.frame import CrossCovariances, relative_to_tags
from groundsbot.offline.maps.json_document import map_as_json
from groundsbot.offline.maps.result import Component, MapResult
from groundsbot.offline.maps.widening import TagScatter, inflate_covariances
from tests.benchmarks.accuracy.localize_study import N_CROSSINGS, TAG_SPACING_M, Scene, make_scene
from tests.offline.localization.test_localization import PLACES
from tests.offline.mapping.framed_maps import NOISE, T_SURVEY_WORLD, in_own_axes, places_of, run_of, write_survey
from tests.support.data.drives import (
    HALL,
    make_drive,
    make_robot,
    write_drive,
)
from tests.support.data.long_drives import make_town


@pytest.mark.parametrize("frame", ["shape", "start:b_one", "survey"])
def test_the_map_is_the_same_but_for_its_frame(known: MapResult, tmp_path: Path, frame: str) -> None:
    text = write_survey(tmp_path / "survey.csv", (1, 2, 3, 4, 5)) if frame == "survey" else frame
    workings = Diagnostics()
    found = build_map([run_of("a"), run_of("b")], NOISE, frame=parse_frame(text), workings=workings)
    (before,), (after,) = known.components, found.components
    T = after.runs[0].T_map_start
    np.testing.assert_allclose(places_of(after), se2.apply(T, places_of(before)), atol=1e-9)
    for a, b in zip(before.runs, after.runs, strict=True):
        np.testing.assert_allclose(b.T_map_base, se2.compose(T, a.T_map_base), atol=1e-9)
    (entry,) = map_as_json(found)["components"]
    assert ("datum" in entry) == (after.datum is not None) == (entry["frame_run"] is None)
    # What the report draws is in the map's frame too.
    (solved,) = workings.components
    np.testing.assert_allclose(solved.poses_of(1), after.runs[1].T_map_base, atol=1e-12)
    off = se2.between(solved.group.T_frame_start[1], after.runs[1].T_map_start)
    assert np.abs(off).max() < 0.1
    shape, own_shape = (relative_to_tags(each, np.ones(6))[6:, 6:] for each in (before, after))
    np.testing.assert_allclose(np.linalg.eigvalsh(own_shape), np.linalg.eigvalsh(shape), atol=1e-12)
    for old, new in zip(known.advice, found.advice, strict=True):
        np.testing.assert_allclose(new.way_m, se2.apply(T, old.way_m), atol=1e-9)
        assert (new.tags, new.sigma_then_m, new.of_shape) == (old.tags, old.sigma_then_m, True)
    if frame == "shape":
        assert np.trace(after.tag_covariance) == pytest.approx(np.trace(shape), rel=1e-9)
        np.testing.assert_allclose(places_of(after).mean(axis=0), 0.0, atol=1e-9)
    if frame == "survey":
        world = se2.apply(T_SURVEY_WORLD, np.array(list(PLACES.values())))
        assert np.abs(places_of(after) - world).max() < 0.05
        assert found.warnings == known.warnings


def test_without_a_choice_files_say_nothing_of_a_frame(known: MapResult) -> None:
    for frame in ("start", "start:a_one"):
        same = build_map([run_of("a"), run_of("b")], NOISE, frame=parse_frame(frame))
        assert json.dumps(map_as_json(same)) == json.dumps(map_as_json(known))
    (entry,) = map_as_json(known)["components"]
    assert entry["frame_run"] == "a_one"
    assert "datum" not in entry


def test_the_frame_of_another_start_is_that_of_runs_in_another_order(tmp_path: Path) -> None:
    """On corners, so that poses of tags and calibration are compared, which have covariances with the starts."""
    legs = [(-0.3, 0.3, 5.0), (0.4, 0.4, 1.5), (-0.3, 0.3, 5.0)]
    for name, start in (("a", [1.0, 1.5, 0.3]), ("b", [4.0, 2.5, 2.9])):
        drive = make_drive(start, legs, step_ns=50_000_000)
        write_drive(tmp_path, drive, [HALL[i] for i in (0, 1, 2, 6)], make_robot(name), corner_sigma_px=0.2)
    a, b = (groundsbot.load_run(tmp_path / name / "one") for name in "ab")
    noise = NoiseParameters(sigma_corner_px=0.3)
    (moved,) = build_map([a, b], noise, corners=True, frame=parse_frame("start:b_one")).components
    (solved,) = build_map([b, a], noise, corners=True).components
    assert moved.frame_run == solved.frame_run == "b_one"
    for one, other in zip(moved.tags, solved.tags, strict=True):
        assert one.tag_id == other.tag_id
        assert one.pose is not None
        assert other.pose is not None
        np.testing.assert_allclose(one.position_m, other.position_m, atol=1e-4)
        np.testing.assert_allclose(one.pose.quaternion_xyzw, other.pose.quaternion_xyzw, atol=1e-4)
        assert_near(one.pose.covariance, other.pose.covariance)
    order = [3, 4, 5, 0, 1, 2, *range(6, 14)]
    assert_near(moved.joint_covariance[np.ix_(order, order)], solved.joint_covariance)
    assert moved.calibration is not None
    assert solved.calibration is not None
    assert (moved.calibration.owners, moved.calibration.names) == (solved.calibration.owners, solved.calibration.names)
    sigmas = np.outer(
        np.sqrt(np.diag(solved.calibration.covariance)), np.sqrt(np.diag(solved.joint_covariance[6:, 6:]))
    )
    assert (np.abs(moved.calibration.with_tags - solved.calibration.with_tags) < 0.01 * sigmas).all()


def assert_near(covariance: FloatArray, other: FloatArray) -> None:
    """Within a hundredth of the sigmas."""
    sigmas = np.sqrt(np.diag(other))
    assert (np.abs(covariance - other) <= 0.01 * np.outer(sigmas, sigmas) + 1e-15).all()


def test_errors_confirm_the_covariances() -> None:
    """Of maps of simulated drives, and of drives located in them: positions of tags, their length, and final poses."""
    squares: dict[str, list[float]] = {"tags": [], "starts": [], "poses": [], "lengths": []}
    n_shape, n_scenes = 0, 0
    for seed in range(100, 110):
        scene = make_scene(seed)
        if scene is None or scene.moved:
            continue
        known = in_own_axes(scene.known)
        (component,) = known.components
        true = truth_of(scene, seed, component)
        errors = evaluate(known, true).components[0]
        assert errors.nees_tags_per_dim is not None
        assert errors.nees_start_per_dim is not None
        n_scenes, n_own = n_scenes + 1, 2 * len(component.tags) - 3  # three coordinates hold the frame
        n_shape += n_own
        squares["tags"].append(n_own * errors.nees_tags_per_dim)
        squares["starts"].append(4 * errors.nees_start_per_dim)
        squares["lengths"].append(
            sum(tag.error_m**2 for tag in errors.tags) / sum(tag.sigma_m**2 for tag in errors.tags)
        )
        places = np.array([true.tags_m[(tag.family, tag.tag_id, "")] for tag in component.tags])
        T_map_town = se2.fit_transform(places_of(component), places)
        end = se2.compose(T_map_town, se2.compose(scene.drive.T_town_start, scene.drive.T_start_base[-1]))
        for run in localize_maps([scene.local_map], known).runs:
            error = run.T_map_base[-1] - end
            error[2] = se2.wrap_angle(error[2])
            squares["poses"].append(float(error @ np.linalg.solve(run.covariance[-1], error)))
    # Calibration is nominal in truth, so that squares are a little below chance.
    for name, n in (("tags", n_shape), ("starts", 4 * n_scenes), ("poses", 3 * len(squares["poses"]))):
        assert chi2.ppf(1e-4, n) < sum(squares[name]) < chi2.isf(1e-4, n), name
    assert 0.6 < np.mean(squares["lengths"]) < 1.6  # with sigmas seen from a start it would be 0.05


def truth_of(scene: Scene, seed: int, component: Component) -> Truth:
    """The truth of a scene's map."""
    runs = {
        drive.segment.run.name: TrueRun(drive.segment.stamps_ns, se2.compose(drive.T_town_start, drive.T_start_base))
        for drive in scene.map_drives
    }
    tags_m = make_town(seed, TAG_SPACING_M, N_CROSSINGS).tags_m
    return Truth(runs, {(tag.family, tag.tag_id, ""): tags_m[tag.tag_id] for tag in component.tags}, frozenset())


def test_a_drive_is_located_as_in_the_default_map_moved(known: MapResult) -> None:
    """Where the map's tags, as the drive moves them, lie best on the map's: there the frame is."""
    run = run_of("c")
    in_start, in_tags = (
        localize(run, known, noise=NOISE).runs[0],
        localize(run, in_own_axes(known), noise=NOISE).runs[0],
    )
    ends = [se2.between(each.T_map_base[0], each.T_map_base[-1]) for each in (in_start, in_tags)]
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-5)
    T = in_own_axes(known).components[0].runs[0].T_map_start
    off = in_tags.T_map_base[0] - se2.compose(T, in_start.T_map_base[0])
    assert (np.abs(off) < 0.5 * np.sqrt(np.diag(in_start.covariance[0]))).all()
    assert (np.linalg.eigvalsh(in_start.covariance) > np.linalg.eigvalsh(in_tags.covariance)).all()


def test_all_tags_that_hold_a_frame_are_a_prior() -> None:
    """Their covariance is singular; also where it is of metres, conditionals of the last tags are not rounding."""
    scene = make_scene(100)
    assert scene is not None
    (component,) = in_own_axes(scene.known).components
    assert component.calibration is not None
    loose = replace(
        component,
        joint_covariance=100.0 * component.joint_covariance,
        calibration=replace(component.calibration, with_tags=10.0 * component.calibration.with_tags),
    )
    known = prior_from_map(loose, "map")
    first, n = 2 * len(known.tags), len(known.calibration.values)
    in_map = first + np.arange(n)
    numbers = CalibrationNumbers(
        known.calibration.values, known.covariance[np.ix_(in_map, in_map)], np.arange(n), in_map
    )
    prior = OnlinePrior(known, numbers, known.calibration.values)
    for tag, place in zip(known.tags, known.places_m, strict=True):
        prior.add(place, tag)
    rows = np.concatenate([in_map, np.arange(first)])
    whitened = prior.root @ known.covariance[np.ix_(rows, rows)] @ prior.root.T
    np.testing.assert_allclose(whitened, np.eye(len(rows)), atol=0.01)


def test_covariances_that_were_inflated_are_so_in_any_frame(known: MapResult) -> None:
    """Those with the starts too, which are not among the map's."""
    (component,) = known.components
    assert component.calibration is not None
    n_numbers, n_tags = len(component.calibration.values), len(component.tags)
    cross = CrossCovariances(1e-4 * np.random.default_rng(2).normal(size=(n_numbers, 6)), None)
    scatter = TagScatter(np.ones(n_tags), np.zeros((n_tags, 2, 2)))
    inflated = inflate_covariances(deepcopy(component), Misfit("joins", "a_one", 90.0, 10), scatter)
    plain, wide = (
        in_frame(each, parse_frame("start:b_one"), lambda: cross).component for each in (component, inflated)
    )
    np.testing.assert_allclose(wide.joint_covariance, 9.0 * plain.joint_covariance, rtol=1e-9, atol=1e-15)
    assert plain.calibration is not None
    assert wide.calibration is not None
    np.testing.assert_allclose(wide.calibration.with_tags, 9.0 * plain.calibration.with_tags, rtol=1e-9, atol=1e-15)
