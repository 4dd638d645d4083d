"""Corrects the corners of rolling-shutter pictures to those of a global shutter."""

import numpy as np

from groundsbot.calib.camera import CameraModel
from groundsbot.calib.foundation import FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.calib.robot import Robot


def read_at_once(
    robot: Robot, camera: CameraModel, corners_px: FloatArray, sides_m: FloatArray, twist: FloatArray
) -> FloatArray:
    """Return corners (M, 4, 2) as if all rows were read at the time of the middle row, which is the stamp.

    Each corner is moved by the motion of base between the stamp and the readout of its row. The distance of a tag is
    approximated from its longer diagonal, because the largest shift, by rotation, does not depend on the distance.

    Args:
        robot: robot with readout_s and mount.
        camera: its camera.
        corners_px: (M, 4, 2) raw pixels.
        sides_m: (M,) of the tags.
        twist: (M, 3) velocity of base (m/s forward, m/s to the left, rad/s).
    """
    if robot.readout_s == 0.0:
        return corners_px
    delay_s = robot.readout_s * np.clip(corners_px[..., 1] / (camera.height_px - 1) - 0.5, -0.5, 0.5)
    tangent = delay_s[..., None] * twist[:, None, :]
    R_base_camera, t_base_camera_m = (
        robot.mount.T_base_camera.rotation.as_matrix(),
        robot.mount.T_base_camera.translation,
    )
    with np.errstate(all="ignore"):
        rays = camera.unproject(corners_px)
        diagonal = np.linalg.norm(rays[:, :2] - rays[:, 2:], axis=-1).max(axis=-1)
        in_camera = rays * (np.sqrt(2.0) * sides_m / diagonal)[:, None, None]
        in_base = in_camera @ R_base_camera.T + t_base_camera_m
        in_base[..., :2] = se2.apply(se2.exp(tangent), in_base[..., :2])
        moved_px = camera.project((in_base - t_base_camera_m) @ R_base_camera)
        at_once_px: FloatArray = corners_px + moved_px - camera.project(in_camera)
    return at_once_px
