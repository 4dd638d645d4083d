"""Where a camera stood before a plane of known points: poses from one view, to start a fit from."""

from typing import Final

import cv2
import numpy as np

from groundsbot.calib.foundation import FloatArray

_LEAST_COSINE: Final = 0.05  # of a ray against the board's direction


_LEAST_CORNERS: Final = 4  # that fix a pose


def board_pose(points_m: FloatArray, rays: FloatArray, rank: int = 0) -> tuple[FloatArray, FloatArray] | None:
    """R `[3, 3]` and t `[3]` of T_camera_board from corners on a plane; None where no pose explains them.

    A plane has two poses that explain it nearly as well as each other: `rank` 0 is the better one. Arguments
    as in `planar_poses`.
    """
    poses = planar_poses(points_m, rays)
    return poses[rank] if rank < len(poses) else None


def planar_poses(points_m: FloatArray, rays: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
    """The poses T_camera_board, R `[3, 3]` and t `[3]`, that explain corners on a plane, best first; two at most.

    They are looked for by a camera without distortion that looks towards the board: far off the axis of a fisheye
    a plane at z = 1 stretches all errors, and the board's own origin may lie behind the camera.

    Args:
        points_m: `[N, 3]` corners on the board, z = 0.
        rays: `[N, 3]` towards them; NaN where the lens has none.
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
    """The least turn `[3, 3]` that takes a ray in front of the camera onto its axis."""
    x, y, z = (ray / np.linalg.norm(ray)).tolist()
    share = 1.0 / (1.0 + z)
    return np.array([[1.0 - x * x * share, -x * y * share, -x], [-x * y * share, 1.0 - y * y * share, -y], [x, y, z]])
