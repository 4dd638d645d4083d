"""Pose of a planar target from one view, as the initial value of a fit."""

from typing import Final

import cv2
import numpy as np

from groundsbot.calib.foundation import FloatArray

_LEAST_COSINE: Final = 0.05  # between a ray and the mean direction of the rays
_LEAST_CORNERS: Final = 4  # that determine a pose


def board_pose(points_m: FloatArray, rays: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    """Return R `[3, 3]` and t `[3]` of T_camera_board from corners on a plane, or None if no pose explains them.

    A plane has two poses that explain its corners nearly equally well; this is the better one. The arguments are those
    of `planar_poses`.
    """
    return next(iter(planar_poses(points_m, rays)), None)


def planar_poses(points_m: FloatArray, rays: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
    """Return the poses T_camera_board that explain corners on a plane, best first, at most two.

    They are estimated with a virtual camera without distortion that looks towards the board. In a fisheye camera's own
    frame, projection onto z = 1 would amplify errors far from the axis, and the origin of the board may lie behind the
    camera. The method is IPPE (Collins and Bartoli, 2014) as in OpenCV's solvePnPGeneric.

    Args:
        points_m: `[N, 3]` corners on the board, z = 0.
        rays: `[N, 3]` rays towards them in the camera frame; NaN where the lens has none.

    Returns:
        Pairs of R `[3, 3]` and t `[3]`.
    """
    good = np.isfinite(rays).all(axis=1)
    if good.sum() < _LEAST_CORNERS:
        return []
    turn = _rotation_onto_axis(rays[good].mean(axis=0))
    turned = rays[good] @ turn.T
    if turned[:, 2].min() < _LEAST_COSINE:
        return []
    try:
        found, turns, places, errors = cv2.solvePnPGeneric(
            points_m[good], turned[:, :2] / turned[:, 2:], np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
        )
    except cv2.error:
        return []
    if not found:
        return []
    poses = []
    for i in np.argsort([float(np.asarray(error).ravel()[0]) for error in errors], kind="stable").tolist():
        place = np.asarray(places[i], dtype=np.float64).ravel()
        if np.isfinite(place).all():
            poses.append((turn.T @ cv2.Rodrigues(turns[i])[0], turn.T @ place))
    return poses


def _rotation_onto_axis(ray: FloatArray) -> FloatArray:
    """Return the smallest rotation `[3, 3]` that maps a ray in front of the camera to the optical axis."""
    x, y, z = (ray / np.linalg.norm(ray)).tolist()
    share = 1.0 / (1.0 + z)
    return np.array([[1.0 - x * x * share, -x * y * share, -x], [-x * y * share, 1.0 - y * y * share, -y], [x, y, z]])
