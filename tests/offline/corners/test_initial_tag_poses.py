"""The start of an estimate on corners: OpenCV's planar poses, the camera model's own rays, a solve that is at hand."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from groundsbot.calib.camera.planar_pose import planar_poses
from groundsbot.calib.geometry import se2
from groundsbot.offline.corners.factors import columns_of, spatial_values
from groundsbot.offline.corners.initial_calibration import initial_calibration
from groundsbot.offline.corners.kernels.initial_tag_poses import POSES, candidate_poses, fit, rays_of
from groundsbot.offline.corners.kernels.view_selection import ByTag, detections_by_tag, select_evenly, select_views
from groundsbot.offline.corners.problem import CORNER_LOSS
from groundsbot.offline.measurements.sensor_model.tag_pose import UNIT_CORNERS
from tests.offline.corners.made_problems import CAMERAS, N_LOOKS, N_POSES, N_TAGS, SIGMAS, make_problem


@pytest.mark.parametrize("model", CAMERAS)
def test_looks_allow_the_poses_that_opencv_finds_and_two_upright_ones(model: str) -> None:
    problem, state = make_problem(11, model=model)
    looks, which = problem.corners.observations, np.arange(N_LOOKS)
    rays = np.empty((N_LOOKS, 4, 3))
    rays_of(problem.corners.observations, problem.corners.lenses, which, rays)
    places, turns = np.empty((N_LOOKS, POSES, 3)), np.empty((N_LOOKS, POSES, 3, 3))
    candidate_poses(problem.corners.observations, spatial_values(state), which, rays, places, turns)
    mount = looks.mount + state.calibration[looks.mount_parameters]
    level = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    for m in range(N_LOOKS):
        expected = problem.corners.cameras[looks.camera[m]].unproject(looks.corners_px[m])
        np.testing.assert_allclose(rays[m], expected, atol=1e-11)
        pose = state.poses[looks.pose[m]]
        base = Rotation.from_rotvec([0.0, 0.0, pose[2]])
        R_map_camera = base.as_matrix() @ Rotation.from_euler("ZYX", mount[m, [5, 4, 3]]).as_matrix() @ level
        place = base.apply(mount[m, :3]) + np.array([pose[0], pose[1], 0.0])
        corners_m = np.column_stack([UNIT_CORNERS * looks.side_m[m], np.zeros(4)])
        found = planar_poses(corners_m, expected)
        assert len(found) == 2
        for R_camera_tag, centre_m in found:
            s = int(np.argmin([np.linalg.norm(each - R_map_camera @ R_camera_tag) for each in turns[m, :2]]))
            np.testing.assert_allclose(turns[m, s], R_map_camera @ R_camera_tag, atol=1e-6)
            np.testing.assert_allclose(places[m, s], R_map_camera @ centre_m + place, atol=1e-6)
        towards = R_map_camera @ expected.mean(axis=0)
        for s, aside_rad in ((2, -0.6), (3, 0.6)):
            np.testing.assert_allclose(turns[m, s, 2], [0.0, 1.0, 0.0], atol=1e-15)
            away = np.arctan2(-towards[1], -towards[0]) + aside_rad - np.arctan2(*turns[m, s, 1::-1, 2])
            assert se2.wrap_angle(away) == pytest.approx(0.0, abs=1e-12)
            off_m = places[m, s] - place
            np.testing.assert_allclose(np.cross(off_m, towards), 0.0, atol=1e-12)
            far_m = np.linalg.norm(state.tags[looks.tag[m]] - place[:2])
            assert np.linalg.norm(off_m[:2]) == pytest.approx(far_m)


def test_rays_that_no_pose_explains_and_pixels_without_a_ray_are_nan() -> None:
    problem, state = make_problem(12)
    factors, which = problem.corners, np.arange(2)
    far = factors.observations.corners_px[:2] + np.array([[[1e5, 0.0]], [[0.0, 0.0]]])
    rays = np.empty((2, 4, 3))
    rays_of(factors.observations._replace(corners_px=far), factors.lenses, which, rays)
    assert np.isnan(rays[0]).all()
    assert np.isfinite(rays[1]).all()
    rays[1, 2] *= -1.0  # a corner behind the camera
    places, turns = np.empty((2, POSES, 3)), np.empty((2, POSES, 3, 3))
    candidate_poses(factors.observations, spatial_values(state), which, rays, places, turns)
    assert np.isnan(turns[:, :2]).all()
    assert np.isnan(places[:, :2]).all()


def test_a_tag_gets_poses_from_its_largest_detection_and_from_one_nearly_as_large_of_another_shape() -> None:
    square = 10.0 * np.array([[-1.0, 1.0], [1.0, 1.0], [1.0, -1.0], [-1.0, -1.0]])
    small, narrow = 0.5 * square, square * [0.8, 1.0]
    corners_px = np.stack([small, 0.95 * square, square, narrow, small]) + 100.0
    by_tag = ByTag(np.array([4, 0, 1, 2, 3]), np.array([0, 1, 1, 5]))
    chosen = np.zeros((N_TAGS, 2), dtype=np.int64)
    select_views(corners_px, by_tag, chosen)
    assert chosen.tolist() == [[4, -1], [-1, -1], [2, 3]]


def test_a_few_detections_of_each_tag_are_spread_over_all_of_its_own() -> None:
    tag = np.array([2, 0] * 3 + [0] * 12)
    few = select_evenly(detections_by_tag(tag, 3))
    assert [few.order[few.begin[t] : few.begin[t + 1]].tolist() for t in range(3)] == [
        [1, 5, 7, 9, 11, 13, 15, 17],
        [],
        [0, 2, 4],
    ]


def test_of_candidates_that_converge_to_one_pose_one_is_fitted_to_the_end() -> None:
    """Tag 0 at its pose, nearly so, the other way round, and nearly so again; tag 1 nearly at the pose of tag 0."""
    problem, state = make_problem(3)
    factors, nearly = problem.corners, Rotation.from_rotvec([0.0, 0.04, 0.03]).as_matrix()
    turns = state.turns[0] @ np.stack([np.eye(3), nearly, np.diag([-1.0, 1.0, -1.0]), nearly, nearly])
    places = np.repeat(np.append(state.tags[0], state.heights_m[0])[None], 5, axis=0)
    few = select_evenly(detections_by_tag(factors.observations.tag, N_TAGS))
    tags = np.array([0, 0, 0, 0, 1])
    losses = fit(factors.observations, factors.lenses, CORNER_LOSS, spatial_values(state), few, tags, places, turns)
    np.testing.assert_array_equal(np.isfinite(losses), [True, False, True, False, True])
    assert losses[2] > 2.0 * losses[0]


def test_tags_and_calibration_are_fitted_to_each_other_before_robots_move() -> None:
    problem, state = make_problem(5)
    off = replace(state, calibration=state.calibration + 2.0 * SIGMAS, heights_m=state.heights_m + 0.02)
    found = initial_calibration(problem, off)
    np.testing.assert_array_equal(found.poses, state.poses)
    begun, ended, true = (problem.system(each)[1] for each in (off, found, state))
    assert ended - true < 0.02 * (begun - true)


def test_tags_without_detections_keep_their_pose_while_the_rest_is_fitted() -> None:
    problem, state = make_problem(5)
    free = np.arange(N_TAGS) > 0
    corners = replace(
        problem.corners, observations=problem.corners.observations.where(problem.corners.observations.tag > 0)
    )
    problem = replace(problem, corners=corners, columns=columns_of(N_POSES, free, SIGMAS))
    found = initial_calibration(problem, replace(state, calibration=state.calibration + 2.0 * SIGMAS))
    np.testing.assert_allclose(found.tags[0], state.tags[0], atol=1e-14)
    np.testing.assert_array_equal(found.turns[0], state.turns[0])
    assert np.abs(found.tags[1:] - state.tags[1:]).min() > 1e-6


def test_a_start_that_a_step_does_not_better_stays() -> None:
    """Tags behind the camera, and three times as far off as they are, where squares lead the wrong way."""
    problem, state = make_problem(6)
    for off in (replace(state, tags=-state.tags), replace(state, tags=3.0 * state.tags)):
        assert initial_calibration(problem, off) is off
