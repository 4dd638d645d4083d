"""Robust fit of one camera to many views of a board, with rejection of outlying corners and views.

The covariance of a corner is that of its own fit, from image noise, plus an isotropic error common to all corners. The
latter is estimated so that the squared whitened residuals have their expected mean, and is used in all tests.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.optimize import brentq
from scipy.stats import chi2

from groundsbot.calib.camera import CameraModel, undistorted_camera
from groundsbot.calib.errors import CalibError
from groundsbot.calib.foundation import BoolArray, FloatArray
from groundsbot.calib.intrinsics.bundle import (
    BoardObservations,
    Fit,
    Poses,
    adjust_bundle,
    has_image,
    poses_of,
    project_corners,
    select_views,
)

_FOCALS: Final = np.geomspace(0.15, 5.0, 30)  # over the picture's width, from fisheye to telephoto lenses
_VIEWS_FOR_GUESS: Final = 8
_ROBUST_ROUNDS: Final = 5
_CAUCHY: Final = 2.4  # robust sigmas
_REJECTING_ROUNDS: Final = 10
_WRONGLY_REJECTED: Final = 0.01  # expected number of good corners rejected, in total
# Typical residual of a view over that of the median view. Real views differ by a factor of three; leaving out those of
# large residuals loses the nearest and most tilted ones, which determine the camera, so only gross errors are.
_GROSS: Final = 5.0
_LEAST_CORNERS: Final = 6
_LARGEST_EXTRA_PX: Final = 30.0
MEDIAN_CHI2: Final = float(chi2.median(2))


@dataclass(frozen=True)
class LensFit:
    """A camera fitted to the inliers among V views and N corners.

    Attributes:
        fit: the fit of the views kept, in their order.
        seen: the corners kept.
        views: (V,) which views were kept.
        corners: (N,) which corners were kept.
        extra_sigma_px: sigma of the corners' error beyond image noise.
        view_misfit: (V,) median squared whitened residual of each view over its expected value; NaN without a pose.
    """

    fit: Fit
    seen: BoardObservations
    views: BoolArray
    corners: BoolArray
    extra_sigma_px: float
    view_misfit: FloatArray

    def covariance(self) -> FloatArray:
        """Return the covariance (n, n) of the intrinsics, by the jackknife over views."""
        return self.fit.covariance()


def fit_lens(seen: BoardObservations, n_views: int, start: CameraModel) -> LensFit:
    """Fit a camera robustly.

    Args:
        seen: corners of all views.
        n_views: number of views V.
        start: an initial camera, as from `first_guess`.

    Raises:
        CalibError: no view has a pose, or no view is an inlier.
    """
    poses, views = poses_of(start, seen, n_views)
    counts = np.bincount(seen.view, minlength=n_views)
    views &= counts >= _LEAST_CORNERS
    if views.sum() < 1:
        raise CalibError("the board fits no view; check that --board is the board in the pictures")
    model, fitted = _robust(start, poses.where(views), select_views(seen, views))
    poses.rotation[views], poses.place_m[views] = fitted.rotation, fitted.place_m
    poses, views = _reestimate_poses(model, poses, views, seen)
    views &= counts >= _LEAST_CORNERS
    return _without_outliers(seen, views, model, poses.where(views))


def first_guess(seen: BoardObservations, n_views: int, size_px: tuple[int, int], kind: str, name: str) -> CameraModel:
    """Return an undistorted camera whose focal length explains the largest views best."""
    some = np.zeros(n_views, dtype=np.bool_)
    largest_first = np.argsort(-np.bincount(seen.view, minlength=n_views), kind="stable")
    some[largest_first[:_VIEWS_FOR_GUESS]] = True
    own, count = select_views(seen, some), int(some.sum())

    def misfit(camera: CameraModel) -> float:
        poses, good = poses_of(camera, own, count)
        pixels = camera.project(poses.points(own.view, own.points_m)[0])
        error = np.linalg.norm(pixels - own.pixels, axis=1)
        error[~good[own.view] | ~np.isfinite(error)] = size_px[0]
        return float(np.mean(np.sqrt(error)))  # the root limits the influence of views that do not fit

    return min((undistorted_camera(name, size_px, kind, float(focal * size_px[0])) for focal in _FOCALS), key=misfit)


def _robust(start: CameraModel, poses: Poses, seen: BoardObservations) -> tuple[CameraModel, Poses]:
    """Return camera and poses by iteratively reweighted least squares with Cauchy weights.

    The scale of the weights follows from the median residual.
    """
    model, weight = start, np.ones(len(seen.view))
    for _ in range(_ROBUST_ROUNDS):
        imaged = has_image(model, poses, seen)
        whitening = np.where(imaged, np.sqrt(weight), 0.0)[:, None, None] * np.eye(2)
        fit = adjust_bundle(model, poses, seen, whitening)
        model, poses = fit.model, fit.poses
        square = np.nan_to_num((fit.residual_px**2).sum(axis=1), nan=np.inf)
        scale = float(np.median(square)) / MEDIAN_CHI2 * _CAUCHY**2
        weight = 1.0 / (1.0 + square / max(scale, 1e-12))
    return model, poses


def _reestimate_poses(
    model: CameraModel, poses: Poses, views: BoolArray, seen: BoardObservations
) -> tuple[Poses, BoolArray]:
    """Return poses estimated again with the fitted camera, and (V,) which views have one.

    This corrects poses that a poor initial camera put into a wrong local minimum, as the mirrored pose of a plane, and
    adds views without a pose.
    """
    for rank in (0, 1):
        fresh, found = poses_of(model, seen, len(views), rank)
        own = select_views(seen, found)
        imaged = has_image(model, fresh.where(found), own)
        settled = adjust_bundle(
            model, fresh.where(found), own, imaged[:, None, None] * np.eye(2), hold_intrinsics=True
        ).poses
        fresh.rotation[found], fresh.place_m[found] = settled.rotation, settled.place_m
        before, after = (_errors_by_view(model, each, seen) for each in (poses, fresh))
        better = np.asarray(found & ~(views & ~(after < before)))
        poses.rotation[better], poses.place_m[better] = fresh.rotation[better], fresh.place_m[better]
        views = np.asarray(views | found)
    return poses, views


def _errors_by_view(model: CameraModel, poses: Poses, seen: BoardObservations) -> FloatArray:
    """Return (V,) median squared residuals."""
    residual = project_corners(model, poses, seen) - seen.pixels
    return _medians(seen, np.nan_to_num((residual**2).sum(axis=1), nan=np.inf), len(poses.place_m))


@dataclass(frozen=True)
class _Inliers:
    """Inliers of an iteration, and the camera fitted to them."""

    views: BoolArray  # (V,)
    corners: BoolArray  # (N,)
    model: CameraModel
    poses: Poses  # of the views kept

    def every_pose(self) -> Poses:
        """Return the poses of all views, with placeholders for rejected ones."""
        every = Poses.default(len(self.views))
        every.rotation[self.views], every.place_m[self.views] = self.poses.rotation, self.poses.place_m
        return every


def _without_outliers(seen: BoardObservations, views: BoolArray, model: CameraModel, poses: Poses) -> LensFit:
    kept = _Inliers(views, np.asarray(views[seen.view]), model, poses)
    misfit = np.full(len(views), np.nan)
    for _ in range(_REJECTING_ROUNDS):
        corners, stay, misfit, extra_px = _agreeing(seen, kept, misfit)
        own = select_views(seen.where(corners), stay)
        fit = adjust_bundle(kept.model, kept.poses.where(stay[kept.views]), own, own.whitening(extra_px))
        unchanged = np.array_equal(corners, kept.corners) and np.array_equal(stay, kept.views)
        kept = _Inliers(stay, corners, fit.model, fit.poses)
        if unchanged:
            break
    own = select_views(seen.where(kept.corners), kept.views)
    residual_px = project_corners(kept.model, kept.poses, own) - own.pixels
    freedom = _freedom(len(own.view), len(kept.poses.place_m), 4 + len(model.distortion))
    extra_px = _extra_sigma_px(own, residual_px, freedom, typical=False)
    fit = adjust_bundle(kept.model, kept.poses, own, own.whitening(extra_px))
    return LensFit(fit, own, kept.views, kept.corners, extra_px, misfit)


def _agreeing(
    seen: BoardObservations, kept: _Inliers, before: FloatArray
) -> tuple[BoolArray, BoolArray, FloatArray, float]:
    """Return corners (N,) and views (V,) that agree with the camera, misfits of the views, and the extra sigma."""
    count = len(kept.views)
    residual = project_corners(kept.model, kept.every_pose(), seen) - seen.pixels
    freedom = _freedom(int(kept.corners.sum()), int(kept.views.sum()), 4 + len(kept.model.distortion))
    extra_px = _extra_sigma_px(seen.where(kept.corners), residual[kept.corners], freedom, typical=True)
    square = _squares(seen, residual, extra_px)
    limit = float(chi2.isf(_WRONGLY_REJECTED / len(seen.view), 2))
    posed = np.asarray(kept.views[seen.view])
    misfit = np.where(kept.views, _medians(seen, square, count) / MEDIAN_CHI2, before)
    corners = posed & (square < limit)
    enough = np.bincount(seen.view[corners], minlength=count) >= _LEAST_CORNERS
    stay = np.asarray(kept.views & ~_outlying(misfit, kept.views) & enough)
    if not stay.any():
        raise CalibError("no view agrees with another; check that --board is the board in the pictures")
    return np.asarray(corners & stay[seen.view]), stay, misfit, extra_px


def _freedom(corners: int, views: int, parameters: int) -> int:
    return max(2 * corners - 6 * views - parameters, 1)


def _squares(seen: BoardObservations, residual_px: FloatArray, extra_px: float) -> FloatArray:
    """Return (N,) squared whitened residuals; infinite without an image."""
    whitened = np.einsum("nij,nj->ni", seen.whitening(extra_px), residual_px)
    return np.asarray(np.nan_to_num((whitened**2).sum(axis=1), nan=np.inf))


def _extra_sigma_px(seen: BoardObservations, residual_px: FloatArray, freedom: int, typical: bool) -> float:
    """Return the extra sigma with which the squared residuals have their expected mean, or median if `typical`."""
    share = freedom / (2.0 * len(residual_px))

    def excess(extra_px: float) -> float:
        square = _squares(seen, residual_px, extra_px)
        return float(np.median(square) / MEDIAN_CHI2 if typical else 0.5 * square.mean()) - share

    if excess(0.0) <= 0.0:
        return 0.0
    if excess(_LARGEST_EXTRA_PX) > 0.0:
        return _LARGEST_EXTRA_PX
    return float(brentq(excess, 0.0, _LARGEST_EXTRA_PX, xtol=1e-5))


def _medians(seen: BoardObservations, square: FloatArray, n_views: int) -> FloatArray:
    """Return (V,) the median over the corners of each view, which tolerates some wrong corners; NaN without corners."""
    return np.array(
        [np.median(square[seen.view == view]) if (seen.view == view).any() else np.nan for view in range(n_views)]
    )


def _outlying(misfit: FloatArray, views: BoolArray) -> BoolArray:
    """Return (V,) views whose residuals are grossly larger than those of the other views."""
    return np.asarray(np.nan_to_num(misfit) > _GROSS**2 * max(float(np.median(misfit[views])), 1e-12))
