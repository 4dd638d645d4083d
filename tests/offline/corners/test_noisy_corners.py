"""A map refined on noisy corners: covariances, edges, and pictures that are tilted."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.calib.tags.edges import outward
from groundsbot.fixtures.simulate import TRUTH_FILE, simulate
from groundsbot.offline.corners import bundle_adjustment
from groundsbot.offline.corners.bundle_adjustment import refine
from groundsbot.offline.corners.edge_directions import with_predicted_facings
from groundsbot.offline.corners.factors import SpatialState
from groundsbot.offline.corners.floor_noise import fit_attitude_sigmas, initial_attitude_sigmas, with_attitude_sigmas
from groundsbot.offline.corners.graph import corner_graph
from groundsbot.offline.corners.initial_tag_poses import alternative_states, with_alternative_tag_poses
from groundsbot.offline.corners.problem import CornerProblem
from groundsbot.offline.corners.solver import solve_corners
from groundsbot.offline.evaluation.against_truth import evaluate
from groundsbot.offline.evaluation.truth import read_truth
from groundsbot.offline.global_map.edges import edges_of
from groundsbot.offline.global_map.joint_solve import component_of
from groundsbot.offline.mapping.inputs import read_runs
from groundsbot.offline.mapping.pipeline import build_map
from groundsbot.offline.mapping.workings import Diagnostics
from groundsbot.offline.maps.model import MapModel
from groundsbot.offline.maps.result import MapResult
from groundsbot.offline.measurements.sensor_model.corner_bias import refined_bias_px
from groundsbot.offline.sam.arrowhead.build import compiled_motions
from groundsbot.offline.sam.graph import Graph
from groundsbot.onboard.log.reading.reader import find_logs


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, MapResult, Diagnostics]:
    folder, workings = tmp_path_factory.mktemp("drives") / "room", Diagnostics()
    simulate("room", 3, folder, render=False)
    return folder, build_map(read_runs(find_logs([folder])), corners=True, workings=workings), workings


def test_noisy_corners_give_smaller_and_consistent_covariances(room: tuple[Path, MapResult, Diagnostics]) -> None:
    """Chi-square of one map's joint errors, 99.9 %; and every start better known than on the floor."""
    folder, result, workings = room
    (component,) = result.components
    assert component.model is MapModel.CORNERS
    errors = evaluate(result, read_truth(folder / TRUTH_FILE)).components[0]
    n = 2 * len(component.tags)
    assert errors.nees_tags_per_dim is not None
    assert chi2.ppf(0.0005, n) < n * errors.nees_tags_per_dim < chi2.ppf(0.9995, n)
    floor = component_of(workings.components[0].graph, workings.components[0].solution)
    for refined, known in zip(component.start_to_start, floor.start_to_start, strict=True):
        assert np.linalg.det(refined.covariance) < np.linalg.det(known.covariance)
    np.testing.assert_array_equal(workings.components[0].poses_of(1), component.runs[1].T_map_base)


def test_errors_of_tag_poses_agree_with_their_covariance(room: tuple[Path, MapResult, Diagnostics]) -> None:
    """Six numbers each against the truth, 99.99 %: what turns them is the map's heading, about the vertical of map."""
    folder, result, _ = room
    told = json.loads((folder / TRUTH_FILE).read_text())
    frame = np.array(told["runs"][result.components[0].frame_run]["poses"][0][1:])
    true_tags = {tag["tag_id"]: tag for tag in told["tags"]}
    for tag in result.components[0].tags:
        assert tag.pose is not None
        true = true_tags[tag.tag_id]
        place = se2.apply(se2.inverse(frame), np.array(true["position_m"][:2]))
        turn = Rotation.from_euler("z", -frame[2]) * Rotation.from_quat(true["quaternion_xyzw"])
        off = Rotation.from_quat(tag.pose.quaternion_xyzw) * turn.inv()
        error = np.concatenate([tag.position_m - place, [tag.pose.height_m - true["position_m"][2]], off.as_rotvec()])
        assert error @ np.linalg.solve(tag.pose.covariance, error) < chi2.isf(1e-4, 6)
        assert tag.pose.covariance[5, 5] > 2.0 * max(tag.pose.covariance[3, 3], tag.pose.covariance[4, 4])


def test_covariances_are_those_of_the_whole_matrix(room: tuple[Path, MapResult, Diagnostics]) -> None:
    _, result, workings = room
    solved = workings.components[0]
    corners, start = corner_graph(solved.graph, solved.solution.state)
    found = solve_corners(corners.problem, start)
    assert found.converged
    normals, _ = corners.problem.linearise(found.state)
    n = corners.problem.columns.n
    H = np.zeros((n + 1, n + 1))
    for columns, normal in zip(corners.problem.kinds(), normals, strict=True):
        np.add.at(H, (columns[:, :, None], columns[:, None, :]), normal.matrix)
    inverse = np.linalg.inv(H[:n, :n])
    of = corners.problem.columns
    wanted = np.concatenate([of.poses[solved.graph.first_pose].ravel(), of.tags.ravel()])
    expected = np.where((wanted >= 0)[:, None] & (wanted >= 0), inverse[np.ix_(wanted, wanted)], 0.0)
    sigmas = np.sqrt(np.diag(expected)) + (wanted < 0)
    np.testing.assert_allclose(
        found.covariance(wanted) / np.outer(sigmas, sigmas), expected / np.outer(sigmas, sigmas), atol=1e-4
    )
    tags = slice(3 * len(solved.graph.segments), None)
    np.testing.assert_allclose(result.components[0].tag_covariance, expected[tags, tags], rtol=1e-2, atol=1e-8)


def test_edges_of_a_refined_map_are_what_the_map_has(room: tuple[Path, MapResult, Diagnostics]) -> None:
    _, result, workings = room
    component, edges = result.components[0], result.components[0].edges
    assert edges is not None
    poses = np.concatenate([run.T_map_base for run in component.runs])
    tags: FloatArray = np.array([tag.position_m for tag in component.tags])
    np.testing.assert_allclose(se2.apply(poses[edges.pose], edges.place_m), tags[edges.tag], atol=1e-9)
    np.testing.assert_allclose(se2.compose(poses[edges.first], edges.motion)[:, :2], poses[edges.first + 1, :2])
    floor = edges_of(workings.components[0].graph, workings.components[0].solution)
    np.testing.assert_array_equal(edges.place_information, floor.place_information)


def test_a_factor_beyond_the_budget_of_its_logs_leaves_the_map_on_the_floor(
    room: tuple[Path, MapResult, Diagnostics], monkeypatch: pytest.MonkeyPatch
) -> None:
    solved = room[2].components[0]
    assert refine(solved.graph, solved.solution)[0] is not None
    monkeypatch.setattr(bundle_adjustment, "_FREE_FACTOR_BYTES", 1 << 20)
    monkeypatch.setattr(bundle_adjustment, "_FACTOR_BYTES_PER_BYTE", 0)
    refined, (sentence,) = refine(solved.graph, solved.solution)
    assert refined is None
    assert "limit 1 MiB" in sentence
    assert "the map has planar tag positions only" in sentence


def test_sides_face_as_the_start_of_the_solve_predicts(room: tuple[Path, MapResult, Diagnostics]) -> None:
    """As seen they would be some sigma_corner_px over a side's length tilted."""
    solved = room[2].components[0]
    corners, start = corner_graph(solved.graph, solved.solution.state)
    looks = corners.problem.corners.observations
    expected = with_predicted_facings(corners.problem.corners, start).observations.outward
    np.testing.assert_array_equal(looks.outward, expected)
    assert np.abs(looks.outward - outward(looks.corners_px)).max() > 1e-3


def test_correlated_errors_of_corners_add_to_their_noise(room: tuple[Path, MapResult, Diagnostics]) -> None:
    solved = room[2].components[0]

    def sigmas_px(graph: Graph) -> FloatArray:
        return corner_graph(graph, solved.solution.state)[0].problem.corners.observations.sigma_px

    biased = [
        replace(segment.observations, corner_bias_px=refined_bias_px(segment.observations.corners_px))
        for segment in solved.graph.segments
    ]
    segments = [
        replace(segment, observations=each) for segment, each in zip(solved.graph.segments, biased, strict=True)
    ]
    times = np.concatenate([each.corner_sigmas for each in biased])
    bias_px = np.concatenate([each.corner_bias_px[:, 1] for each in biased])
    wanted = np.hypot(sigmas_px(solved.graph), times * bias_px)
    np.testing.assert_allclose(sigmas_px(replace(solved.graph, segments=tuple(segments))), wanted, rtol=1e-12)
    assert bias_px.max() > 1.5 * bias_px.min()


def test_motions_are_compiled_once_for_the_floor_and_for_corners(room: tuple[Path, MapResult, Diagnostics]) -> None:
    solved = room[2].components[0]
    problem = corner_graph(solved.graph, solved.solution.state)[0].problem
    own = compiled_motions(problem.odometry, np.arange(len(problem.odometry.first)))
    assert problem.motions is solved.graph.problem.arrowhead.odometry
    for name in ("first", "motion", "information", "jacobian", "parameters"):  # all that looks at them here
        np.testing.assert_array_equal(getattr(problem.motions, name), getattr(own, name))


def on_uneven_floor(problem: CornerProblem, state: SpatialState, sigma: FloatArray, seed: int) -> CornerProblem:
    """The problem with pictures that stood off level by sigma (3,) in how pictures stand, drawn anew for each."""
    _, by_attitude = problem.corners.linearise(state, problem.columns)
    picture, n = problem.pictures
    stood = np.random.default_rng(seed).standard_normal((n, 3)) * sigma
    looks = problem.corners.observations
    moved_px = np.einsum("mij,mj->mi", by_attitude, stood[picture]).reshape(-1, 4, 2) * looks.sigma_px[:, None, None]
    tilted = replace(problem.corners, observations=looks._replace(corners_px=looks.corners_px + moved_px))
    return replace(problem, corners=tilted)


def test_a_tag_in_its_other_planar_pose_is_put_right_where_pictures_are_tilted(
    room: tuple[Path, MapResult, Diagnostics],
) -> None:
    """Pictures tilted by half a degree: each tag is turned round in turn, and costs its pictures more."""
    solved = room[2].components[0]
    corners, start = corner_graph(solved.graph, solved.solution.state)
    found = solve_corners(corners.problem, start)
    tilt = np.radians([0.5, 0.5, 0.0])
    problem = with_attitude_sigmas(on_uneven_floor(corners.problem, found.state, tilt, 6), tilt)
    n_turned = 0
    for tag in range(len(solved.graph.tags)):
        for other in alternative_states(problem, found.state, tag):
            if np.trace(other.turns[tag].T @ found.state.turns[tag]) > 1.0 + 2.0 * np.cos(np.radians(20.0)):
                continue
            right = with_alternative_tag_poses(problem, other)
            assert np.trace(right.turns[tag].T @ found.state.turns[tag]) > 1.0 + 2.0 * np.cos(np.radians(10.0))
            n_turned += 1
    assert n_turned > 0


def test_an_uneven_floor_is_found_and_a_level_one_is_not(room: tuple[Path, MapResult, Diagnostics]) -> None:
    """Pictures of one map tilted at random by half a degree: the sigma is found to a fifth (from some 300 pictures)."""
    solved = room[2].components[0]
    corners, start = corner_graph(solved.graph, solved.solution.state)
    found = solve_corners(corners.problem, start)
    assert not initial_attitude_sigmas(found.problem, found.state).any()
    problem = on_uneven_floor(corners.problem, found.state, np.radians([0.5, 0.5, 0.0]), 5)
    level = solve_corners(problem, found.state)
    guess = initial_attitude_sigmas(level.problem, level.state)
    assert guess.any()
    uneven = solve_corners(with_attitude_sigmas(problem, guess), level.state)
    sigma = fit_attitude_sigmas(uneven.problem, uneven.state)
    assert np.degrees(sigma[:2]) == pytest.approx(0.5, rel=0.2)
    assert sigma[2] < 0.003
    again = solve_corners(with_attitude_sigmas(uneven.problem, sigma), uneven.state)
    assert again.converged
    assert again.pictures.outliers < 0.05 < level.pictures.outliers
