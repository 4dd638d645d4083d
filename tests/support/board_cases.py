"""Cameras that take pictures of the default board, and their views: found in pictures, or corners alone."""

from collections.abc import Sequence
from functools import cache
from typing import Final

import numpy as np

from groundsbot.calib.board.board import DEFAULT_BOARD
from groundsbot.calib.board.finder import BoardFinder, BoardView
from groundsbot.calib.camera.model import CameraModel
from groundsbot.calib.intrinsics.bundle import BoardObservations
from groundsbot.fixtures.pictures.board_picture import BoardPainter, Glare, corners_of, drawn_views
from groundsbot.fixtures.pictures.board_picture import View as Taken

NARROW: Final = CameraModel(
    "narrow", 640, 480, 800.0, 801.0, 318.0, 243.0, "plumb_bob", (-0.1, 0.05, 0.0005, -0.0003, 0.0)
)
WIDE: Final = CameraModel(  # 90 degrees from left to right
    "wide", 640, 480, 394.0, 395.0, 318.0, 243.0, "plumb_bob", (-0.25, 0.07, 0.0005, -0.0003, -0.008)
)
RATIONAL: Final = CameraModel(
    "rational", 640, 480, 320.0, 319.5, 321.0, 238.0, "rational_polynomial",
    (0.513, -2.741, 0.00064, -0.00022, 1.574, 0.393, -2.560, 1.499),
)  # fmt: skip
FISHEYE: Final = CameraModel(  # image of a half-sphere's rim just outside of the picture's sides
    "fisheye", 640, 480, 220.0, 220.5, 322.0, 237.0, "equidistant", (0.02, -0.005, 0.001, 0.0)
)
CORNER_SIGMA_PX: Final = 0.05
CASES: Final = {camera.name: camera for camera in (NARROW, WIDE, RATIONAL, FISHEYE)}


def make_corners(
    camera: CameraModel, seed: int, count: int = 15, sigma_px: float = CORNER_SIGMA_PX, bend_px: float = 0.0
) -> tuple[BoardObservations, list[Taken]]:
    """Return exact corners with noise, without pictures, and the views.

    Args:
        camera: camera of the views.
        seed: of views and noise.
        count: number of views.
        sigma_px: sigma of the coordinates, independent.
        bend_px: sigma of the coefficients of an error that is quadratic over the board, another one in each view.
    """
    rng = np.random.default_rng(seed)
    views, corners_m = drawn_views(camera, DEFAULT_BOARD, count, rng), BoardFinder(DEFAULT_BOARD).corners_m
    x, y = (corners_m[:, :2] / (0.5 * corners_m[:, :2].max(axis=0)) - 1.0).T
    number, points, pixels = [], [], []
    for index, view in enumerate(views):
        own = corners_of(view, camera, DEFAULT_BOARD)
        seen = ((own > 0) & (own < [camera.width_px - 1, camera.height_px - 1])).all(axis=1)
        number.append(np.full(seen.sum(), index))
        points.append(corners_m[seen])
        pixels.append(own[seen] + sigma_px * rng.standard_normal((seen.sum(), 2)))
        if bend_px:
            pixels[-1] += np.stack([x**2, x * y, y**2], axis=1)[seen] @ rng.normal(0.0, bend_px, (3, 2))
    return BoardObservations(
        np.concatenate(number).astype(np.int64), np.concatenate(points), np.concatenate(pixels)
    ), views


def spoilt(view: Taken, camera: CameraModel, rng: np.random.Generator) -> Taken:
    """The same view moved too fast, out of focus, or under a lamp."""
    what = rng.integers(3)
    if what == 0:
        distance_m = float(np.linalg.norm(view.T_camera_board[:3, 3]))
        angle, length_m = rng.uniform(-np.pi, np.pi), rng.uniform(4.0, 10.0) * distance_m / camera.fx_px
        return Taken(view.T_camera_board, length_m * np.array([np.cos(angle), np.sin(angle), 0, 0, 0, 0]))
    if what == 1:
        return Taken(view.T_camera_board, view.motion, defocus_px=rng.uniform(1.5, 3.0))
    centre = camera.project(view.T_camera_board[:3] @ np.array([0.0875, 0.1125, 0.0, 1.0]))
    return Taken(view.T_camera_board, view.motion, glare=Glare(tuple(centre.tolist()), rng.uniform(20.0, 60.0)))


def taken_views(camera: CameraModel, seed: int, count: int = 30, spoilt_share: float = 0.0) -> list[BoardView]:
    """Pictures of the default board as `drawn_views` has them, some spoilt, and the board found in them."""
    drawn, worse = _draw(camera, seed, count, spoilt_share)
    return _observe([_find(camera, worse.get(index, view), seed, index) for index, view in enumerate(drawn)])


def take_with_and_without(
    camera: CameraModel, seed: int, count: int = 30, spoilt_share: float = 0.1
) -> tuple[list[BoardView], list[BoardView]]:
    """The views of a seed with none spoilt, and with some; those that are in both are taken once."""
    drawn, worse = _draw(camera, seed, count, spoilt_share)
    good = [_find(camera, view, seed, index) for index, view in enumerate(drawn)]
    mixed = [_find(camera, worse[index], seed, index) if index in worse else view for index, view in enumerate(good)]
    return _observe(good), _observe(mixed)


def _draw(camera: CameraModel, seed: int, count: int, spoilt_share: float) -> tuple[list[Taken], dict[int, Taken]]:
    """How pictures are taken, and by their numbers how those that are spoilt are taken instead."""
    rng = np.random.default_rng(seed)
    drawn = drawn_views(camera, DEFAULT_BOARD, count, rng)
    chosen = rng.choice(count, round(spoilt_share * count), replace=False)
    return drawn, {int(index): spoilt(drawn[index], camera, rng) for index in chosen}


@cache
def painter_of(camera: CameraModel, flipped: bool = False) -> BoardPainter:
    """The painter of the default board; the rays of a camera's pixels take half a second."""
    return BoardPainter(camera, DEFAULT_BOARD, flipped=flipped)


def _find(camera: CameraModel, view: Taken, seed: int, index: int) -> BoardView | None:
    picture = painter_of(camera).picture(view, np.random.default_rng([seed, index]))
    return BoardFinder(DEFAULT_BOARD).find(picture, f"picture {index}")


def _observe(views: Sequence[BoardView | None]) -> list[BoardView]:
    return [view for view in views if view is not None]
