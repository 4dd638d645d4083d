"""Estimates the horizontal range and bearing of tags from their corners in pixels.

Near a frontal view the tilt of a planar tag changes its apparent size to second order only. A full six-parameter pose
(PnP) therefore explains noise as tilt, which biases the range by up to half a sigma, with the same sign in every
picture. Most tags are mounted upright, and the vertical extent of such a tag does not depend on its heading. The model
used here is

    P_i = c + a_i(rho) (u_x, u_y, 0) + b_i(rho) (0, 0, 1)

where (a_i, b_i) are the corners on the face, rotated by the roll rho in its own plane. The length of the horizontal
direction u is free. This makes the model smooth through the frontal view and its estimates unbiased, at the cost of the
information that the horizontal edges have on the range.

Eight residuals less six parameters leave two degrees of freedom to test the model. A tag that fails the test, such as
one on a ceiling, is measured by the general pose with a range sigma that covers the bias of that pose.
"""

from dataclasses import dataclass, replace
from dataclasses import fields as dataclass_fields
from typing import Final

import numpy as np

from groundsbot.calib.camera import CameraModel, board_pose
from groundsbot.calib.foundation import BoolArray, FloatArray
from groundsbot.calib.tags import outward

# Corners of a tag with side 1 in its own frame; the order is that of groundsbot.proto.
UNIT_CORNERS: Final[FloatArray] = np.array([[-0.5, 0.5], [0.5, 0.5], [0.5, -0.5], [-0.5, -0.5]])

_ITERATIONS: Final = 8
_STEP_TOLERANCE: Final = 1e-9  # m and rad; convergence is quadratic
_N_PARAMETERS: Final = 6  # c (3), u (2), rho
# Sigmas of a general pose, far above its bias for sides of 15 px or more: along the line of sight relative to the
# range, across it in sigmas of one corner.
_GENERAL_ALONG: Final = 0.10
_GENERAL_ACROSS: Final = 1.5


@dataclass(frozen=True)
class TagMeasurements:
    """Horizontal ranges and bearings of M tags from the camera, in axes parallel to those of base.

    Attributes:
        range_bearing: (M, 2) m and rad; bearing positive to the left of base's forward axis.
        covariance: (M, 2, 2) for the given corner sigma; rest: (M, 2, 2) the part that does not depend on that sigma.
        by_turn: (M, 2, 3) derivative of range_bearing with respect to a small rotation (rad) of the camera about
            the axes of base, with the corners fixed.
        by_edge: (M, 2) derivative of range_bearing with respect to the outward shift (px) of the tag's sides, with
            the corners fixed.
        height_m: (M,) of the tag's centre above the camera; height_variance: (M,) m^2.
        chi2: (M,) squared whitened residuals, with two degrees of freedom where the model holds.
        valid: (M,) False where no pose in front of the camera explains the corners.
        misfit: (M, 8) whitened residuals of the upright model; misfit_by_turn: (M, 8, 3) their derivative with
            respect to a small rotation of the camera after refitting; zero for general poses, which absorb the
            rotation.
        face: (M, 3) heading of the face's horizontal direction in axes parallel to those of base, its sigma, and the
            roll of the face in its own plane, all in rad; NaN for general poses.
    """

    range_bearing: FloatArray
    covariance: FloatArray
    rest: FloatArray
    by_turn: FloatArray
    by_edge: FloatArray
    height_m: FloatArray
    height_variance: FloatArray
    chi2: FloatArray
    valid: BoolArray
    misfit: FloatArray
    misfit_by_turn: FloatArray
    face: FloatArray

    def where(self, mask: BoolArray) -> "TagMeasurements":
        """Return the measurements selected by a mask."""
        return TagMeasurements(*(getattr(self, f.name)[mask] for f in dataclass_fields(self)))

    def replace(self, mask: BoolArray, others: "TagMeasurements") -> "TagMeasurements":
        """Return the measurements with those selected by a mask replaced by `others`, one for each."""
        fields = []
        for mine, theirs in ((getattr(self, f.name), getattr(others, f.name)) for f in dataclass_fields(self)):
            merged = mine.copy()
            merged[mask] = theirs
            fields.append(merged)
        return TagMeasurements(*fields)


def upright_observations(
    corners_px: FloatArray, sides_m: FloatArray, camera: CameraModel, R_base_camera: FloatArray, sigmas_px: FloatArray
) -> TagMeasurements:
    """Measure tags with the upright model by Gauss-Newton iterations.

    Args:
        corners_px: (M, 4, 2) raw pixels.
        sides_m: (M,) side of each tag.
        camera: that detected them.
        R_base_camera: (3, 3) rotation of the camera's mount.
        sigmas_px: (M,) sigma of each corner coordinate of each tag.
    """
    with np.errstate(all="ignore"):
        parameters = _start(corners_px, sides_m, camera, R_base_camera)
        moving = np.arange(len(parameters))
        for _ in range(_ITERATIONS):
            residual, jacobian = _linearise(
                parameters[moving], corners_px[moving], sides_m[moving], camera, R_base_camera
            )
            normal = jacobian.swapaxes(-1, -2) @ jacobian
            gradient = jacobian.swapaxes(-1, -2) @ residual[..., None]
            step = _solve(normal, gradient)[..., 0]
            parameters[moving] -= step
            moving = moving[np.abs(step).max(axis=-1) > _STEP_TOLERANCE]  # also drops those without a solution, NaN
            if not len(moving):
                break
        residual, jacobian = _linearise(parameters, corners_px, sides_m, camera, R_base_camera)
        normal = jacobian.swapaxes(-1, -2) @ jacobian
        inverse = _solve(normal, np.broadcast_to(np.eye(_N_PARAMETERS), normal.shape))
        by_residual = -inverse @ jacobian.swapaxes(-1, -2)
        residual_by_turn = _residual_by_turn(parameters, sides_m, camera, R_base_camera)
        by_turn = by_residual @ residual_by_turn
        # Where sides are seen g pixels too far out, the corners belong further in, so the residuals grow outward.
        by_edge = by_residual[:, :3] @ outward(corners_px).reshape(-1, 8, 1)
        covariance = inverse[:, :3, :3] * sigmas_px[:, None, None] ** 2
        chi2 = (residual**2).sum(-1) / sigmas_px**2
        rest = np.zeros_like(covariance)
        measurements = _polar(parameters[:, :3], covariance, rest, by_turn[:, :3], by_edge[..., 0], chi2)
        refitted_by_turn = residual_by_turn + jacobian @ by_turn
        return replace(
            measurements,
            misfit=residual / sigmas_px[:, None],
            misfit_by_turn=refitted_by_turn / sigmas_px[:, None, None],
            face=_face(parameters, inverse * sigmas_px[:, None, None] ** 2),
        )


def range_bearing_by_turn(
    centre_m: FloatArray, face_rad: FloatArray, sides_m: FloatArray, camera: CameraModel, R_base_camera: FloatArray
) -> FloatArray:
    """Return `TagMeasurements.by_turn` (M, 2, 3) of tags at given poses, such as smoothed ones.

    Args:
        centre_m: (M, 3) from the camera, in axes parallel to base.
        face_rad: (M, 2) heading and roll of the face, as in `TagMeasurements.face`.
        sides_m: (M,) side of each tag.
        camera: that detected them.
        R_base_camera: (3, 3) rotation of the camera's mount.
    """
    heading, roll = face_rad.T
    parameters = np.column_stack([centre_m, np.cos(heading), np.sin(heading), roll])
    with np.errstate(all="ignore"):
        _, jacobian = _linearise(parameters, np.zeros((len(roll), 4, 2)), sides_m, camera, R_base_camera)
        transposed = jacobian.swapaxes(-1, -2)
        by_turn = -_solve(
            transposed @ jacobian, transposed @ _residual_by_turn(parameters, sides_m, camera, R_base_camera)
        )
        found: FloatArray = _to_polar(centre_m) @ by_turn[:, :3]
    return found


def _face(parameters: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return (M, 3) as `TagMeasurements.face` from parameters (M, 6) and their covariances (M, 6, 6)."""
    u = parameters[:, 3:5]
    by_u = np.stack([-u[:, 1], u[:, 0]], axis=-1) / (u**2).sum(axis=-1)[:, None]
    variance = np.einsum("mi,mij,mj->m", by_u, covariance[:, 3:5, 3:5], by_u)
    return np.column_stack([np.arctan2(u[:, 1], u[:, 0]), np.sqrt(variance), parameters[:, 5]])


def general_observations(
    corners_px: FloatArray, sides_m: FloatArray, camera: CameraModel, R_base_camera: FloatArray, sigmas_px: FloatArray
) -> TagMeasurements:
    """Measure tags at any tilt by the better of the two planar poses, with a range sigma that covers its bias.

    The arguments are those of `upright_observations`.
    """
    n = len(corners_px)
    centres = np.full((n, 3), np.nan)
    chi2 = np.full(n, np.nan)
    rays = camera.unproject(corners_px)
    for i in range(n):
        corners_m = np.column_stack([UNIT_CORNERS * sides_m[i], np.zeros(4)])
        pose = board_pose(corners_m, rays[i])
        if pose is not None:
            rotation, centre = pose
            centres[i] = R_base_camera @ centre
            residual_px = camera.project(corners_m @ rotation.T + centre) - corners_px[i]
            chi2[i] = float((residual_px**2).sum()) / sigmas_px[i] ** 2
    with np.errstate(all="ignore"):
        distance_m = np.linalg.norm(centres, axis=-1)
        direction = centres / distance_m[:, None]
        across = (_GENERAL_ACROSS * distance_m * sigmas_px / camera.fx_px) ** 2
        along = (_GENERAL_ALONG * distance_m) ** 2
        projector = direction[:, :, None] * direction[:, None, :]  # onto the line of sight
        rest = along[:, None, None] * projector
        covariance = rest + across[:, None, None] * (np.eye(3) - projector)
        sides_px = np.linalg.norm(np.roll(corners_px, -1, axis=1) - corners_px, axis=-1)
        by_edge = centres * 2.0 / sides_px.mean(axis=1)[:, None]
        return _polar(centres, covariance, rest, -_cross_matrix(centres), by_edge, chi2)


def _start(corners_px: FloatArray, sides_m: FloatArray, camera: CameraModel, R_base_camera: FloatArray) -> FloatArray:
    """Return (M, 6) starting values: the roll from the directions of the edges, the rest by linear least squares."""
    rays = camera.unproject(corners_px) @ R_base_camera.T  # (M, 4, 3) in axes parallel to base
    middle = rays.mean(axis=1)
    middle /= np.linalg.norm(middle, axis=-1, keepdims=True)
    right = np.stack([middle[:, 1], -middle[:, 0], np.zeros(len(middle))], axis=-1)
    right /= np.linalg.norm(right, axis=-1, keepdims=True)
    # The roll is the direction of the face's vertical axis in an upright picture. The heading of the face shortens the
    # horizontal component, which the iterations correct.
    up_edge = rays[:, 0] + rays[:, 1] - rays[:, 2] - rays[:, 3]
    right_edge = rays[:, 1] + rays[:, 2] - rays[:, 0] - rays[:, 3]
    rho = np.arctan2(
        right_edge[:, 2] - np.einsum("mi,mi->m", up_edge, right),
        up_edge[:, 2] + np.einsum("mi,mi->m", right_edge, right),
    )
    a, b = _on_face(rho, sides_m)
    # ray x (c + a u + b z) = 0 gives three equations for each corner, linear in (c, u).
    cross = _cross_matrix(rays)  # (M, 4, 3, 3)
    design = np.concatenate([cross, a[..., None, None] * cross[..., :2]], axis=-1).reshape(len(rays), 12, 5)
    target = -(b[..., None] * cross[..., 2]).reshape(len(rays), 12, 1)
    normal = design.swapaxes(-1, -2) @ design
    solution = _solve(normal, design.swapaxes(-1, -2) @ target)[..., 0]
    return np.concatenate([solution, rho[:, None]], axis=-1)


def _on_face(rho: FloatArray, sides_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the corners' horizontal and vertical coordinates, each (M, 4), on a face rolled by rho."""
    cos, sin = np.cos(rho)[:, None], np.sin(rho)[:, None]
    x, y = UNIT_CORNERS[:, 0] * sides_m[:, None], UNIT_CORNERS[:, 1] * sides_m[:, None]
    return cos * x - sin * y, sin * x + cos * y


def _linearise(
    parameters: FloatArray, corners_px: FloatArray, sides_m: FloatArray, camera: CameraModel, R_base_camera: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return residuals (M, 8), predicted minus detected, in pixels, and their Jacobian (M, 8, 6)."""
    m = len(parameters)
    a, b = _on_face(parameters[:, 5], sides_m)
    points = _corner_places(parameters, a, b)
    pixels, d_pixel_d_camera = camera.project_with_jacobian(points @ R_base_camera)
    d_pixel_d_point = d_pixel_d_camera @ R_base_camera.T
    d_point = np.zeros((m, 4, 3, _N_PARAMETERS))
    d_point[..., :3, :3] = np.eye(3)
    d_point[..., 0, 3] = a
    d_point[..., 1, 4] = a
    # d a / d rho = -b and d b / d rho = a
    d_point[..., :2, 5] = -b[..., None] * parameters[:, None, 3:5]
    d_point[..., 2, 5] = a
    return (pixels - corners_px).reshape(m, 8), (d_pixel_d_point @ d_point).reshape(m, 8, _N_PARAMETERS)


def _corner_places(parameters: FloatArray, a: FloatArray, b: FloatArray) -> FloatArray:
    """Return (M, 4, 3) the corners from the camera, in axes parallel to base."""
    points = np.repeat(parameters[:, None, :3], 4, axis=1)
    points[..., :2] += a[..., None] * parameters[:, None, 3:5]
    points[..., 2] += b
    return points


def _residual_by_turn(
    parameters: FloatArray, sides_m: FloatArray, camera: CameraModel, R_base_camera: FloatArray
) -> FloatArray:
    """Return the Jacobian (M, 8, 3) of the residuals for a small rotation w of the camera, P -> P - w x P."""
    points = _corner_places(parameters, *_on_face(parameters[:, 5], sides_m))
    _, d_pixel_d_camera = camera.project_with_jacobian(points @ R_base_camera)
    by_turn: FloatArray = (d_pixel_d_camera @ R_base_camera.T @ _cross_matrix(points)).reshape(len(parameters), 8, 3)
    return by_turn


def _polar(
    centre_m: FloatArray,
    covariance: FloatArray,
    rest: FloatArray,
    by_turn: FloatArray,
    by_edge: FloatArray,
    chi2: FloatArray,
) -> TagMeasurements:
    """Convert tag centres to ranges and bearings.

    Args:
        centre_m: (M, 3) from the camera, in axes parallel to base.
        covariance: (M, 3, 3) of the centres.
        rest: (M, 3, 3) the part of it that does not depend on the corners' sigma.
        by_turn: (M, 3, 3) derivative of the centres with respect to a rotation of the camera.
        by_edge: (M, 3) derivative of the centres with respect to the outward shift (px) of the tag's sides.
        chi2: (M,) squared whitened residuals.
    """
    x, y = centre_m[:, 0], centre_m[:, 1]
    range_m = np.hypot(x, y)
    jacobian = _to_polar(centre_m)
    polar_covariance, polar_rest = (jacobian @ each @ jacobian.swapaxes(-1, -2) for each in (covariance, rest))
    polar_by_edge = (jacobian @ by_edge[..., None])[..., 0]
    range_bearing = np.stack([range_m, np.arctan2(y, x)], axis=-1)
    valid = (
        np.isfinite(range_bearing).all(-1)
        & np.isfinite(polar_covariance).all((-1, -2))
        & (polar_covariance[:, 0, 0] > 0.0)
        & (polar_covariance[:, 1, 1] > 0.0)
        & np.isfinite(polar_by_edge).all(-1)
        & np.isfinite(chi2)
    )
    return TagMeasurements(
        range_bearing,
        polar_covariance,
        polar_rest,
        jacobian @ by_turn,
        polar_by_edge,
        centre_m[:, 2],
        covariance[:, 2, 2],
        chi2,
        valid,
        misfit=np.zeros((len(x), 8)),
        misfit_by_turn=np.zeros((len(x), 8, 3)),
        face=np.full((len(x), 3), np.nan),
    )


def _to_polar(centre_m: FloatArray) -> FloatArray:
    """Return (M, 2, 3) the derivative of horizontal range and bearing with respect to places (M, 3)."""
    x, y = centre_m[:, 0], centre_m[:, 1]
    range_m = np.hypot(x, y)
    jacobian = np.zeros((len(x), 2, 3))
    jacobian[:, 0, 0] = x / range_m
    jacobian[:, 0, 1] = y / range_m
    jacobian[:, 1, 0] = -y / range_m**2
    jacobian[:, 1, 1] = x / range_m**2
    return jacobian


def _cross_matrix(v: FloatArray) -> FloatArray:
    """Return the matrix (..., 3, 3) with v x w = cross_matrix(v) w."""
    zero = np.zeros_like(v[..., 0])
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    return np.stack([np.stack([zero, -z, y], -1), np.stack([z, zero, -x], -1), np.stack([-y, x, zero], -1)], axis=-2)


def _solve(matrices: FloatArray, right_hand_sides: FloatArray) -> FloatArray:
    """Solve a batch of linear systems; the solution is NaN where a matrix is singular or not finite."""
    n = matrices.shape[-1]
    good = np.asarray(np.isfinite(matrices).all((-1, -2)) & np.isfinite(right_hand_sides).all((-1, -2)))
    # Scale to a unit diagonal, because metres, directions and radians differ by powers of ten.
    diagonal = np.sqrt(np.abs(np.einsum("mii->mi", np.where(good[:, None, None], matrices, np.eye(n)))))
    scale = 1.0 / np.where(diagonal > 0.0, diagonal, 1.0)
    scaled = np.where(good[:, None, None], matrices, np.eye(n)) * scale[:, :, None] * scale[:, None, :]
    good &= np.linalg.det(scaled) > 1e-12
    scaled[~good] = np.eye(n)
    solution = scale[:, :, None] * np.linalg.solve(scaled, scale[:, :, None] * right_hand_sides)
    solution[~good] = np.nan
    return solution
