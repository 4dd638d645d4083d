"""Calibration from views of a board: fit a camera, refine the corners with it, fit again, and choose the lens model.

A lens bends the edges of the board. Corners fitted with straight edges are off by hundredths of a pixel, with the same
bias all over a part of the picture. The first camera therefore predicts the bends and further corners, and the corners
are fitted again. This is repeated while the bends change enough to matter.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import log, sqrt
from typing import Final

import numpy as np

from groundsbot.calib.board import BoardFinder, BoardView
from groundsbot.calib.camera import CameraModel
from groundsbot.calib.errors import CalibError
from groundsbot.calib.foundation import BoolArray, FloatArray
from groundsbot.calib.intrinsics.bundle import (
    BoardObservations,
    Fit,
    Poses,
    find_poses,
    fit_camera,
    project_corners,
    select_views,
)
from groundsbot.calib.intrinsics.robust_fit import MEDIAN_CHI2, LensFit, every_pose, first_guess, fit_lens

# In order of preference: most lenses are plumb_bob's, and equidistant has no tangential terms for a tilted sensor.
KINDS: Final = ("plumb_bob", "equidistant", "rational_polynomial")
_FOLDS: Final = 5
_LOOKS: Final = 3  # rounds of corner refinement; more than two have not been seen to matter
_TOO_BLURRED: Final = 4.0  # robust sigmas of the views' blur
_LEAST_BLUR_SCATTER: Final = 0.1  # of the logarithm of the blur


@dataclass(frozen=True)
class Calibration:
    """A calibrated camera and the data of its fit.

    Attributes:
        lens: the fit; its views are those of `views`.
        views: every view of the board, with its refined corners.
        poses: the pose of every view.
        blurred: (V,) views left out because they are more blurred than the others.
        scores: cross-validation error of each lens model tried: mean squared residual in left-out views, in px^2.
    """

    lens: LensFit
    views: Sequence[BoardView]
    poses: Poses
    blurred: BoolArray
    scores: dict[str, float]

    @property
    def model(self) -> CameraModel:
        """The camera."""
        return self.lens.fit.model

    @property
    def corner_sigma_px(self) -> float:
        """Sigma of a typical corner's coordinate, from the median residual."""
        return float(np.sqrt(np.median((self.lens.fit.residual_px**2).sum(axis=1)) / MEDIAN_CHI2))


def calibrate_camera(
    views: Sequence[BoardView], finder: BoardFinder, name: str, kinds: Sequence[str] = KINDS
) -> Calibration:
    """Calibrate the camera that took the views, with the lens model that predicts left-out views best.

    Args:
        views: views of the board.
        finder: the finder of the board.
        name: name of the camera.
        kinds: lens models to choose from.

    Raises:
        CalibError: the views do not determine a camera.
    """
    lens = first_fit(views, finder, name, kinds)
    poses = every_pose(lens.fit, lens.views, collect_observations(views, finder))
    found = _refine_corners(_RefinedViews(views, lens, poses), finder)
    scores = {found.lens.fit.model.distortion_model: 0.0}
    if len(kinds) > 1:
        chosen, scores = _cross_validate(found.lens, kinds)
        if chosen.distortion_model != found.lens.fit.model.distortion_model:
            found = _refine_corners(_refit(found, chosen, finder), finder)
    return Calibration(found.lens, found.views, found.poses, find_blurred(found.views), scores)


@dataclass(frozen=True)
class _RefinedViews:
    """Views with their refined corners, and the camera and poses fitted to them."""

    views: Sequence[BoardView]
    lens: LensFit
    poses: Poses
    expected: FloatArray | None = None  # (V, K, 13, 2) predicted points used by the last refinement


def _refine_corners(look: _RefinedViews, finder: BoardFinder) -> _RefinedViews:
    """Refine the corners at positions and with bends predicted by the camera, and refit, until both converge."""
    for _ in range(_LOOKS):
        expected = _expected_places(look, finder)
        if look.expected is not None and _has_converged(look, finder.largest_shift_px(look.expected, expected)):
            break
        views = [finder.find_again(view, each) for view, each in zip(look.views, expected, strict=True)]
        look = _refit(replace(look, views=views, expected=expected), look.lens.fit.model, finder)
    return look


def _expected_places(look: _RefinedViews, finder: BoardFinder) -> FloatArray:
    """Return the projections (V, K, 13, 2) of the points around each corner."""
    places = np.einsum("vij,kmj->vkmi", look.poses.rotation, finder.places_around_m())
    return look.lens.fit.model.project(places + look.poses.place_m[:, None, None])


def _has_converged(look: _RefinedViews, moved_px: FloatArray) -> bool:
    """Return whether shifts (V, K) of the corners are negligible.

    Their sum of squares over the corners' variance must be below the number of intrinsics, so that they change the
    camera by less than noise does.
    """
    corners = [view.corners for view in look.views]
    moved = np.concatenate([each[own.ids] for each, own in zip(moved_px, corners, strict=True)])[look.lens.corners]
    fit = look.lens.fit
    return bool((moved**2).sum() < len(fit.information) * fit.sigma_px**2)


def _refit(look: _RefinedViews, start: CameraModel, finder: BoardFinder) -> _RefinedViews:
    """Return the views with camera and poses fitted again, from an initial camera."""
    seen = collect_observations(look.views, finder)
    lens = _fit_without(find_blurred(look.views), seen, start)
    return replace(look, lens=lens, poses=every_pose(lens.fit, lens.views, seen))


def collect_observations(views: Sequence[BoardView], finder: BoardFinder) -> BoardObservations:
    """Return the corners of all views."""
    corners = [view.corners for view in views]
    return BoardObservations(
        np.concatenate([np.full(len(each.ids), index) for index, each in enumerate(corners)]).astype(np.int64),
        finder.corners_m[np.concatenate([each.ids for each in corners])],
        np.concatenate([each.pixels for each in corners]),
    )


def first_fit(views: Sequence[BoardView], finder: BoardFinder, name: str, kinds: Sequence[str]) -> LensFit:
    """Fit a camera to corners that were detected without a camera.

    Of the lens models that fit as well as the best, the first of `KINDS` is returned. A model with more parameters
    always fits slightly better, but may extrapolate badly to the region where corners are searched next.

    Raises:
        CalibError: no lens model fits.
    """
    size_px = views[0].picture.shape[1], views[0].picture.shape[0]
    seen = collect_observations(views, finder)
    found: list[tuple[LensFit, float]] = []
    why = ""
    for kind in sorted(kinds, key=KINDS.index):
        try:
            lens = fit_lens(seen, len(views), first_guess(seen, len(views), size_px, kind, name))
        except CalibError as error:
            why = str(error)
            continue
        residual = project_corners(lens.fit.model, every_pose(lens.fit, lens.views, seen), seen) - seen.pixels
        found.append((lens, float(np.median(np.nan_to_num((residual**2).sum(axis=1), nan=np.inf)))))
    if not found:
        raise CalibError(why)
    # Noise gives squared distances an exponential distribution; the median of N has the relative standard error
    # 1 / (ln 2 sqrt(N)).
    alike = 1.0 + 2.0 / (log(2.0) * sqrt(len(seen.view)))
    least = min(typical for _, typical in found)
    return next(lens for lens, typical in found if typical <= alike * least)


def find_blurred(views: Sequence[BoardView]) -> BoolArray:
    """Return (V,) views whose blur is an outlier among the views, or that have no corners."""
    blur_px = np.array([np.median(view.corners.blur_px) if len(view.corners.ids) else np.inf for view in views])
    logarithm = np.log(blur_px)
    middle = float(np.median(logarithm))
    scatter = max(1.4826 * float(np.median(np.abs(logarithm - middle))), _LEAST_BLUR_SCATTER)
    return np.asarray(logarithm - middle > _TOO_BLURRED * scatter)


def _fit_without(left_out: BoolArray, seen: BoardObservations, start: CameraModel) -> LensFit:
    """Fit the views that are not left out, and return the result with masks over all views and corners."""
    kept = ~left_out
    of_kept = np.asarray(kept[seen.view])
    lens = fit_lens(select_views(seen, kept), int(kept.sum()), start)
    views, corners = np.zeros(len(kept), dtype=np.bool_), np.zeros(len(seen.view), dtype=np.bool_)
    misfit = np.full(len(kept), np.nan)
    views[kept], corners[of_kept], misfit[kept] = lens.views, lens.corners, lens.view_misfit
    return replace(lens, views=views, corners=corners, view_misfit=misfit)


def _cross_validate(lens: LensFit, kinds: Sequence[str]) -> tuple[CameraModel, dict[str, float]]:
    """Return the first camera of `KINDS` within one standard error of the best cross-validation error, and all scores.

    Source of the one-standard-error rule: Breiman et al., Classification and Regression Trees, 1984.
    """
    errors, cameras = {}, {}
    for kind in kinds:
        fit = _as_kind(lens, kind)
        if fit is not None:
            cameras[kind], errors[kind] = fit.model, _errors_left_out(lens, fit)
    best = min(errors, key=lambda kind: float(errors[kind].mean()))
    scores = {kind: float(each.mean()) for kind, each in errors.items()}
    for kind in sorted(errors, key=KINDS.index):
        excess = errors[kind] - errors[best]
        if excess.mean() <= excess.std(ddof=1) / np.sqrt(len(excess)):
            return cameras[kind], scores
    return cameras[best], scores


def _as_kind(lens: LensFit, kind: str) -> Fit | None:
    """Return a fit of another lens model to the same corners, or None if it does not image all of them."""
    model, seen, n_views = lens.fit.model, lens.seen, int(lens.views.sum())
    if kind == model.distortion_model:
        return lens.fit
    try:
        if kind == "rational_polynomial" and model.distortion_model == "plumb_bob":
            start = replace(model, distortion_model=kind, distortion=(*model.distortion, 0.0, 0.0, 0.0))
        else:
            start = first_guess(seen, n_views, (model.width_px, model.height_px), kind, model.name)
        fit = fit_camera(start, seen, n_views)
    except CalibError:
        return None
    return fit if np.isfinite(fit.residual_px).all() else None


def _errors_left_out(lens: LensFit, fit: Fit) -> FloatArray:
    """Return (views,) the mean squared residual in px^2 of each view with a camera fitted to other views."""
    seen, n_views = lens.seen, int(lens.views.sum())
    out = np.empty(n_views)
    for fold in range(min(_FOLDS, n_views)):
        tested = np.arange(n_views) % _FOLDS == fold
        try:
            trained = fit_camera(fit.model, select_views(seen, ~tested), int((~tested).sum())).model
        except CalibError:
            out[tested] = float(fit.model.width_px) ** 2
            continue
        test = select_views(seen, tested)
        residual = project_corners(trained, find_poses(trained, test, int(tested.sum())), test) - test.pixels
        square = np.nan_to_num((residual**2).sum(axis=1), nan=float(trained.width_px) ** 2)
        out[tested] = np.bincount(test.view, weights=square) / np.bincount(test.view)
    return out
