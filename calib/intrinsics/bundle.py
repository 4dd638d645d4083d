"""Least-squares fit of the intrinsics of one camera and of the poses of the board in its pictures.

OpenCV fits the intrinsics. Gauss-Newton steps from there are for what OpenCV leaves undone: its fisheye fit fails if
corners lie farther than some 85 degrees from the axis (4 of 20 simulated cameras), and leaving these corners out for
good costs 6 to 16 % of the accuracy. The unknowns are the vector b of the intrinsics (`camera.parameters`) and a pose
T_camera_board for each view, retracted from the left: R <- exp(w) R, t <- t + d. A pose affects its own view only and
is eliminated from it; what remains of a view is its marginal information about the intrinsics.
"""

from dataclasses import dataclass, replace
from typing import Final

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from groundsbot.calib.camera import CameraModel, board_pose, parameters_of, pixels_by_parameters, with_parameters
from groundsbot.calib.errors import CalibError
from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray

_STEPS: Final = 20
_ARRIVED: Final = 1e-9  # relative change of the cost
_CRITERIA: Final = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
_FISHEYE_WIDEST_RAD: Final = np.radians(80.0)
LEAST_CORNERS: Final = 6  # of a view
# Least share of the information in a direction that other views are taken to have; below it, rounding dominates.
_LEAST_OF_OTHERS: Final = 1e-4


@dataclass(frozen=True)
class BoardObservations:
    """N corners in V views, sorted by view.

    Attributes:
        view: (N,) index of the view, 0 to V - 1.
        points_m: (N, 3) position in the board's frame.
        pixels: (N, 2) observed position in the picture.
    """

    view: IntArray
    points_m: FloatArray
    pixels: FloatArray

    def where(self, mask: BoolArray) -> "BoardObservations":
        """Return the corners selected by a mask (N,), with unchanged view indices."""
        return BoardObservations(self.view[mask], self.points_m[mask], self.pixels[mask])


@dataclass(frozen=True)
class Poses:
    """T_camera_board of V views; NaN for a view without a pose.

    Attributes:
        rotation: (V, 3, 3).
        place_m: (V, 3) translation.
    """

    rotation: FloatArray
    place_m: FloatArray

    def retract(self, step: FloatArray) -> "Poses":
        """Return the poses rotated by `step` (V, 0:3) and shifted by `step` (V, 3:6)."""
        turns = Rotation.from_rotvec(step[:, :3]).as_matrix()
        return Poses(turns @ self.rotation, self.place_m + step[:, 3:])

    def points(self, view: IntArray, points_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return board points (N, 3) in the camera frame, and the same without the translation."""
        turned = np.einsum("nij,nj->ni", self.rotation[view], points_m)
        return turned + self.place_m[view], turned


@dataclass(frozen=True)
class Fit:
    """Least-squares estimate of the n intrinsics of a camera and of the poses of V views, from N corners.

    Attributes:
        model: estimated camera.
        poses: T_camera_board of each view.
        residual_px: (N, 2) predicted minus observed corners; NaN where the predicted one is outside the image circle.
        sigma_px: standard deviation of a corner's coordinate, from the residuals.
        by_view: (V, n, n) information of each view about the intrinsics, its pose marginalised, for `sigma_px`.
        gradient_by_view: (V, n) half the gradient of each view's cost with respect to the intrinsics, its pose
            eliminated.
    """

    model: CameraModel
    poses: Poses
    residual_px: FloatArray
    sigma_px: float
    by_view: FloatArray
    gradient_by_view: FloatArray

    @property
    def information(self) -> FloatArray:
        """Marginal information (n, n) of the intrinsics, from the noise of independent corners."""
        return np.asarray(self.by_view.sum(axis=0))

    def covariance(self) -> FloatArray:
        """Return the covariance (n, n) of the intrinsics, from how the gradients of the views scatter.

        Errors that the corners of a view share, as of a bent board or of light, and outlying views count as much as
        they matter; corners need not be independent. A view draws the fit towards itself, so its gradient is too small,
        by its share H = I^-1/2 I_v I^-1/2 of the information: in whitened coordinates it is divided by (1 - H)^1/2.
        For independent corners the covariance then has the expectation I^-1 with any number of views. Dividing by
        1 - H, as the jackknife does, makes sigmas of few views too large.
        Source: Bell and McCaffrey, Bias reduction in standard errors for linear regression, 2002.
        """
        root = _inverse_root(self.information)
        shifts = []
        for own, gradient in zip(self.by_view, self.gradient_by_view, strict=True):
            shares, vectors = np.linalg.eigh(root.T @ own @ root)
            reduced = np.sqrt(np.maximum(1.0 - shares, _LEAST_OF_OTHERS))
            shifts.append(root @ (vectors / reduced) @ vectors.T @ root.T @ gradient)
        return np.asarray(np.transpose(shifts) @ shifts)


def inverse(information: FloatArray) -> FloatArray:
    """Return the inverse of an information matrix (n, n) whose unknowns differ by orders of magnitude.

    The matrix is scaled to a unit diagonal, and its eigenvalues are bounded below by 1e-15 of the largest. Directions
    without information therefore have a large finite covariance.
    """
    root = _inverse_root(information)
    return np.asarray(root @ root.T)


def _inverse_root(information: FloatArray) -> FloatArray:
    """Return a matrix (n, n) whose product with its own transpose is the inverse of an information matrix."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    values, vectors = np.linalg.eigh(information * scale[:, None] * scale)
    return np.asarray(scale[:, None] * vectors / np.sqrt(np.maximum(values, 1e-15 * values.max())))


def fit_camera(start: CameraModel, seen: BoardObservations, n_views: int) -> Fit:
    """Return the least-squares estimate of a camera and of the poses of its views.

    Args:
        start: initial camera; its distortion model is kept.
        seen: the corners; each counts alike.
        n_views: number of views.

    Raises:
        CalibError: the corners do not determine a camera.
    """
    model = _fit_by_opencv(start, seen, n_views)
    poses = find_poses(model, seen, n_views)
    at = _Linearisation(model, poses, seen)
    for _ in range(_STEPS):
        by_view, gradient = at.without_poses()
        step_b = inverse(by_view.sum(axis=0)) @ gradient.sum(axis=0)
        try:
            tried = with_parameters(at.model, parameters_of(at.model) - step_b)
        except CalibError:
            break
        ahead = _Linearisation(tried, at.poses.retract(-at.pose_steps(step_b)), seen)
        gain = at.cost.sum() - ahead.cost.sum()
        if not gain > 0.0:
            break
        at = ahead
        if gain < _ARRIVED * at.cost.sum():
            break
    by_view, gradient = at.without_poses()
    freedom = max(2 * len(seen.view) - 6 * n_views - gradient.shape[1], 1)
    variance = max(float(at.cost.sum()) / freedom, 1e-12)
    return Fit(at.model, at.poses, at.residual_px, variance**0.5, by_view / variance, gradient / variance)


def _fit_by_opencv(start: CameraModel, seen: BoardObservations, n_views: int) -> CameraModel:
    is_fisheye = start.distortion_model == "equidistant"
    if is_fisheye:
        near_axis = start.unproject(seen.pixels)[:, 2] > np.cos(_FISHEYE_WIDEST_RAD)
        near_axis &= np.bincount(seen.view[near_axis], minlength=n_views)[seen.view] >= LEAST_CORNERS
        seen = seen.where(near_axis)
    own = [seen.view == view for view in np.unique(seen.view)]
    points = [seen.points_m[each].astype(np.float32)[:, None] for each in own]
    pixels = [seen.pixels[each].astype(np.float32)[:, None] for each in own]
    given = points, pixels, (start.width_px, start.height_px), start.matrix, np.array(start.distortion)[:, None]
    n_threads = cv2.getNumThreads()
    cv2.setNumThreads(1)  # several would add up in any order, with other results each time
    try:
        if is_fisheye:
            flags = cv2.fisheye.CALIB_USE_INTRINSIC_GUESS | cv2.fisheye.CALIB_FIX_SKEW
            flags |= cv2.fisheye.CALIB_RECOMPUTE_EXTRINSIC
            _, K, distortion, _, _ = cv2.fisheye.calibrate(*given, flags=flags, criteria=_CRITERIA)
        else:
            flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_USE_LU
            flags |= cv2.CALIB_RATIONAL_MODEL if start.distortion_model == "rational_polynomial" else 0
            _, K, distortion, _, _ = cv2.calibrateCamera(*given, flags=flags, criteria=_CRITERIA)
        coefficients = distortion.ravel()[: len(start.distortion)]
        return with_parameters(start, np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], *coefficients]))
    except (cv2.error, CalibError) as error:
        raise CalibError(
            f"the corners determine no {start.distortion_model} camera; take more views, all over the picture and "
            "tilted every way, or another --model"
        ) from error
    finally:
        cv2.setNumThreads(n_threads)


class _Linearisation:
    """Residuals of the corners and their derivatives, for given camera and poses.

    Attributes:
        model: the camera.
        poses: the poses.
        residual_px: (N, 2) predicted minus observed; NaN where the lens has no image.
        cost: (V,) sum of squared residuals of each view; a corner without image is off by the picture's width.
    """

    def __init__(self, model: CameraModel, poses: Poses, seen: BoardObservations) -> None:
        self.model, self.poses = model, poses
        points, turned = poses.points(seen.view, seen.points_m)
        pixels, by_point = model.project_with_jacobian(points)
        self.residual_px = pixels - seen.pixels
        by_turn = np.cross(turned[:, None, :], by_point)  # J (w x p) = (p x J) w, row by row
        jacobian = np.concatenate([pixels_by_parameters(model, points), by_turn, by_point], axis=-1)
        imaged = np.isfinite(self.residual_px).all(axis=1)
        own = [imaged & (seen.view == view) for view in range(len(poses.place_m))]
        self._residual = [self.residual_px[each].ravel() for each in own]
        self._jacobian = [jacobian[each].reshape(-1, jacobian.shape[-1]) for each in own]
        lost = np.bincount(seen.view[~imaged], minlength=len(own))
        self.cost = np.array([each @ each for each in self._residual]) + float(model.width_px) ** 2 * lost

    def without_poses(self) -> tuple[FloatArray, FloatArray]:
        """Return the marginal information (V, n, n) of each view for a sigma of 1 px, and half its gradient (V, n)."""
        information, gradient = [], []
        for J, residual in zip(self._jacobian, self._residual, strict=True):
            of_pose = np.linalg.qr(J[:, -6:])[0]
            left = J[:, :-6] - of_pose @ (of_pose.T @ J[:, :-6])
            information.append(left.T @ left)
            gradient.append(left.T @ residual)
        return np.array(information), np.array(gradient)

    def pose_steps(self, step_b: FloatArray) -> FloatArray:
        """Return the steps (V, 6) to subtract from the poses if `step_b` is subtracted from the intrinsics."""
        return np.array(
            [
                np.linalg.lstsq(J[:, -6:], residual - J[:, :-6] @ step_b, rcond=None)[0]
                for J, residual in zip(self._jacobian, self._residual, strict=True)
            ]
        )


def first_poses(model: CameraModel, seen: BoardObservations, n_views: int) -> Poses:
    """Return an estimate of the pose of each view for a given camera, exact without noise."""
    poses = Poses(np.full((n_views, 3, 3), np.nan), np.full((n_views, 3), np.nan))
    rays = model.unproject(seen.pixels)
    for view in range(n_views):
        own = seen.view == view
        pose = board_pose(seen.points_m[own], rays[own])
        if pose is not None:
            poses.rotation[view], poses.place_m[view] = pose
    return poses


def find_poses(model: CameraModel, seen: BoardObservations, n_views: int) -> Poses:
    """Return the pose of each view with the least squared residuals for a given camera."""
    at = _Linearisation(model, first_poses(model, seen, n_views), seen)
    for _ in range(_STEPS):
        ahead = _Linearisation(model, at.poses.retract(-at.pose_steps(np.zeros(len(parameters_of(model))))), seen)
        better = at.cost - ahead.cost > _ARRIVED * at.cost
        if not better.any():
            break
        rotation = np.where(better[:, None, None], ahead.poses.rotation, at.poses.rotation)
        place_m = np.where(better[:, None], ahead.poses.place_m, at.poses.place_m)
        at = _Linearisation(model, Poses(rotation, place_m), seen)
    return at.poses


def project_corners(model: CameraModel, poses: Poses, seen: BoardObservations) -> FloatArray:
    """Return the projections (N, 2) of the corners; NaN where the lens has no image."""
    return model.project(poses.points(seen.view, seen.points_m)[0])


def select_views(seen: BoardObservations, kept: BoolArray) -> BoardObservations:
    """Return the corners of the views selected by a mask (V,), with views renumbered."""
    number = np.cumsum(kept) - 1
    own = seen.where(np.asarray(kept[seen.view]))
    return replace(own, view=number[own.view].astype(np.int64))
