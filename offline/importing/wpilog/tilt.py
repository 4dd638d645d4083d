"""How a camera is tilted, from upright tags: the roll and pitch under which their corners fit best.

The tags are rigid and not turned in their own plane. The upright model of `measurements`, which leaves both open to be
smooth through the frontal view, determines a tilt only with many views.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from groundsbot.calib.camera import CameraModel, board_pose
from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray
from groundsbot.calib.robot import R_LEVEL_OPTICAL
from groundsbot.offline.measurements import UNIT_CORNERS

_MOST_TAGS: Final = 60
_CORNER_SIGMA_PX: Final = 0.3
_STEP: Final = 1e-7  # m and rad
_MOST_STEPS: Final = 50
_UNSEEN_PX: Final = 100.0  # residual of a corner behind the camera
_BY_TAG: Final = 4  # parameters: place (3) and heading of its face
# Tags are not mounted more upright than that.
_UPRIGHT_SIGMA_RAD: Final = float(np.radians(2.0))
_TELLING_SIGMA_RAD: Final = float(np.radians(6.0))  # beyond it a tilt would hardly be narrower than one left open
# Pictures in which a tag stands within this many pixels are one view: they share its errors.
_ONE_VIEW_PX: Final = 30.0


@dataclass(frozen=True)
class Tilt:
    """Roll and pitch of a camera, in the sense of robot.yaml, and the sigma of each."""

    roll_rad: float
    pitch_rad: float
    roll_rad_sigma: float
    pitch_rad_sigma: float


def tilt_by_tags(tag_ids: IntArray, corners_px: FloatArray, side_m: float, camera: CameraModel) -> Tilt | None:
    """Return the tilt estimated from tags that are assumed upright; None if their views do not determine it.

    Args:
        tag_ids: (M,).
        corners_px: (M, 4, 2) in the order of groundsbot.proto.
        side_m: side length of all tags.
        camera: that saw them.
    """
    if not len(corners_px):
        return None
    some = np.unique(np.linspace(0, len(corners_px) - 1, _MOST_TAGS).astype(np.int64))
    start, seen = _start(corners_px[some], side_m, camera)
    if not seen.any():
        return None
    tag_ids, corners_px = tag_ids[some][seen], corners_px[some][seen]

    def misfit(parameters: FloatArray) -> FloatArray:
        missed = camera.project(_corners(parameters, side_m)) - corners_px
        return np.nan_to_num(np.clip(missed, -_UNSEEN_PX, _UNSEEN_PX), nan=_UNSEEN_PX).ravel() / _CORNER_SIGMA_PX

    def slopes(parameters: FloatArray) -> FloatArray:
        return _jacobian(misfit, parameters)

    found = least_squares(misfit, start, jac=slopes, loss="soft_l1", x_scale="jac", ftol=1e-6, max_nfev=_MOST_STEPS)
    jacobian = slopes(found.x)
    normal = jacobian.T @ jacobian
    if np.linalg.matrix_rank(normal) < len(normal):
        return None
    shared = len(corners_px) / _n_views(tag_ids, corners_px)
    sigmas = np.sqrt(np.diag(np.linalg.inv(normal))[:2] * shared)
    roll_rad, pitch_rad = found.x[:2].tolist()
    if sigmas.max() > _TELLING_SIGMA_RAD or max(abs(roll_rad), abs(pitch_rad)) > np.pi / 2:
        return None
    roll_sigma, pitch_sigma = np.hypot(sigmas, _UPRIGHT_SIGMA_RAD).tolist()
    return Tilt(roll_rad, pitch_rad, roll_sigma, pitch_sigma)


def _start(corners_px: FloatArray, side_m: float, camera: CameraModel) -> tuple[FloatArray, BoolArray]:
    """Return parameters (2 + 4 K) by the tags' general poses, and which of the M tags have one (M,)."""
    flat = np.column_stack([UNIT_CORNERS * side_m, np.zeros(4)])
    poses = [board_pose(flat, rays) for rays in camera.unproject(corners_px)]
    seen = np.array([pose is not None for pose in poses])
    turns = np.array([pose[0] for pose in poses if pose is not None]).reshape(-1, 3, 3)
    places = np.array([pose[1] for pose in poses if pose is not None]).reshape(-1, 3)
    if not len(turns):
        return np.zeros(2), seen
    right, down, forward = np.median(turns[:, :, 1], axis=0).tolist()  # the tags' top, in the camera's frame
    pitch = -np.arcsin(np.clip(forward, -1.0, 1.0))
    roll = np.arctan2(-right, -down)
    level = _level(roll, pitch)
    out = np.einsum("ij,mj->mi", level, turns[:, :, 2])
    by_tag = np.column_stack([places @ level.T, np.arctan2(out[:, 1], out[:, 0])])
    return np.concatenate([[roll, pitch], by_tag.ravel()]), seen


def _level(roll_rad: float, pitch_rad: float) -> FloatArray:
    """Return R_level_camera: into axes parallel to the floor, x ahead."""
    turned: FloatArray = (Rotation.from_euler("YX", [pitch_rad, roll_rad]) * R_LEVEL_OPTICAL).as_matrix()
    return turned


def _corners(parameters: FloatArray, side_m: float) -> FloatArray:
    """Return the corners (M, 4, 3) in the camera's frame."""
    places, heading = np.split(parameters[2:].reshape(-1, _BY_TAG), [3], axis=1)
    right = np.concatenate([-np.sin(heading), np.cos(heading), np.zeros_like(heading)], axis=1)
    up = np.array([0.0, 0.0, 1.0])
    corners = places[:, None] + side_m * (UNIT_CORNERS[:, :1] * right[:, None] + UNIT_CORNERS[:, 1:] * up)
    seen: FloatArray = corners @ _level(float(parameters[0]), float(parameters[1]))
    return seen


def _jacobian(misfit: Callable[[FloatArray], FloatArray], parameters: FloatArray) -> FloatArray:
    """Return (8 M, 2 + 4 M) by differences: those of all tags at once, as each tag's corners depend on its own only."""
    n_tags, at = (len(parameters) - 2) // _BY_TAG, misfit(parameters)
    jacobian = np.zeros((n_tags, 8, len(parameters)))
    for k in range(2):
        step = np.zeros_like(parameters)
        step[k] = _STEP
        jacobian[:, :, k] = ((misfit(parameters + step) - at) / _STEP).reshape(n_tags, 8)
    tags = np.arange(n_tags)
    for k in range(_BY_TAG):
        step = np.zeros_like(parameters)
        step[2 + k :: _BY_TAG] = _STEP
        jacobian[tags, :, 2 + _BY_TAG * tags + k] = ((misfit(parameters + step) - at) / _STEP).reshape(n_tags, 8)
    return jacobian.reshape(8 * n_tags, len(parameters))


def _n_views(tag_ids: IntArray, corners_px: FloatArray) -> int:
    centres = np.round(corners_px.mean(axis=1) / _ONE_VIEW_PX)
    return len(np.unique(np.column_stack([tag_ids, centres]), axis=0))
