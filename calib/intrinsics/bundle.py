"""Bundle adjustment: the intrinsics of one camera and where the board is in each of its pictures.

The unknowns are the camera's vector b (`camera.parameters`) and for each view a pose T_camera_board, turned and shifted
from the left: R <- exp(w) R, t <- t + d. Residuals are whitened corners. Poses touch their own view only, so they are
eliminated: what is left is the n x n system of the intrinsics, and its matrix is their information once all poses are
unknown. Levenberg-Marquardt; Jacobians exact.
"""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from groundsbot.calib.camera import CameraModel, board_pose, parameters_of, pixels_by_parameters, with_parameters
from groundsbot.calib.errors import CalibError
from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray

_ROUNDS: Final = 60
_ARRIVED: Final = 1e-10  # of the cost, relative
_LEAST_DAMPING: Final = 1e-12
_MOST_DAMPING: Final = 1e10


@dataclass(frozen=True)
class Observations:
    """N corners in V views, in order of views.

    Attributes:
        view: (N,) 0 to V - 1.
        points_m: (N, 3) in the board's frame.
        pixels: (N, 2).
        covariance: (N, 2, 2) px^2, of the light's noise.
    """

    view: IntArray
    points_m: FloatArray
    pixels: FloatArray
    covariance: FloatArray

    def where(self, mask: BoolArray) -> "Observations":
        """Those of the mask, their views with the numbers they had."""
        return Observations(self.view[mask], self.points_m[mask], self.pixels[mask], self.covariance[mask])

    def whitening(self, extra_sigma_px: float) -> FloatArray:
        """(N, 2, 2) matrices that make residuals unit: with an error beyond the light's noise, alike everywhere."""
        total = self.covariance + extra_sigma_px**2 * np.eye(2)
        return np.asarray(np.linalg.cholesky(np.linalg.inv(total)).swapaxes(-1, -2))


@dataclass(frozen=True)
class Poses:
    """T_camera_board of V views."""

    rotation: FloatArray  # (V, 3, 3)
    place_m: FloatArray  # (V, 3)

    def retract(self, step: FloatArray) -> "Poses":
        """Turned by (V, 0:3) and shifted by (V, 3:6) of `step`."""
        turns = Rotation.from_rotvec(step[:, :3]).as_matrix()
        return Poses(turns @ self.rotation, self.place_m + step[:, 3:])

    def where(self, mask: BoolArray) -> "Poses":
        """Those of the mask."""
        return Poses(self.rotation[mask], self.place_m[mask])

    def points(self, view: IntArray, points_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Points (N, 3) of the board in the camera frame, and the same about the board's origin."""
        turned = np.einsum("nij,nj->ni", self.rotation[view], points_m)
        return turned + self.place_m[view], turned


@dataclass(frozen=True)
class Fit:
    """A camera and the poses that explain corners best.

    Attributes:
        model: the camera.
        poses: of the views.
        residual_px: (N, 2) predicted minus seen.
        whitened: (N, 2).
        information: (n, n) of the intrinsics, poses unknown.
        by_view: (V, n, n) each view's share of it.
    """

    model: CameraModel
    poses: Poses
    residual_px: FloatArray
    whitened: FloatArray
    information: FloatArray
    by_view: FloatArray

    @property
    def cost(self) -> float:
        """Sum of the squared whitened residuals."""
        return float((self.whitened**2).sum())

    def covariance(self) -> FloatArray:
        """(n, n) of the intrinsics, for whitened residuals of unit size."""
        return inverse(self.information)


def inverse(information: FloatArray) -> FloatArray:
    """The inverse of an information matrix whose unknowns differ by powers of ten.

    Where it tells nothing, the inverse is 1e15 times what it is where it tells most, both scaled to a diagonal of one.
    """
    scale = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    values, vectors = np.linalg.eigh(information * scale[:, None] * scale)
    bounded = 1.0 / np.maximum(values, 1e-15 * values.max())
    return np.asarray((vectors * bounded) @ vectors.T * scale[:, None] * scale)


def adjust_bundle(
    start: CameraModel, poses: Poses, seen: Observations, whitening: FloatArray, hold_intrinsics: bool = False
) -> Fit:
    """The camera and the poses of least squares, from a start.

    Args:
        start: the camera to begin with; its model stays.
        poses: to begin with, one for each view.
        seen: the corners.
        whitening: (N, 2, 2), zero for a corner that is to be left out.
        hold_intrinsics: only the poses are looked for.
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
    information, by_view = blocks.intrinsics_alone()
    return Fit(model, poses, blocks.residual_px, blocks.whitened, information, by_view)


def _retract_camera(model: CameraModel, step: FloatArray) -> CameraModel | None:
    """None where the step leads to what no camera can be."""
    try:
        return with_parameters(model, parameters_of(model) - step)
    except CalibError:
        return None


@dataclass(frozen=True)
class _Blocks:
    """The normal equations at one place."""

    residual_px: FloatArray
    whitened: FloatArray
    normal: FloatArray  # (V, n + 6, n + 6)
    gradient: FloatArray  # (V, n + 6)

    @property
    def cost(self) -> float:
        return float((self.whitened**2).sum())

    def step(self, damping: float, hold_intrinsics: bool) -> tuple[FloatArray, FloatArray]:
        """To be subtracted: (n,) of the intrinsics, (V, 6) of the poses."""
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
        """(V, 6, 6), with so much more on the diagonal: of a view few corners may count, too few for a pose."""
        of_poses = self.normal[:, -6:, -6:]
        diagonal = np.einsum("vii->vi", of_poses)
        return np.asarray(of_poses + (damping * diagonal[..., None] + _LEAST_DAMPING) * np.eye(6))

    def intrinsics_alone(self) -> tuple[FloatArray, FloatArray]:
        """(n, n) information of the intrinsics where poses are unknown, and (V, n, n) each view's share."""
        n = self.normal.shape[-1] - 6
        D = self._of_poses(_LEAST_DAMPING)
        by_view = self.normal[:, :n, :n] - self.normal[:, :n, n:] @ np.linalg.solve(D, self.normal[:, n:, :n])
        return np.asarray(by_view.sum(axis=0)), np.asarray(by_view)


class _LeastSquares:
    """Corners and their weights."""

    def __init__(self, seen: Observations, whitening: FloatArray) -> None:
        self._seen = seen
        self._whitening = whitening
        self._used = np.abs(whitening).sum(axis=(1, 2)) > 0.0

    def cost(self, model: CameraModel, poses: Poses) -> float:
        """Infinite where a corner that counts has no image."""
        whitened = self._whiten(model.project(poses.points(self._seen.view, self._seen.points_m)[0]))[1]
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
        by_turn = np.cross(turned[:, None, :], by_point)  # of J (w x p): the row p x J
        J = np.concatenate([pixels_by_parameters(model, points, pixels), by_turn, by_point], axis=-1)
        J = self._whitening @ np.where(self._used[:, None, None], J, 0.0)
        views = len(poses.place_m)
        normal, gradient = np.zeros((views, J.shape[-1], J.shape[-1])), np.zeros((views, J.shape[-1]))
        for view in range(views):
            own = J[self._seen.view == view].reshape(-1, J.shape[-1])
            normal[view] = own.T @ own
            gradient[view] = own.T @ whitened[self._seen.view == view].ravel()
        return _Blocks(residual, whitened, normal, gradient)


def poses_of(model: CameraModel, seen: Observations, views: int, rank: int = 0) -> tuple[Poses, BoolArray]:
    """A pose for each view as this camera would have it, and (V,) which views have one; `rank` as in `board_pose`."""
    rotation, place, good = (
        np.tile(np.eye(3), (views, 1, 1)),
        np.tile([0.0, 0.0, 1.0], (views, 1)),
        np.zeros(views, bool),
    )
    rays = model.unproject(seen.pixels)
    for view in range(views):
        own = seen.view == view
        pose = board_pose(seen.points_m[own], rays[own], rank)
        if pose is not None:
            rotation[view], place[view], good[view] = *pose, True
    return Poses(rotation, place), good


def select_views(seen: Observations, kept: BoolArray) -> Observations:
    """The corners of the views of the mask (V,), their views numbered anew."""
    number = np.cumsum(kept) - 1
    own = seen.where(np.asarray(kept[seen.view]))
    return replace(own, view=number[own.view].astype(np.int64))
