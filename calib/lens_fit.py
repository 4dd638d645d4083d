"""Fits one camera to many views of a board and finds out what does not belong: corners, and whole views.

What a corner errs by is the light's noise, which its own fit tells, and something more that is the same for all and is
estimated here, so that the squared whitened residuals have their expected mean. All tests are made with that.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.optimize import brentq
from scipy.stats import chi2

from calib.arrays import BoolArray, FloatArray
from calib.bundle import Fit, Observations, Poses, adjusted, poses_of, renumbered
from calib.camera_model import CameraModel
from calib.errors import CalibError
from calib.lens_parameters import undistorted_camera

_FOCALS: Final = np.geomspace(0.15, 5.0, 30)  # of the picture's width: from a fisheye to a telescope
_VIEWS_FOR_GUESS: Final = 12
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
        view_misfit: (V,) mean squared whitened residual of each view's corners, NaN without a pose.
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


def fitted_lens(seen: Observations, n_views: int, start: CameraModel) -> LensFit:
    """Fits a camera robustly.

    Args:
        seen: corners of all views.
        n_views: V.
        start: a camera near enough, as `first_guess` gives one.

    Raises:
        CalibError: no three views have a pose.
    """
    poses, views = poses_of(start, seen, n_views)
    counts = np.bincount(seen.view, minlength=n_views)
    views &= counts >= _LEAST_CORNERS
    if views.sum() < 1:
        raise CalibError("the board fits no view; is it the board that the pictures show?")
    poses = poses.where(views)
    model, poses = _robust(start, poses, renumbered(seen, views))
    return _without_outliers(seen, views, model, poses)


def first_guess(seen: Observations, n_views: int, size_px: tuple[int, int], kind: str, name: str) -> CameraModel:
    """A camera without distortion whose focal length explains some of the views best.

    Raises:
        CalibError: none does.
    """
    some = np.zeros(n_views, dtype=np.bool_)
    largest_first = np.argsort(-np.bincount(seen.view, minlength=n_views), kind="stable")
    some[largest_first[:_VIEWS_FOR_GUESS]] = True
    own, count = renumbered(seen, some), int(some.sum())
    best, least = None, np.inf
    for focal in _FOCALS:
        camera = undistorted_camera(name, size_px, kind, float(focal * size_px[0]))
        poses, good = poses_of(camera, own, count)
        pixels = camera.project(poses.points(own.view, own.points_m)[0])
        error = np.linalg.norm(pixels - own.pixels, axis=1)
        error[~good[own.view] | ~np.isfinite(error)] = size_px[0]
        misfit = float(np.mean(np.sqrt(error)))  # a view that does not fit weighs little
        if misfit < least:
            best, least = camera, misfit
    if best is None:
        raise CalibError(
            "no focal length explains the views; are the pictures of one camera, and not cut or stretched?"
        )
    return best


def _robust(start: CameraModel, poses: Poses, seen: Observations) -> tuple[CameraModel, Poses]:
    """Least squares with Cauchy's weights, whose scale is the residuals' own."""
    model, weight = start, np.ones(len(seen.view))
    for _ in range(_ROBUST_ROUNDS):
        imaged = np.isfinite(model.project(poses.points(seen.view, seen.points_m)[0])).all(axis=1)
        whitening = np.where(imaged, np.sqrt(weight), 0.0)[:, None, None] * np.eye(2)
        fit = adjusted(model, poses, seen, whitening)
        model, poses = fit.model, fit.poses
        square = np.nan_to_num((fit.residual_px**2).sum(axis=1), nan=np.inf)
        scale = float(np.median(square)) / MEDIAN_CHI2 * _CAUCHY**2
        weight = 1.0 / (1.0 + square / max(scale, 1e-12))
    return model, poses


@dataclass(frozen=True)
class _Kept:
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
    kept = _Kept(views, np.asarray(views[seen.view]), model, poses)
    misfit = np.full(len(views), np.nan)
    for _ in range(_REJECTING_ROUNDS):
        corners, stay, misfit, extra_px = _agreeing(seen, kept, misfit)
        own = renumbered(seen.where(corners), stay)
        fit = adjusted(kept.model, kept.poses.where(stay[kept.views]), own, own.whitening(extra_px))
        unchanged = np.array_equal(corners, kept.corners) and np.array_equal(stay, kept.views)
        kept = _Kept(stay, corners, fit.model, fit.poses)
        if unchanged:
            break
    own = renumbered(seen.where(kept.corners), kept.views)
    residual_px = kept.model.project(kept.poses.points(own.view, own.points_m)[0]) - own.pixels
    freedom = _freedom(len(own.view), len(kept.poses.place_m), 4 + len(model.distortion))
    extra_px = _extra_sigma_px(own, residual_px, freedom, typical=False)
    fit = adjusted(kept.model, kept.poses, own, own.whitening(extra_px))
    return LensFit(fit, own, kept.views, kept.corners, extra_px, misfit)


def _agreeing(seen: Observations, kept: _Kept, before: FloatArray) -> tuple[BoolArray, BoolArray, FloatArray, float]:
    """(N,) corners and (V,) views that agree with the camera so far, each view's misfit, and the extra sigma."""
    count = len(kept.views)
    residual = kept.model.project(kept.every_pose().points(seen.view, seen.points_m)[0]) - seen.pixels
    freedom = _freedom(int(kept.corners.sum()), int(kept.views.sum()), 4 + len(kept.model.distortion))
    extra_px = _extra_sigma_px(seen.where(kept.corners), residual[kept.corners], freedom, typical=True)
    square = _squares(seen, residual, extra_px)
    limit = float(chi2.isf(_WRONGLY_REJECTED / len(seen.view), 2))
    posed = np.asarray(kept.views[seen.view])
    misfit = np.where(kept.views, _view_misfit(seen, np.minimum(square, 10.0 * limit), posed, count), before)
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


def _view_misfit(seen: Observations, square: FloatArray, posed: BoolArray, n_views: int) -> FloatArray:
    """(V,) mean over a view's corners of the squares, halved: about 1; NaN without corners."""
    count = np.bincount(seen.view[posed], minlength=n_views)
    total = np.bincount(seen.view[posed], weights=square[posed], minlength=n_views)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(0.5 * total / count)


def _outlying(misfit: FloatArray, views: BoolArray) -> BoolArray:
    """(V,) views whose residuals are larger than the scatter among views allows."""
    logarithm = np.log(np.maximum(misfit, 1e-12))
    middle = float(np.median(logarithm[views]))
    scatter = 1.4826 * float(np.median(np.abs(logarithm[views] - middle)))
    return np.asarray(np.nan_to_num(logarithm - middle) > _VIEW_SIGMAS * max(scatter, _LEAST_SCATTER))
