"""Bundle adjustment of the intrinsics of one camera and the poses of the board in its pictures.

The unknowns are the vector b of the intrinsics (`camera.parameters`) and a pose T_camera_board for each view,
retracted from the left: R <- exp(w) R, t <- t + d. The residuals are whitened reprojection errors of corners. A pose
affects its own view only, so poses are eliminated by the Schur complement. The remaining n x n matrix is the marginal
information of the intrinsics. The method is Levenberg-Marquardt with exact Jacobians.
"""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from groundsbot.calib.camera import CameraModel, board_pose, parameters_of, pixels_by_parameters, with_parameters
from groundsbot.calib.errors import CalibError
from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray

_ROUNDS: Final = 60
_ARRIVED: Final = 1e-10  # relative change of the cost
_LEAST_DAMPING: Final = 1e-12
_MOST_DAMPING: Final = 1e10


@dataclass(frozen=True)
class BoardObservations:
    """N corners in V views, sorted by view.

    Attributes:
        view: (N,) index of the view, 0 to V - 1.
        points_m: (N, 3) position in the board's frame.
        pixels: (N, 2) observed position in the picture.
        covariance: (N, 2, 2) px^2, from image noise.
    """

    view: IntArray
    points_m: FloatArray
    pixels: FloatArray
    covariance: FloatArray

    def where(self, mask: BoolArray) -> "BoardObservations":
        """Return the corners selected by a mask (N,), with unchanged view indices."""
        return BoardObservations(self.view[mask], self.points_m[mask], self.pixels[mask], self.covariance[mask])

    def whitening(self, extra_sigma_px: float) -> FloatArray:
        """Return (N, 2, 2) whitening matrices for the covariance plus an isotropic error `extra_sigma_px`."""
        total = self.covariance + extra_sigma_px**2 * np.eye(2)
        return np.asarray(np.linalg.cholesky(np.linalg.inv(total)).swapaxes(-1, -2))


@dataclass(frozen=True)
class Poses:
    """T_camera_board of V views.

    Attributes:
        rotation: (V, 3, 3).
        place_m: (V, 3) translation.
    """

    rotation: FloatArray
    place_m: FloatArray

    @staticmethod
    def default(n_views: int) -> "Poses":
        """Return placeholders: no rotation, 1 m in front of the camera."""
        return Poses(np.tile(np.eye(3), (n_views, 1, 1)), np.tile([0.0, 0.0, 1.0], (n_views, 1)))

    def retract(self, step: FloatArray) -> "Poses":
        """Return the poses rotated by `step` (V, 0:3) and shifted by `step` (V, 3:6)."""
        turns = Rotation.from_rotvec(step[:, :3]).as_matrix()
        return Poses(turns @ self.rotation, self.place_m + step[:, 3:])

    def where(self, mask: BoolArray) -> "Poses":
        """Return the poses selected by a mask (V,)."""
        return Poses(self.rotation[mask], self.place_m[mask])

    def points(self, view: IntArray, points_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return board points (N, 3) in the camera frame, and the same without the translation."""
        turned = np.einsum("nij,nj->ni", self.rotation[view], points_m)
        return turned + self.place_m[view], turned


@dataclass(frozen=True)
class Fit:
    """Result of a bundle adjustment.

    Attributes:
        model: the camera.
        poses: the poses of the views.
        residual_px: (N, 2) predicted minus observed.
        whitened: (N, 2) whitened residuals.
        information: (n, n) marginal information of the intrinsics.
        by_view: (V, n, n) contribution of each view to `information`.
        gradient_by_view: (V, n) half the gradient of each view's cost by the intrinsics, its pose eliminated.
    """

    model: CameraModel
    poses: Poses
    residual_px: FloatArray
    whitened: FloatArray
    information: FloatArray
    by_view: FloatArray
    gradient_by_view: FloatArray

    @property
    def cost(self) -> float:
        """Sum of the squared whitened residuals."""
        return float((self.whitened**2).sum())

    def covariance(self) -> FloatArray:
        """Return the covariance (n, n) of the intrinsics by the jackknife over views, in closed form.

        The estimate without view v is shifted by (I - I_v)^-1 g_v. Errors that the corners of a view share, as of a
        bent board or of light, and outlying views count as much as they matter; corners need not be independent.
        Source: Efron, The Jackknife, the Bootstrap and Other Resampling Plans, 1982.
        """
        n_views = len(self.by_view)
        shifts = [
            inverse(self.information - own) @ gradient
            for own, gradient in zip(self.by_view, self.gradient_by_view, strict=True)
        ]
        off = np.array(shifts) - np.mean(shifts, axis=0)
        return np.asarray((n_views - 1.0) / n_views * off.T @ off)


def inverse(information: FloatArray) -> FloatArray:
    """Return the inverse of an information matrix (n, n) whose unknowns differ by orders of magnitude.

    The matrix is scaled to a unit diagonal, and its eigenvalues are bounded below by 1e-15 of the largest. Directions
    without information therefore have a large finite covariance.
    """
    scale = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    values, vectors = np.linalg.eigh(information * scale[:, None] * scale)
    bounded = 1.0 / np.maximum(values, 1e-15 * values.max())
    return np.asarray((vectors * bounded) @ vectors.T * scale[:, None] * scale)


def adjust_bundle(
    start: CameraModel, poses: Poses, seen: BoardObservations, whitening: FloatArray, hold_intrinsics: bool = False
) -> Fit:
    """Return the least-squares estimate of camera and poses.

    Args:
        start: initial camera; its distortion model is kept.
        poses: initial poses, one for each view.
        seen: the corners.
        whitening: (N, 2, 2), zero for a corner to be ignored.
        hold_intrinsics: estimate the poses only.
    """
    system = _LeastSquares(seen, whitening)
    model, damping = start, 1e-4
    blocks = system.linearise(model, poses)
    for _ in range(_ROUNDS):
        step_b, step_poses = blocks.step(damping, hold_intrinsics)
        tried_model, tried_poses = _retract_camera(model, step_b), poses.retract(-step_poses)
        cost = np.inf if tried_model is None else system.cost(tried_model, tried_poses)
        if tried_model is not None and cost < blocks.cost:
            gain = blocks.cost - cost
            model, poses, damping = tried_model, tried_poses, max(0.1 * damping, _LEAST_DAMPING)
            blocks = system.linearise(model, poses)
            if gain < _ARRIVED * blocks.cost:
                break
        elif damping > _MOST_DAMPING or cost - blocks.cost < _ARRIVED * blocks.cost:
            break
        else:
            damping *= 10.0
    by_view, gradient = blocks.intrinsics_alone()
    information = np.asarray(by_view.sum(axis=0))
    return Fit(model, poses, blocks.residual_px, blocks.whitened, information, by_view, gradient)


def _retract_camera(model: CameraModel, step: FloatArray) -> CameraModel | None:
    """Return the camera with `step` subtracted, or None if its intrinsics are impossible."""
    try:
        return with_parameters(model, parameters_of(model) - step)
    except CalibError:
        return None


@dataclass(frozen=True)
class _Blocks:
    """Normal equations at one linearisation point."""

    residual_px: FloatArray
    whitened: FloatArray
    normal: FloatArray  # (V, n + 6, n + 6)
    gradient: FloatArray  # (V, n + 6)

    @property
    def cost(self) -> float:
        return float((self.whitened**2).sum())

    def step(self, damping: float, hold_intrinsics: bool) -> tuple[FloatArray, FloatArray]:
        """Return the steps to subtract: (n,) from the intrinsics, (V, 6) from the poses."""
        n = self.normal.shape[-1] - 6
        D = self._of_poses(damping)
        gain = np.linalg.solve(D, np.concatenate([self.normal[:, n:, :n], self.gradient[:, n:, None]], axis=-1))
        if hold_intrinsics:
            return np.zeros(n), gain[..., n]
        B = self.normal[:, :n, n:]
        A = self.normal[:, :n, :n].sum(axis=0)
        A = A + damping * np.diag(np.diag(A)) - (B @ gain[..., :n]).sum(axis=0)
        right = (self.gradient[:, :n] - np.einsum("vij,vj->vi", B, gain[..., n])).sum(axis=0)
        step_b = inverse(A) @ right
        return step_b, gain[..., n] - gain[..., :n] @ step_b

    def _of_poses(self, damping: float) -> FloatArray:
        """Return the damped blocks (V, 6, 6) of the poses; a view may have too few used corners for a pose."""
        of_poses = self.normal[:, -6:, -6:]
        diagonal = np.einsum("vii->vi", of_poses)
        return np.asarray(of_poses + (damping * diagonal[..., None] + _LEAST_DAMPING) * np.eye(6))

    def intrinsics_alone(self) -> tuple[FloatArray, FloatArray]:
        """Return each view's marginal information (V, n, n) and gradient (V, n) of the intrinsics."""
        n = self.normal.shape[-1] - 6
        right = np.concatenate([self.normal[:, n:, :n], self.gradient[:, n:, None]], axis=-1)
        gain = self.normal[:, :n, n:] @ np.linalg.solve(self._of_poses(_LEAST_DAMPING), right)
        return self.normal[:, :n, :n] - gain[..., :n], self.gradient[:, :n] - gain[..., n]


class _LeastSquares:
    """Least-squares problem of given corners and weights."""

    def __init__(self, seen: BoardObservations, whitening: FloatArray) -> None:
        self._seen = seen
        self._whitening = whitening
        self._used = np.abs(whitening).sum(axis=(1, 2)) > 0.0

    def cost(self, model: CameraModel, poses: Poses) -> float:
        """Return the cost, infinite if a used corner has no image."""
        whitened = self._whiten(project_corners(model, poses, self._seen))[1]
        cost = float((whitened**2).sum())
        return cost if np.isfinite(cost) else np.inf

    def _whiten(self, pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
        residual = pixels - self._seen.pixels
        counted = np.where(self._used[:, None], residual, 0.0)
        return residual, np.einsum("nij,nj->ni", self._whitening, counted)

    def linearise(self, model: CameraModel, poses: Poses) -> _Blocks:
        points, turned = poses.points(self._seen.view, self._seen.points_m)
        pixels, by_point = model.project_with_jacobian(points)
        residual, whitened = self._whiten(pixels)
        by_turn = np.cross(turned[:, None, :], by_point)  # J (w x p) = (p x J) w, row by row
        J = np.concatenate([pixels_by_parameters(model, points, pixels), by_turn, by_point], axis=-1)
        J = self._whitening @ np.where(self._used[:, None, None], J, 0.0)
        views = len(poses.place_m)
        normal, gradient = np.zeros((views, J.shape[-1], J.shape[-1])), np.zeros((views, J.shape[-1]))
        for view in range(views):
            own = J[self._seen.view == view].reshape(-1, J.shape[-1])
            normal[view] = own.T @ own
            gradient[view] = own.T @ whitened[self._seen.view == view].ravel()
        return _Blocks(residual, whitened, normal, gradient)


def poses_of(model: CameraModel, seen: BoardObservations, views: int, rank: int = 0) -> tuple[Poses, BoolArray]:
    """Return the pose of each view by itself for a given camera, and (V,) which views have one.

    `rank` is that of `board_pose`. Views without a pose have a placeholder.
    """
    poses, good = Poses.default(views), np.zeros(views, bool)
    rays = model.unproject(seen.pixels)
    for view in range(views):
        own = seen.view == view
        pose = board_pose(seen.points_m[own], rays[own], rank)
        if pose is not None:
            poses.rotation[view], poses.place_m[view], good[view] = *pose, True
    return poses, good


def project_corners(model: CameraModel, poses: Poses, seen: BoardObservations) -> FloatArray:
    """Return the projections (N, 2) of the corners; NaN where the lens has no image."""
    return model.project(poses.points(seen.view, seen.points_m)[0])


def has_image(model: CameraModel, poses: Poses, seen: BoardObservations) -> BoolArray:
    """Return (N,) whether the lens images a corner."""
    return np.asarray(np.isfinite(project_corners(model, poses, seen)).all(axis=1))


def select_views(seen: BoardObservations, kept: BoolArray) -> BoardObservations:
    """Return the corners of the views selected by a mask (V,), with views renumbered."""
    number = np.cumsum(kept) - 1
    own = seen.where(np.asarray(kept[seen.view]))
    return replace(own, view=number[own.view].astype(np.int64))
