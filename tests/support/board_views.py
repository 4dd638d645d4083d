"""Views of the calibration board as a person would hold it, rendered, and corners where they are projected."""

from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from groundsbot.calib.board.board import DEFAULT_BOARD
from groundsbot.calib.camera.model import CameraModel
from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.fixtures.pictures.board_picture import BoardPainter, View, corners_of

CAMERA = CameraModel("front", 640, 480, 500.0, 500.0, 318.0, 242.0, "plumb_bob", (-0.1, 0.03, 0.0, 0.0, 0.0))
PLAIN = CameraModel("front", 640, 480, 500.0, 500.0, 319.5, 239.5, "plumb_bob", (0.0,) * 5)


def hold_board(
    at: tuple[float, float] = (0.5, 0.5), share: float = 0.4, right_deg: float = 0.0, lower_deg: float = 0.0
) -> View:
    """The board held.

    Args:
        at: its middle, as shares of the picture's width and height.
        share: of the picture's diagonal, for its own.
        right_deg: tilt, its right side nearer.
        lower_deg: tilt, its lower side nearer.
    """
    width_m, height_m = (side / 1000.0 for side in DEFAULT_BOARD.size_mm)
    depth_m = np.hypot(width_m, height_m) * CAMERA.fx_px / (share * np.hypot(CAMERA.width_px, CAMERA.height_px))
    off_px = (np.array(at) - 0.5) * (CAMERA.width_px, CAMERA.height_px)
    # The board's z axis points away from the camera; turning about y takes x away from it, about x takes y nearer.
    turn = Rotation.from_euler("xy", [-lower_deg, right_deg], degrees=True).as_matrix()
    T = np.eye(4)
    T[:3, :3] = turn
    middle = depth_m * np.array([*(off_px / CAMERA.fx_px), 1.0])
    T[:3, 3] = middle - turn @ np.array([width_m / 2, height_m / 2, 0.0])
    return View(T)


def good_views() -> list[View]:
    """No more than it takes: into each corner tilted both ways, far and near."""
    corners = [((x, y), x - 0.5, y - 0.5) for x in (0.17, 0.83) for y in (0.25, 0.75)]
    across = [hold_board(at, 0.42, right_deg=np.copysign(20.0, -right)) for at, right, _ in corners]
    down = [hold_board(at, 0.42, lower_deg=np.copysign(22.0, -lower)) for at, _, lower in corners]
    return [
        *across,
        *down,
        hold_board((0.4, 0.5), 0.3),
        hold_board((0.6, 0.5), 0.3),
        hold_board(share=0.62),
        hold_board(share=0.6, right_deg=25.0),
    ]


@cache
def render_views() -> tuple[NDArray[np.uint8], ...]:
    """Pictures of the good views."""
    painter, rng = BoardPainter(CAMERA, DEFAULT_BOARD), np.random.default_rng(1)
    return tuple(painter.picture(view, rng) for view in good_views())


def project(view: View) -> FloatArray:
    """`[N, 2]` all inner corners, seen by a lens without distortion."""
    return corners_of(view, PLAIN, DEFAULT_BOARD)
