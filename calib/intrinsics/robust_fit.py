"""Fits one camera to many views of a board and finds out what does not belong: corners, and whole views.

What a corner errs by is the light's noise, which its own fit tells, and something more that is the same for all and is
estimated here, so that the squared whitened residuals have their expected mean. All tests are made with that.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.optimize import brentq
from scipy.stats import chi2

from groundsbot.calib.camera import CameraModel, undistorted_camera
from groundsbot.calib.errors import CalibError
from groundsbot.calib.foundation import BoolArray, FloatArray
from groundsbot.calib.intrinsics.bundle import Fit, Observations, Poses, adjust_bundle, poses_of, select_views

_FOCALS: Final = np.geomspace(0.15, 5.0, 30)  # of the picture's width: from a fisheye to a telescope
_VIEWS_FOR_GUESS: Final = 8
_ROBUST_ROUNDS: Final = 5
_CAUCHY: Final = 2.4  # robust sigmas
_REJECTING_ROUNDS: Final = 10
_WRONGLY_REJECTED: Final = 0.01  # corners expected, of all
_VIEW_SIGMAS: Final = 4.0  # of the scatter of views' residuals: one view in 30,000
_LEAST_SCATTER: Final = 0.1  # of the logarithm of a view's mean square: no two views are alike to less
_LEAST_CORNERS: Final = 6
_LARGEST_EXTRA_PX: Final = 30.0
MEDIAN_CHI2: Final = float(chi2.median(2))


@dataclass(frozen=True)
class LensFit:
    """A camera fitted to those of V views and N corners that belong.

    Attributes:
        fit: over the views kept, in their order.
        seen: the corners kept.
        views: (V,) which views were kept.
        corners: (N,) which corners were kept.
        extra_sigma_px: what a corner errs by beyond the light's noise.
        view_misfit: (V,) median squared whitened residual of each view's corners, 1 where they are as
            others', NaN without a pose.
    """

    fit: Fit
    seen: Observations
    views: BoolArray
    corners: BoolArray
    extra_sigma_px: float
    view_misfit: FloatArray

    @property
    def freedom(self) -> int:
        """Residuals less unknowns."""
        return _freedom(len(self.seen.view), int(self.views.sum()), len(self.fit.information))

    @property
    def variance(self) -> float:
        """Of the whitened residuals: 1 unless the light's noise alone is too much."""
        return self.fit.cost / self.freedom

    def covariance(self) -> FloatArray:
        """(n, n) of the intrinsics."""
        return self.fit.covariance() * self.variance


def fit_lens(seen: Observations, n_views: int, start: CameraModel) -> LensFit:
    """Fits a camera robustly.

    Args:
        seen: corners of all views.
        n_views: V.
        start: a camera near enough, as `first_guess` gives one.

    Raises:
        CalibError: no view has a pose.
    """
    poses, views = poses_of(start, seen, n_views)
    counts = np.bincount(seen.view, minlength=n_views)
    views &= counts >= _LEAST_CORNERS
    if views.sum() < 1:
        raise CalibError("the board fits no view; is it the board that the pictures show?")
    model, fitted = _robust(start, poses.where(views), select_views(seen, views))
    poses.rotation[views], poses.place_m[views] = fitted.rotation, fitted.place_m
    poses, views = _reestimate_poses(model, poses, views, seen)
    views &= counts >= _LEAST_CORNERS
    return _without_outliers(seen, views, model, poses.where(views))


def first_guess(seen: Observations, n_views: int, size_px: tuple[int, int], kind: str, name: str) -> CameraModel:
    """A camera without distortion whose focal length explains some of the views best."""
    some = np.zeros(n_views, dtype=np.bool_)
    largest_first = np.argsort(-np.bincount(seen.view, minlength=n_views), kind="stable")
    some[largest_first[:_VIEWS_FOR_GUESS]] = True
    own, count = select_views(seen, some), int(some.sum())

    def misfit(camera: CameraModel) -> float:
        poses, good = poses_of(camera, own, count)
        pixels = camera.project(poses.points(own.view, own.points_m)[0])
        error = np.linalg.norm(pixels - own.pixels, axis=1)
        error[~good[own.view] | ~np.isfinite(error)] = size_px[0]
        return float(np.mean(np.sqrt(error)))  # a view that does not fit weighs little

    return min((undistorted_camera(name, size_px, kind, float(focal * size_px[0])) for focal in _FOCALS), key=misfit)


def _robust(start: CameraModel, poses: Poses, seen: Observations) -> tuple[CameraModel, Poses]:
    """Least squares with Cauchy's weights, whose scale is the residuals' own."""
    model, weight = start, np.ones(len(seen.view))
    for _ in range(_ROBUST_ROUNDS):
        imaged = np.isfinite(model.project(poses.points(seen.view, seen.points_m)[0])).all(axis=1)
        whitening = np.where(imaged, np.sqrt(weight), 0.0)[:, None, None] * np.eye(2)
        fit = adjust_bundle(model, poses, seen, whitening)
        model, poses = fit.model, fit.poses
        square = np.nan_to_num((fit.residual_px**2).sum(axis=1), nan=np.inf)
        scale = float(np.median(square)) / MEDIAN_CHI2 * _CAUCHY**2
        weight = 1.0 / (1.0 + square / max(scale, 1e-12))
    return model, poses


def _reestimate_poses(
    model: CameraModel, poses: Poses, views: BoolArray, seen: Observations
) -> tuple[Poses, BoolArray]:
    """Poses that a start far from the truth put wrong, a board's mirror image say, and views that it gave none."""
    for rank in (0, 1):
        fresh, found = poses_of(model, seen, len(views), rank)
        own = select_views(seen, found)
        imaged = np.asarray(
            np.isfinite(model.project(fresh.where(found).points(own.view, own.points_m)[0])).all(axis=1)
        )
        settled = adjust_bundle(
            model, fresh.where(found), own, imaged[:, None, None] * np.eye(2), hold_intrinsics=True
        ).poses
        fresh.rotation[found], fresh.place_m[found] = settled.rotation, settled.place_m
        before, after = (_errors_by_view(model, each, seen) for each in (poses, fresh))
        better = np.asarray(found & ~(views & ~(after < before)))
        poses.rotation[better], poses.place_m[better] = fresh.rotation[better], fresh.place_m[better]
        views = np.asarray(views | found)
    return poses, views


def _errors_by_view(model: CameraModel, poses: Poses, seen: Observations) -> FloatArray:
    """(V,) median squared residuals."""
    residual = model.project(poses.points(seen.view, seen.points_m)[0]) - seen.pixels
    return _medians(seen, np.nan_to_num((residual**2).sum(axis=1), nan=np.inf), len(poses.place_m))


@dataclass(frozen=True)
class _Inliers:
    """What counts so far, and the camera that follows from it."""

    views: BoolArray  # (V,)
    corners: BoolArray  # (N,)
    model: CameraModel
    poses: Poses  # of the views kept

    def every_pose(self) -> Poses:
        """With some pose for the others too."""
        count = len(self.views)
        every = Poses(np.tile(np.eye(3), (count, 1, 1)), np.tile([0.0, 0.0, 1.0], (count, 1)))
        every.rotation[self.views], every.place_m[self.views] = self.poses.rotation, self.poses.place_m
        return every


def _without_outliers(seen: Observations, views: BoolArray, model: CameraModel, poses: Poses) -> LensFit:
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
    residual_px = kept.model.project(kept.poses.points(own.view, own.points_m)[0]) - own.pixels
    freedom = _freedom(len(own.view), len(kept.poses.place_m), 4 + len(model.distortion))
    extra_px = _extra_sigma_px(own, residual_px, freedom, typical=False)
    fit = adjust_bundle(kept.model, kept.poses, own, own.whitening(extra_px))
    return LensFit(fit, own, kept.views, kept.corners, extra_px, misfit)


def _agreeing(seen: Observations, kept: _Inliers, before: FloatArray) -> tuple[BoolArray, BoolArray, FloatArray, float]:
    """(N,) corners and (V,) views that agree with the camera so far, each view's misfit, and the extra sigma."""
    count = len(kept.views)
    residual = kept.model.project(kept.every_pose().points(seen.view, seen.points_m)[0]) - seen.pixels
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
        raise CalibError("no view agrees with another; is it the board that the pictures show?")
    return np.asarray(corners & stay[seen.view]), stay, misfit, extra_px


def _freedom(corners: int, views: int, parameters: int) -> int:
    return max(2 * corners - 6 * views - parameters, 1)


def _squares(seen: Observations, residual_px: FloatArray, extra_px: float) -> FloatArray:
    """(N,) squared whitened residuals; infinite without an image."""
    whitened = np.einsum("nij,nj->ni", seen.whitening(extra_px), residual_px)
    return np.asarray(np.nan_to_num((whitened**2).sum(axis=1), nan=np.inf))


def _extra_sigma_px(seen: Observations, residual_px: FloatArray, freedom: int, typical: bool) -> float:
    """The sigma beside the light's noise with which squares have their expected mean, or their expected median."""
    share = freedom / (2.0 * len(residual_px))

    def excess(extra_px: float) -> float:
        square = _squares(seen, residual_px, extra_px)
        return float(np.median(square) / MEDIAN_CHI2 if typical else 0.5 * square.mean()) - share

    if excess(0.0) <= 0.0:
        return 0.0
    if excess(_LARGEST_EXTRA_PX) > 0.0:
        return _LARGEST_EXTRA_PX
    return float(brentq(excess, 0.0, _LARGEST_EXTRA_PX, xtol=1e-5))


def _medians(seen: Observations, square: FloatArray, n_views: int) -> FloatArray:
    """(V,) of each view's corners: some that are wrong, or beyond a lens's image, do not condemn a view."""
    return np.array(
        [np.median(square[seen.view == view]) if (seen.view == view).any() else np.nan for view in range(n_views)]
    )


def _outlying(misfit: FloatArray, views: BoolArray) -> BoolArray:
    """(V,) views whose residuals are larger than the scatter among views allows."""
    logarithm = np.log(np.clip(misfit, 1e-12, 1e12))
    middle = float(np.median(logarithm[views]))
    scatter = 1.4826 * float(np.median(np.abs(logarithm[views] - middle)))
    return np.asarray(np.nan_to_num(logarithm - middle) > _VIEW_SIGMAS * max(scatter, _LEAST_SCATTER))
