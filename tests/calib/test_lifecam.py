"""Corners of real pictures: a chessboard of 10 by 10 corners by a webcam, against mrcal's fit of the same corners."""

from typing import Final

import numpy as np
import pytest
from scipy.spatial import Delaunay

from groundsbot.calib.camera.model import CameraModel
from groundsbot.calib.intrinsics.bundle import BoardObservations, fit_camera, select_views
from groundsbot.calib.intrinsics.projection_uncertainty import (
    PictureGrid,
    difference_px,
    expected_error_px,
    projection_covariance,
    rms_px,
)
from groundsbot.calib.intrinsics.robust_fit import LensFit, first_guess, fit_lens
from tests.support.lifecam import LIFECAM, LIFECAM_SIZE_PX, read_lifecam

MRCAL: Final = CameraModel(
    "mrcal", 1280, 720, 1131.171517, 1129.437477, 609.574878, 349.7414005, "rational_polynomial",
    (0.1039356761, -1.133505033, 0.002868861125, 0.001091292882, 2.699775641, -0.07902839361, 0.3027812824,
     -0.0003332983907),
)  # fmt: skip


pytestmark = pytest.mark.skipif(not LIFECAM.exists(), reason="../shared/data/lifecam is not here")
both_models = pytest.mark.parametrize("kind", ["plumb_bob", "rational_polynomial"])


def fit_views(seen: BoardObservations, n_views: int, kind: str) -> LensFit:
    return fit_lens(seen, n_views, first_guess(seen, n_views, LIFECAM_SIZE_PX, kind, "webcam"))


def grid_inside(seen: BoardObservations, model: CameraModel) -> PictureGrid:
    """The part of the picture where corners were seen."""
    grid = PictureGrid.of(model, 20)
    inside = Delaunay(seen.pixels).find_simplex(grid.pixels) >= 0
    return PictureGrid(grid.pixels, np.where(inside[..., None], grid.rays, np.nan))


@both_models
def test_projections_are_those_of_mrcal(kind: str) -> None:
    seen, n_views = read_lifecam()
    assert n_views == 12
    assert rms_px(difference_px(fit_views(seen, n_views, kind).fit.model, grid_inside(seen, MRCAL))) < 0.6


@both_models
def test_halves_differ_by_what_they_predict(kind: str) -> None:
    """By several pixels: the views are few and errors of their corners are shared, as of a board that is not flat."""
    seen, n_views = read_lifecam()
    lens = fit_views(seen, n_views, kind)
    rng, differences, predicted = np.random.default_rng(0), [], []
    for _ in range(20):
        half = rng.permutation(n_views) < n_views // 2
        one, other = (fit_camera(lens.fit.model, select_views(lens.seen, own), int(own.sum())) for own in (half, ~half))
        grid = grid_inside(seen, one.model)
        differences.append(rms_px(difference_px(other.model, grid)))
        each = projection_covariance(one.model, one.covariance() + other.covariance(), grid)
        predicted.append(np.sqrt(np.nanmean(expected_error_px(each) ** 2)))
    assert 0.7 < np.median(differences) / np.median(predicted) < 1.5
