"""Corners where the lens bends edges and blur carries markers' black, in pictures without noise: only the fit errs."""

import cv2
import numpy as np
import pytest

from groundsbot.calib.board.board import DEFAULT_BOARD
from groundsbot.calib.board.corner_fit import fit_corners
from groundsbot.calib.board.corner_surroundings import RADIUS_PX, Surroundings, bends
from groundsbot.calib.board.finder import BoardFinder
from groundsbot.calib.board.finder import BoardView as FoundView
from groundsbot.calib.camera.model import CameraModel
from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.intrinsics.model_choice import calibrate_camera
from groundsbot.calib.intrinsics.projection_uncertainty import chance_of_difference, rms_px
from groundsbot.fixtures.pictures.board_picture import BoardPainter, corners_of, drawn_views
from groundsbot.fixtures.worlds.world import Pictures
from tests.support.board_cases import FISHEYE, NARROW, RATIONAL, taken_views

FINDER = BoardFinder(DEFAULT_BOARD)
BLURRED = Pictures(defocus_px=1.0, read_noise_electrons=0.0, full_well_electrons=1e9)


def test_a_marker_that_is_nearer_draws_no_corner_to_itself() -> None:
    """Squares get smaller towards the rim of a fisheye: 0.008 px inwards at this blur, by markers taken for white."""
    painter, rng, inwards, errors = BoardPainter(FISHEYE, DEFAULT_BOARD, BLURRED), np.random.default_rng(0), [], []
    for taken in drawn_views(FISHEYE, DEFAULT_BOARD, 4, np.random.default_rng(1005), shake_px=0.0):
        T = taken.T_camera_board
        first = FINDER.find(painter.picture(taken, rng))
        assert first is not None
        places = FINDER.places_around_m() @ T[:3, :3].T + T[:3, 3]
        corners = FINDER.find_again(first, FISHEYE.project(places)).corners
        true = corners_of(taken, FISHEYE, DEFAULT_BOARD)[corners.ids]
        middle = np.array([FISHEYE.cx_px, FISHEYE.cy_px]) - true
        errors.append(corners.pixels - true)
        inwards.append((errors[-1] * middle).sum(axis=1) / np.linalg.norm(middle, axis=1))
    assert abs(np.concatenate(inwards).mean()) < 0.0015
    assert rms_px(np.concatenate(errors)) < 0.007  # 0.0084 where blur is taken to end at 1.5 px


def test_edges_are_followed_that_bend_more_and_more() -> None:
    """A corner beside the picture's border, whose edges are cut on one side: with parabolas it is 0.05 px off."""
    true, bend = np.array([11.3, 19.6]), np.array([[0.01, 8e-4, 4e-5], [-0.012, -6e-4, 5e-5]])
    fine = (np.arange(40 * 8) + 0.5) / 8 - 0.5
    x, y = np.meshgrid(fine - true[0], fine - true[1])
    lines = []
    for across, back, (second, third, fourth) in zip((y, -x), (-x, -y), bend, strict=True):
        lines.append(across - (second / 2.0 * back**2 + third / 6.0 * back**3 + fourth / 24.0 * back**4))
    light = cv2.GaussianBlur(120.0 + 80.0 * np.sign(lines[0] * lines[1]), (0, 0), 8 * 0.6)
    picture = np.rint(light.reshape(40, 8, 40, 8).mean(axis=(1, 3))).astype(np.uint8)
    errors = []
    for given in (bend, bend * [1.0, 0.0, 0.0]):
        around = Surroundings(
            pixels=true[None] + 0.2, squares_px=40.0 * np.eye(2)[None], growth_px=np.zeros((1, 2, 3)),
            white_diagonal=np.array([False]), bend=given[None], blur_px=np.array([0.6]), clear=0.5, radius_px=RADIUS_PX,
        )  # fmt: skip
        found = fit_corners(picture, np.array([0]), around)
        errors.append(np.linalg.norm(found.pixels[0] - true))
    assert errors[0] < 0.005
    assert errors[1] > 0.02


def test_bends_are_those_of_a_known_curve() -> None:
    """Seen from its own end backwards, on its right in a picture whose y is down; turned any way."""
    by_way = np.array([0.0, 2e-2, -3e-4, 4e-5])  # first to fourth derivative
    way = np.array([9.0, 5.0, 0.0, -4.0, -10.0])  # the line leads back
    aside = sum(by_way[power - 1] * way**power / float(np.prod(np.arange(1, power + 1))) for power in (1, 2, 3, 4))
    turn = np.radians(35.0)
    back, normal = np.array([np.cos(turn), np.sin(turn)]), np.array([np.sin(turn), -np.cos(turn)])
    points = np.array([100.0, 50.0]) + way[:, None] * back + aside[:, None] * normal
    found = bends(np.array([points, np.full((5, 2), np.nan), np.zeros((5, 2))]))
    # The chord through the neighbours is not quite the tangent.
    np.testing.assert_allclose(found[0], by_way[1:], rtol=0.05)
    assert np.isnan(found[1:]).all()


@pytest.mark.parametrize(("camera", "looks"), [(NARROW, 1), (RATIONAL, 2)], ids=["narrow", "rational"])
def test_corners_are_fitted_again_where_a_first_camera_bends_edges_otherwise(
    camera: CameraModel, looks: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the outermost corners of the one lens the first camera's bends are off by 0.02 px."""
    count, look = [0], BoardFinder.find_again

    def counted(self: BoardFinder, view: FoundView, projected_px: FloatArray) -> FoundView:
        count[0] += 1
        return look(self, view, projected_px)

    monkeypatch.setattr(BoardFinder, "find_again", counted)
    views = taken_views(camera, 1000, 8)
    lens = calibrate_camera(views, FINDER, camera.name, [camera.distortion_model]).lens
    assert count[0] >= looks * len(views)
    assert looks > 1 or count[0] == len(views)
    n_views = int(lens.views.sum())
    assert chance_of_difference(lens.fit.model, camera, [(lens.covariance(), n_views)]) > 0.01
