"""The parts of a calibration: derivatives, corners, poses, the fit on made corners."""

from dataclasses import replace

import numpy as np
import pytest

from groundsbot.calib.board.board import DEFAULT_BOARD
from groundsbot.calib.board.corner_fit import Corners
from groundsbot.calib.board.finder import BoardFinder
from groundsbot.calib.board.finder import BoardView as FoundView
from groundsbot.calib.camera.model import CameraModel
from groundsbot.calib.camera.parameters import parameters_of, pixels_by_parameters, with_parameters
from groundsbot.calib.camera.planar_pose import board_pose
from groundsbot.calib.errors import CalibError
from groundsbot.calib.intrinsics.bundle import BoardObservations, Fit, fit_camera, inverse, select_views
from groundsbot.calib.intrinsics.model_choice import KINDS, first_fit
from groundsbot.calib.intrinsics.projection_uncertainty import (
    PictureGrid,
    chance_of_difference,
    difference_px,
    expected_error_px,
    projection_covariance,
    rms_px,
)
from groundsbot.calib.intrinsics.robust_fit import first_guess, fit_lens
from groundsbot.fixtures.pictures.board_picture import View, corners_of, drawn_views
from tests.support.board_cases import CASES, CORNER_SIGMA_PX, FISHEYE, NARROW, WIDE, make_corners, painter_of
from tests.support.board_views import PLAIN

FINDER = BoardFinder(DEFAULT_BOARD)
every_camera = pytest.mark.parametrize("camera", CASES.values(), ids=lambda camera: camera.name)


@every_camera
def test_derivatives_by_the_parameters_agree_with_differences(camera: CameraModel) -> None:
    rays = PictureGrid.of(camera, 9).rays.reshape(-1, 3)
    rays = rays[np.isfinite(rays).all(axis=1)]
    exact = pixels_by_parameters(camera, rays)
    at = parameters_of(camera)
    for index in range(len(at)):
        step = np.zeros(len(at))
        step[index] = 1e-5 * max(abs(at[index]), 1.0)
        ahead, behind = (with_parameters(camera, at + sign * step).project(rays) for sign in (1.0, -1.0))
        difference = (ahead - behind) / (2.0 * step[index])
        np.testing.assert_allclose(exact[..., index], difference, rtol=1e-4, atol=1e-4 * np.abs(difference).max())


@pytest.mark.parametrize("camera", [NARROW, WIDE, FISHEYE], ids=lambda camera: camera.name)
def test_corners_lie_to_a_hundredth_of_a_pixel(camera: CameraModel) -> None:
    rng = np.random.default_rng(5)
    painter, errors = painter_of(camera), []
    for taken in drawn_views(camera, DEFAULT_BOARD, 3, rng):
        view = FINDER.find(painter.picture(taken, rng))
        assert view is not None
        T = taken.T_camera_board
        corners = FINDER.find_again(view, camera.project(FINDER.places_around_m() @ T[:3, :3].T + T[:3, 3])).corners
        assert len(corners.ids) >= len(view.corners.ids)
        errors.append(corners.pixels - corners_of(taken, camera, DEFAULT_BOARD)[corners.ids])
    assert rms_px(np.concatenate(errors)) < 0.009  # both coordinates
    assert np.abs(np.concatenate(errors).mean(axis=0)).max() < 0.004


def test_light_that_slopes_across_the_board_moves_no_corner() -> None:
    """By a third from side to side: it would move an edge by as much as it grows along it."""
    rng = np.random.default_rng(5)
    taken = drawn_views(NARROW, DEFAULT_BOARD, 1, rng)[0]
    picture = painter_of(NARROW).picture(taken, rng)
    slope = np.linspace(0.67, 1.0, NARROW.width_px)
    places = FINDER.places_around_m() @ taken.T_camera_board[:3, :3].T + taken.T_camera_board[:3, 3]
    found = []
    for each in (picture, np.rint(picture * slope).astype(np.uint8)):
        view = FINDER.find(each)
        assert view is not None
        found.append(FINDER.find_again(view, NARROW.project(places)).corners)
    np.testing.assert_array_equal(found[0].ids, found[1].ids)
    assert rms_px(found[1].pixels - found[0].pixels) < 0.003


def test_corners_of_edges_along_the_pixels_rows_are_as_good_as_others() -> None:
    """A renderer that samples before it blurs would show its beat there: 0.015 px."""
    rng = np.random.default_rng(6)
    T = np.eye(4)
    T[:3, 3] = [-0.09, -0.11, 0.57]
    taken = View(T)
    corners = FINDER.find(painter_of(PLAIN).picture(taken, rng))
    assert corners is not None
    again = FINDER.find_again(corners, PLAIN.project(FINDER.places_around_m() + T[:3, 3])).corners
    error = again.pixels - corners_of(taken, PLAIN, DEFAULT_BOARD)[again.ids]
    assert np.sqrt((error**2).mean()) < 0.006


def test_a_board_far_off_the_axis_of_a_fisheye_has_a_pose() -> None:
    """Its origin may even lie behind the camera."""
    seen, views = make_corners(FISHEYE, 1, 30)
    origins = np.array([view.T_camera_board[2, 3] for view in views])
    assert origins.min() < 0.0
    for index, view in enumerate(views):
        own = seen.view == index
        pose = board_pose(seen.points_m[own], FISHEYE.unproject(seen.pixels[own]))
        assert pose is not None
        assert np.linalg.norm(pose[1] - view.T_camera_board[:3, 3]) < 0.01


@every_camera
def test_a_fit_finds_the_camera_as_well_as_it_says(camera: CameraModel) -> None:
    grid, found, told = PictureGrid.of(camera, 12), [], []
    for seed in range(4):
        seen, views = make_corners(camera, seed)
        size_px = (camera.width_px, camera.height_px)
        lens = fit_lens(seen, len(views), first_guess(seen, len(views), size_px, camera.distortion_model, "c"))
        found.append(rms_px(difference_px(lens.fit.model, grid)))
        told.append(expected_error_px(projection_covariance(camera, lens.covariance(), grid)))
        assert lens.fit.sigma_px == pytest.approx(CORNER_SIGMA_PX, rel=0.15)
        assert lens.views.all()
    ratio = np.sqrt(np.mean(np.square(found))) / np.sqrt(np.nanmean(np.square(told)))
    assert 0.5 < ratio < 1.6


@every_camera
def test_a_fit_is_the_same_each_time(camera: CameraModel) -> None:
    """OpenCV's threads add up in any order."""
    seen, views = make_corners(camera, 3, 30)
    found = {tuple(parameters_of(fit_camera(camera, seen, len(views)).model)) for _ in range(4)}
    assert len(found) == 1


def test_corners_at_the_rim_of_a_fisheye_count() -> None:
    """OpenCV's fisheye fit refuses these pictures, as corners lie 88 degrees off the axis."""
    errors = []
    for seed in (0, 5, 9):
        seen, views = make_corners(FISHEYE, seed, 30)
        start = first_guess(seen, len(views), (640, 480), "equidistant", "c")
        lens = fit_lens(seen, len(views), start)
        assert lens.corners.all()
        errors.append(rms_px(difference_px(lens.fit.model, PictureGrid.of(FISHEYE))))
    assert max(errors) < 0.025


@every_camera
def test_the_covariance_of_few_views_is_right_on_average(camera: CameraModel) -> None:
    """For independent noise it is the inverse information, however unequal views are; the jackknife's is larger."""
    seen, views = make_corners(camera, 0, 7)
    fit = fit_camera(camera, seen, len(views))
    drawn, rng = [], np.random.default_rng(0)
    for _ in range(400):
        own = np.array([rng.multivariate_normal(np.zeros(len(each)), each, method="cholesky") for each in fit.by_view])
        step = inverse(fit.information) @ own.sum(axis=0)
        drawn.append(replace(fit, gradient_by_view=own - fit.by_view @ step).covariance())
    whole = np.sqrt(np.diag(inverse(fit.information)))
    np.testing.assert_allclose(np.sqrt(np.diag(np.mean(drawn, axis=0))), whole, rtol=0.1)


def fit_halves(camera: CameraModel, seed: int, bend_px: float) -> tuple[Fit, Fit]:
    """Return fits of the first and the other 15 of 30 views."""
    seen, views = make_corners(camera, seed, 30, bend_px=bend_px)
    own = np.arange(len(views)) < 15
    one, other = (fit_camera(camera, select_views(seen, half), int(half.sum())) for half in (own, ~own))
    return one, other


def test_errors_that_the_corners_of_a_view_share_make_sigmas_larger() -> None:
    """A board that is bent otherwise in each view: halves of the views differ by what they say."""
    found, predicted = [], []
    for seed in range(6):
        one, other = fit_halves(WIDE, seed, bend_px=0.1)
        grid = PictureGrid.of(one.model, 12)
        found.append(rms_px(difference_px(other.model, grid)) ** 2)
        each = projection_covariance(one.model, one.covariance() + other.covariance(), grid)
        predicted.append(np.nanmean(expected_error_px(each) ** 2))
    assert 0.6 < np.sqrt(np.mean(found) / np.mean(predicted)) < 1.5


def test_halves_are_one_camera_and_a_focus_moved_by_one_percent_is_another() -> None:
    for seed in range(5):
        one, other = fit_halves(WIDE, seed, bend_px=0.1)
        covariances = [(each.covariance(), 15) for each in (one, other)]
        assert chance_of_difference(one.model, other.model, covariances) > 0.001
        moved = replace(other.model, fx_px=1.01 * other.model.fx_px, fy_px=1.01 * other.model.fy_px)
        assert chance_of_difference(one.model, moved, covariances) < 0.001


def test_places_at_the_rim_of_an_image_do_not_make_another_camera() -> None:
    """The rims of two calibrations differ by noise; a lens that images far less is another one."""
    seen, views = make_corners(FISHEYE, 0)
    covariance = [(100.0 * fit_camera(FISHEYE, seen, len(views)).covariance(), len(views))]
    longer = replace(FISHEYE, cx_px=FISHEYE.cx_px + 0.5)
    grid = PictureGrid.of(FISHEYE, 16)
    assert (grid.is_imaged & np.isnan(difference_px(longer, grid)).any(axis=-1)).any()
    assert chance_of_difference(FISHEYE, longer, covariance) > 0.5
    narrower = replace(FISHEYE, distortion=(-0.2, 0.0, 0.0, 0.0))
    assert chance_of_difference(FISHEYE, narrower, covariance) == 0.0


@pytest.mark.parametrize("n_rays", [0, 1])
def test_a_lens_that_images_almost_nothing_is_refused_in_one_line(n_rays: int) -> None:
    grid = PictureGrid.of(WIDE, 8)
    rays = np.full_like(grid.rays, np.nan)
    rays[0, :n_rays] = grid.rays[0, :n_rays]
    with pytest.raises(CalibError, match=r"^camera wide: its plumb_bob lens images [01] of 48 places[^\n]*$"):
        projection_covariance(WIDE, np.eye(9), PictureGrid(grid.pixels, rays))


def test_wrong_corners_and_a_wrong_view_are_left_out() -> None:
    seen, views = make_corners(WIDE, 1)
    wrong = np.zeros(len(seen.view), dtype=bool)
    wrong[np.random.default_rng(0).choice(len(wrong), 20, replace=False)] = True
    seen.pixels[wrong] += [0.9, -0.7]
    moved = seen.view == 3
    seen.pixels[moved] += np.random.default_rng(1).normal(0.0, 0.6, (int(moved.sum()), 2))
    lens = fit_lens(seen, len(views), first_guess(seen, len(views), (640, 480), "plumb_bob", "c"))
    assert list(np.nonzero(~lens.views)[0]) == [3]
    assert not lens.corners[wrong].any()
    assert lens.corners[~wrong & ~moved].mean() > 0.995
    assert rms_px(difference_px(lens.fit.model, PictureGrid.of(WIDE))) < 0.1


@pytest.mark.parametrize("seed", range(3))
def test_corners_that_a_poor_start_predicts_badly_are_used(seed: int) -> None:
    """A start from the middle of the picture misses corners at its rim by many sigma: most determine the lens."""
    seen, views = make_corners(WIDE, seed, 30, sigma_px=0.01)
    middle = np.asarray((np.abs(seen.pixels - [320.0, 240.0]) < [180.0, 140.0]).all(axis=1))
    kept = np.bincount(seen.view[middle], minlength=len(views)) >= 12
    start = fit_camera(WIDE, select_views(seen.where(middle), kept), int(kept.sum())).model
    lens = fit_lens(seen, len(views), start)
    assert lens.views.all()
    assert lens.corners.all()


def test_a_turned_camera_is_no_other_camera() -> None:
    """What a rotation makes up for does not count: a shift of the centre, nearly, of a narrow one."""
    grid = PictureGrid.of(NARROW)
    shifted = with_parameters(NARROW, parameters_of(NARROW) + np.array([0, 0, 1.0, 0, 0, 0, 0, 0, 0]))
    assert rms_px(difference_px(shifted, grid)) < 0.2
    longer = with_parameters(NARROW, parameters_of(NARROW) * np.array([1.01, 1.01, 1, 1, 1, 1, 1, 1, 1]))
    assert rms_px(difference_px(longer, grid)) > 1.0


@every_camera
def test_the_predicted_error_is_that_of_cameras_drawn_from_the_covariance(camera: CameraModel) -> None:
    seen, views = make_corners(camera, 2)
    start = first_guess(seen, len(views), (640, 480), camera.distortion_model, "c")
    lens = fit_lens(seen, len(views), start)
    covariance, grid = 0.01 * lens.covariance(), PictureGrid.of(lens.fit.model, 12)
    predicted = expected_error_px(projection_covariance(lens.fit.model, covariance, grid))
    root = np.linalg.cholesky(covariance + 1e-18 * np.diag(np.diag(covariance)))
    rng = np.random.default_rng(0)
    drawn = []
    for _ in range(60):
        other = with_parameters(lens.fit.model, parameters_of(lens.fit.model) + root @ rng.standard_normal(len(root)))
        drawn.append((difference_px(other, grid) ** 2).sum(axis=-1))
    ratio = np.sqrt(np.mean(drawn, axis=0)) / predicted
    assert np.nanmin(ratio) > 0.7
    assert np.nanmax(ratio) < 1.3


@every_camera
def test_a_view_with_too_few_corners_for_a_pose_does_no_harm(camera: CameraModel) -> None:
    seen, views = make_corners(camera, seed=2, count=6)
    few = seen.where((seen.view > 0) | (np.cumsum(seen.view == 0) <= 2))
    lens, others = (fit_lens(each, len(views), camera) for each in (few, seen.where(seen.view > 0)))
    assert list(np.nonzero(~lens.views)[0]) == [0]
    assert rms_px(difference_px(lens.fit.model, PictureGrid.of(others.fit.model, 12))) < 1e-3


def test_the_first_model_is_the_simplest_that_fits_as_well() -> None:
    """A kind with more freedom fits a little better each time, and bends where there are no corners."""
    size_px = (WIDE.height_px, WIDE.width_px)
    for seed in range(3):
        seen, views = make_corners(WIDE, seed=seed, count=8)
        found = [_view_of(seen, index, size_px) for index in range(len(views))]
        assert first_fit(found, FINDER, "camera", KINDS).fit.model.distortion_model != "rational_polynomial"


def _view_of(seen: BoardObservations, index: int, size_px: tuple[int, int]) -> FoundView:
    own = seen.view == index
    ids = np.array([np.argmin(np.linalg.norm(FINDER.corners_m - point, axis=1)) for point in seen.points_m[own]])
    ones = np.ones(int(own.sum()))
    corners = Corners(ids, seen.pixels[own], blur_px=ones)
    return FoundView(f"{index}", np.zeros(size_px, np.uint8), corners)
