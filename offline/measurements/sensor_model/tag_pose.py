"""Corners in pixels -> where the tag is, seen from the camera: horizontal range and bearing.

Near a frontal view the tilt of a planar tag enters its apparent size in second order only, so the full six-parameter
pose (PnP) always explains noise as tilt and puts the tag up to half a sigma too near or too far, the same way
in every picture. Most tags hang upright, and then their vertical extent is a yardstick that no turn about the vertical
shortens. The model used here is

    P_i = c + a_i(rho) (u_x, u_y, 0) + b_i(rho) (0, 0, 1)

with the corners' places (a_i, b_i) on the face turned by the roll rho in its own plane. The horizontal direction u is
left free in length too: that makes the model smooth through the frontal view, hence its observations free of bias, for
the price of the horizontal edges' say about the range.

Two residuals of the eight are left to test it: a tag that does not hang upright (on a ceiling, say) shows there, and is
then read by the general pose with a range sigma wide enough to cover that pose's bias.
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
_ARRIVED: Final = 1e-9  # m and rad: of a last step; the next one would be far smaller still
_N_PARAMETERS: Final = 6  # c (3), u (2), rho
# Sigmas of a general pose that its bias stays well below, down to 15 px of side: along the line of sight as a share of
# the range, across it in sigmas of one corner.
_GENERAL_ALONG: Final = 0.10
_GENERAL_ACROSS: Final = 1.5


@dataclass(frozen=True)
class TagMeasurements:
    """M observations as horizontal range and bearing about the camera's place, in axes parallel to those of base.

    Attributes:
        range_bearing: (M, 2) m and rad; bearing positive to the left of base's forward axis.
        covariance: (M, 2, 2) for the given corner sigma; rest: (M, 2, 2) the part of it that does not come from that.
        by_turn: (M, 2, 3) derivative of range_bearing, for the corners as they are, by a small turn (rad) of the camera
            about the axes of base.
        by_edge: (M, 2) derivative of range_bearing as it should be, for the corners as they are, by how many pixels too
            far out the tag's sides are seen.
        height_m: (M,) of the tag's centre above the camera; height_variance: (M,) m^2.
        chi2: (M,) squared whitened residuals; two degrees of freedom where the model holds.
        valid: (M,) False where no pose in front of the camera explains the corners.
        misfit: (M, 8) whitened residuals of the upright model; misfit_by_turn: (M, 8, 3) derivative of them by a small
            turn of the camera as in `by_turn`, the model fitted anew; zero for general poses, which turn along.
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

    def where(self, mask: BoolArray) -> "TagMeasurements":
        """Those of the mask."""
        return TagMeasurements(*(getattr(self, f.name)[mask] for f in dataclass_fields(self)))

    def replace(self, mask: BoolArray, others: "TagMeasurements") -> "TagMeasurements":
        """These, with those of the mask replaced by others (as many as the mask has)."""
        fields = []
        for mine, theirs in ((getattr(self, f.name), getattr(others, f.name)) for f in dataclass_fields(self)):
            merged = mine.copy()
            merged[mask] = theirs
            fields.append(merged)
        return TagMeasurements(*fields)


def upright_observations(
    corners_px: FloatArray, sides_m: FloatArray, camera: CameraModel, R_base_camera: FloatArray, sigmas_px: FloatArray
) -> TagMeasurements:
    """Observations of tags that hang upright.

    Args:
        corners_px: (M, 4, 2) raw pixels.
        sides_m: (M,) side of each tag.
        camera: the camera that saw them.
        R_base_camera: (3, 3) how the camera is mounted.
        sigmas_px: (M,) noise of each corner coordinate of each tag.
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
            moving = moving[np.abs(step).max(axis=-1) > _ARRIVED]  # those without a solution stay as they are: NaN
            if not len(moving):
                break
        residual, jacobian = _linearise(parameters, corners_px, sides_m, camera, R_base_camera)
        normal = jacobian.swapaxes(-1, -2) @ jacobian
        inverse = _solve(normal, np.broadcast_to(np.eye(_N_PARAMETERS), normal.shape))
        by_residual = -inverse @ jacobian.swapaxes(-1, -2)
        held_by_turn = _residual_by_turn(parameters, sides_m, camera, R_base_camera)
        by_turn = by_residual @ held_by_turn
        # Sides seen g too far out: the corners should lie g times that further in, hence the residuals further out.
        by_edge = by_residual[:, :3] @ outward(corners_px).reshape(-1, 8, 1)
        covariance = inverse[:, :3, :3] * sigmas_px[:, None, None] ** 2
        chi2 = (residual**2).sum(-1) / sigmas_px**2
        nothing = np.zeros_like(covariance)
        found = _polar(parameters[:, :3], covariance, nothing, by_turn[:, :3], by_edge[..., 0], chi2)
        left = held_by_turn + jacobian @ by_turn
        return replace(found, misfit=residual / sigmas_px[:, None], misfit_by_turn=left / sigmas_px[:, None, None])


def general_observations(
    corners_px: FloatArray, sides_m: FloatArray, camera: CameraModel, R_base_camera: FloatArray, sigmas_px: FloatArray
) -> TagMeasurements:
    """Observations of tags at any tilt: the better of the two planar poses, with a range sigma that covers its bias.

    Arguments as in `upright_observations`.
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
            missed_px = camera.project(corners_m @ rotation.T + centre) - corners_px[i]
            chi2[i] = float((missed_px**2).sum()) / sigmas_px[i] ** 2
    with np.errstate(all="ignore"):
        distance_m = np.linalg.norm(centres, axis=-1)
        direction = centres / distance_m[:, None]
        across = (_GENERAL_ACROSS * distance_m * sigmas_px / camera.fx_px) ** 2
        along = (_GENERAL_ALONG * distance_m) ** 2
        sight = direction[:, :, None] * direction[:, None, :]
        rest = along[:, None, None] * sight
        covariance = rest + across[:, None, None] * (np.eye(3) - sight)
        sides_px = np.linalg.norm(np.roll(corners_px, -1, axis=1) - corners_px, axis=-1)
        by_edge = centres * 2.0 / sides_px.mean(axis=1)[:, None]
        return _polar(centres, covariance, rest, -_cross_matrix(centres), by_edge, chi2)


def _start(corners_px: FloatArray, sides_m: FloatArray, camera: CameraModel, R_base_camera: FloatArray) -> FloatArray:
    """(M, 6) starting values: with the roll taken from the left edge's direction, the model is linear in the rest."""
    rays = camera.unproject(corners_px) @ R_base_camera.T  # (M, 4, 3) in axes parallel to base
    middle = rays.mean(axis=1)
    middle /= np.linalg.norm(middle, axis=-1, keepdims=True)
    right = np.stack([middle[:, 1], -middle[:, 0], np.zeros(len(middle))], axis=-1)
    right /= np.linalg.norm(right, axis=-1, keepdims=True)
    # Roll: direction of the face's vertical axis in a picture held upright. A turn of the face about the vertical
    # shortens the sideways part, which the iterations then put right.
    up_edge = rays[:, 0] + rays[:, 1] - rays[:, 2] - rays[:, 3]
    right_edge = rays[:, 1] + rays[:, 2] - rays[:, 0] - rays[:, 3]
    rho = np.arctan2(
        right_edge[:, 2] - np.einsum("mi,mi->m", up_edge, right),
        up_edge[:, 2] + np.einsum("mi,mi->m", right_edge, right),
    )
    a, b = _on_face(rho, sides_m)
    # ray x (c + a u + b z) = 0: three equations a corner, linear in (c, u).
    cross = _cross_matrix(rays)  # (M, 4, 3, 3)
    design = np.concatenate([cross, a[..., None, None] * cross[..., :2]], axis=-1).reshape(len(rays), 12, 5)
    target = -(b[..., None] * cross[..., 2]).reshape(len(rays), 12, 1)
    normal = design.swapaxes(-1, -2) @ design
    solution = _solve(normal, design.swapaxes(-1, -2) @ target)[..., 0]
    return np.concatenate([solution, rho[:, None]], axis=-1)


def _on_face(rho: FloatArray, sides_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Places (M, 4) of the corners along the horizontal and the vertical of a face rolled by rho."""
    cos, sin = np.cos(rho)[:, None], np.sin(rho)[:, None]
    x, y = UNIT_CORNERS[:, 0] * sides_m[:, None], UNIT_CORNERS[:, 1] * sides_m[:, None]
    return cos * x - sin * y, sin * x + cos * y


def _linearise(
    parameters: FloatArray, corners_px: FloatArray, sides_m: FloatArray, camera: CameraModel, R_base_camera: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Residuals (M, 8), predicted minus seen, in pixels, and their Jacobian (M, 8, 6)."""
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
    """(M, 4, 3) in axes parallel to base, about the camera."""
    points = np.repeat(parameters[:, None, :3], 4, axis=1)
    points[..., :2] += a[..., None] * parameters[:, None, 3:5]
    points[..., 2] += b
    return points


def _residual_by_turn(
    parameters: FloatArray, sides_m: FloatArray, camera: CameraModel, R_base_camera: FloatArray
) -> FloatArray:
    """(M, 8, 3) derivative of the residuals by a small turn w of the camera: it sees P where it saw P - w x P."""
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
    """Centres (M, 3) in axes parallel to base, about the camera, as observations.

    Args:
        centre_m: the centres.
        covariance: (M, 3, 3) theirs.
        rest: (M, 3, 3) the part of it that does not come from the corners' sigma.
        by_turn: (M, 3, 3) derivative of the centres by a turn of the camera.
        by_edge: (M, 3) of them by how many pixels too far out the sides are seen.
        chi2: (M,).
    """
    x, y = centre_m[:, 0], centre_m[:, 1]
    range_m = np.hypot(x, y)
    jacobian = np.zeros((len(x), 2, 3))
    jacobian[:, 0, 0] = x / range_m
    jacobian[:, 0, 1] = y / range_m
    jacobian[:, 1, 0] = -y / range_m**2
    jacobian[:, 1, 1] = x / range_m**2
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
    )


def _cross_matrix(v: FloatArray) -> FloatArray:
    """Matrix (..., 3, 3) with which v x w = cross_matrix(v) w."""
    zero = np.zeros_like(v[..., 0])
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    return np.stack([np.stack([zero, -z, y], -1), np.stack([z, zero, -x], -1), np.stack([-y, x, zero], -1)], axis=-2)


def _solve(matrices: FloatArray, right_hand_sides: FloatArray) -> FloatArray:
    """Solves a batch; NaN where a matrix is singular or not finite, and nobody else suffers for it."""
    n = matrices.shape[-1]
    good = np.asarray(np.isfinite(matrices).all((-1, -2)) & np.isfinite(right_hand_sides).all((-1, -2)))
    # Scaled to a unit diagonal: metres, directions and radians differ by powers of ten.
    diagonal = np.sqrt(np.abs(np.einsum("mii->mi", np.where(good[:, None, None], matrices, np.eye(n)))))
    scale = 1.0 / np.where(diagonal > 0.0, diagonal, 1.0)
    scaled = np.where(good[:, None, None], matrices, np.eye(n)) * scale[:, :, None] * scale[:, None, :]
    good &= np.linalg.det(scaled) > 1e-12
    scaled[~good] = np.eye(n)
    solution = scale[:, :, None] * np.linalg.solve(scaled, scale[:, :, None] * right_hand_sides)
    solution[~good] = np.nan
    return solution
