"""Robust fit of one camera to many views of a board, without outlying corners and grossly wrong views.

A fit to all corners is repeated without those that disagree with it, until they do not change. The scale of residuals
is that of the median, which some wrong corners or views do not change.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.special import chdtri

from groundsbot.calib.camera import CameraModel, pixels_by_parameters, undistorted_camera
from groundsbot.calib.errors import CalibError
from groundsbot.calib.foundation import BoolArray, FloatArray
from groundsbot.calib.intrinsics.bundle import (
    LEAST_CORNERS,
    BoardObservations,
    Fit,
    Poses,
    find_poses,
    first_poses,
    fit_camera,
    inverse,
    project_corners,
    select_views,
)

_FOCALS: Final = np.geomspace(0.15, 5.0, 30)  # over the picture's width, from fisheye to telephoto lenses
_VIEWS_FOR_GUESS: Final = 8
_ROUNDS: Final = 10
_WRONGLY_REJECTED: Final = 0.01  # expected number of good corners rejected, in total
# Typical residual of a view over that of the median view. Real views differ by a factor of three; leaving out those of
# large residuals loses the nearest and most tilted ones, which determine the camera, so only gross errors are.
_GROSS: Final = 5.0
MEDIAN_CHI2: Final = float(chdtri(2, 0.5))


@dataclass(frozen=True)
class LensFit:
    """A camera fitted to the inliers among V views and N corners.

    Attributes:
        fit: the fit of the views kept, in their order.
        seen: the corners kept.
        views: (V,) which views were kept.
        corners: (N,) which corners were kept.
        view_misfit: (V,) median squared residual of each view over that of the corners kept; NaN without corners.
    """

    fit: Fit
    seen: BoardObservations
    views: BoolArray
    corners: BoolArray
    view_misfit: FloatArray

    def covariance(self) -> FloatArray:
        """Return the covariance (n, n) of the intrinsics."""
        return self.fit.covariance()


def fit_lens(seen: BoardObservations, n_views: int, start: CameraModel) -> LensFit:
    """Fit a camera robustly.

    Args:
        seen: corners of all views.
        n_views: number of views V.
        start: an initial camera, as from `first_guess`.

    Raises:
        CalibError: the corners do not determine a camera, or no view is an inlier.
    """
    views = np.bincount(seen.view, minlength=n_views) >= LEAST_CORNERS
    corners, used = np.ones(len(seen.view), dtype=np.bool_), np.zeros(len(seen.view), dtype=np.bool_)
    rounds, square = 0, _squares(start, find_poses(start, seen, n_views), seen)
    model = start
    while True:
        views, corners, misfit = _agreeing(seen, square, views, corners)
        if not views.any():
            raise CalibError("the board fits no view; check that --board is the board in the pictures")
        own = select_views(seen.where(corners), views)
        fit = fit_camera(model, own, int(views.sum()))
        before, used, rounds = used, np.asarray(corners & views[seen.view]), rounds + 1
        if np.array_equal(used, before) or rounds == _ROUNDS:
            return LensFit(fit, own, views, used, misfit)
        model, poses = fit.model, every_pose(fit, views, seen)
        square = _squares(model, poses, seen)
        square[~used] = _squares_of_predictions(fit, poses, seen.where(~used))


def every_pose(fit: Fit, views: BoolArray, seen: BoardObservations) -> Poses:
    """Return the poses of all views, including those that the fit leaves out."""
    poses = find_poses(fit.model, seen, len(views))
    poses.rotation[views], poses.place_m[views] = fit.poses.rotation, fit.poses.place_m
    return poses


def first_guess(seen: BoardObservations, n_views: int, size_px: tuple[int, int], kind: str, name: str) -> CameraModel:
    """Return an undistorted camera whose focal length explains the largest views best."""
    some = np.zeros(n_views, dtype=np.bool_)
    largest_first = np.argsort(-np.bincount(seen.view, minlength=n_views), kind="stable")
    some[largest_first[:_VIEWS_FOR_GUESS]] = True
    own, count = select_views(seen, some), int(some.sum())

    def misfit(camera: CameraModel) -> float:
        error = np.sqrt(_squares(camera, first_poses(camera, own, count), own))
        error[~np.isfinite(error)] = size_px[0]
        return float(np.mean(np.sqrt(error)))  # the root limits the influence of views that do not fit

    return min((undistorted_camera(name, size_px, kind, float(focal * size_px[0])) for focal in _FOCALS), key=misfit)


def _agreeing(
    seen: BoardObservations, square: FloatArray, views: BoolArray, corners: BoolArray
) -> tuple[BoolArray, BoolArray, FloatArray]:
    """Return views (V,) and corners (N,) that agree with the camera, and misfits of the views.

    Args:
        seen: all corners.
        square: squared residuals.
        views: such views so far.
        corners: such corners so far.
    """
    typical = max(float(np.median(square[corners & views[seen.view]])), 1e-12)
    misfit = _medians(seen, square, len(views)) / typical
    good = np.asarray(square < chdtri(2, _WRONGLY_REJECTED / len(square)) * typical / MEDIAN_CHI2)
    enough = np.bincount(seen.view[good], minlength=len(views)) >= LEAST_CORNERS
    return np.asarray(enough & (misfit <= _GROSS**2 * np.median(misfit[views]))), good, misfit


def _squares(model: CameraModel, poses: Poses, seen: BoardObservations) -> FloatArray:
    """Return (N,) squared residuals; infinite without an image."""
    residual_px = project_corners(model, poses, seen) - seen.pixels
    return np.asarray(np.nan_to_num((residual_px**2).sum(axis=1), nan=np.inf))


def _squares_of_predictions(fit: Fit, poses: Poses, seen: BoardObservations) -> FloatArray:
    """Return (N,) squared residuals of corners that were left out of a fit, reduced to the variance of corners in it.

    Where a fit extrapolates, as into a corner of the picture, its prediction may be less certain than a corner, and a
    large residual is no evidence of an outlier.
    Source: externally studentised (deletion) residuals, Cook and Weisberg, Residuals and Influence in Regression, 1982.
    """
    points = poses.points(seen.view, seen.points_m)[0]
    residual_px = fit.model.project(points) - seen.pixels
    by_camera = pixels_by_parameters(fit.model, points)
    predicted = by_camera @ inverse(fit.information) @ by_camera.swapaxes(1, 2)
    weight = np.linalg.inv(np.eye(2) + predicted / fit.sigma_px**2)
    return np.asarray(np.nan_to_num(np.einsum("ni,nij,nj->n", residual_px, weight, residual_px), nan=np.inf))


def _medians(seen: BoardObservations, square: FloatArray, n_views: int) -> FloatArray:
    """Return (V,) the median over the corners of each view, which tolerates some wrong corners; NaN without corners."""
    return np.array(
        [np.median(square[seen.view == view]) if (seen.view == view).any() else np.nan for view in range(n_views)]
    )
