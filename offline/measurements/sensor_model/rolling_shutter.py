"""Corners of pictures that are read row by row, as a picture that is taken at once would have them."""

import numpy as np

from groundsbot.calib.camera import CameraModel
from groundsbot.calib.foundation import FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.calib.robot import Robot


def read_at_once(
    robot: Robot, camera: CameraModel, corners_px: FloatArray, sides_m: FloatArray, twist: FloatArray
) -> FloatArray:
    """Corners (M, 4, 2) where they would be seen if all rows were read with the middle one, which has the stamp.

    Until a corner's row was read base had moved by its twist, and with it all that it sees. How far away a tag is
    follows from the longer of its diagonals. That is near enough: turning, which shifts most, shifts all alike.

    Args:
        robot: its readout_s and mount.
        camera: the camera that saw them.
        corners_px: (M, 4, 2) raw pixels.
        sides_m: (M,) of the tags.
        twist: (M, 3) velocity of base (m/s forward, m/s to the left, rad/s).
    """
    if robot.readout_s == 0.0:
        return corners_px
    late_s = robot.readout_s * np.clip(corners_px[..., 1] / (camera.height_px - 1) - 0.5, -0.5, 0.5)
    moved = late_s[..., None] * twist[:, None, :]
    turn, place_m = robot.mount.T_base_camera.rotation.as_matrix(), robot.mount.T_base_camera.translation
    with np.errstate(all="ignore"):
        rays = camera.unproject(corners_px)
        across = np.linalg.norm(rays[:, :2] - rays[:, 2:], axis=-1).max(axis=-1)
        in_camera = rays * (np.sqrt(2.0) * sides_m / across)[:, None, None]
        in_base = in_camera @ turn.T + place_m
        in_base[..., :2] = se2.apply(se2.exp(moved), in_base[..., :2])
        seen_px = camera.project((in_base - place_m) @ turn)
        at_once_px: FloatArray = corners_px + seen_px - camera.project(in_camera)
    return at_once_px
