"""Camera model with lens distortion: projection of points to pixels, and its inverse.

The camera frame is optical: x right, y down, z forward. Pixels are OpenCV's, with centres at whole numbers, so the
picture covers (-0.5, width - 0.5) x (-0.5, height - 0.5).
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from groundsbot.calib.camera.distortion import COEFFICIENTS, Distortion
from groundsbot.calib.errors import CalibError
from groundsbot.calib.foundation import FloatArray


@dataclass(frozen=True)
class CameraModel:
    """Intrinsics of one camera at one picture size.

    `distortion` contains the coefficients in the order of OpenCV and ROS: plumb_bob (k1, k2, p1, p2, k3),
    rational_polynomial (k1, k2, p1, p2, k3, k4, k5, k6), equidistant (k1, k2, k3, k4).

    Raises:
        CalibError: a size, focal length or coefficient is impossible.
    """

    name: str
    width_px: int
    height_px: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    distortion_model: str
    distortion: tuple[float, ...]

    def __post_init__(self) -> None:
        for field in ("width_px", "height_px", "fx_px", "fy_px"):
            value = getattr(self, field)
            if not (np.isfinite(value) and value > 0):
                raise CalibError(f"camera {self.name}: {field} is {value} but must be above 0; calibrate again")
        if not np.all(np.isfinite([self.cx_px, self.cy_px, *self.distortion])):
            raise CalibError(f"camera {self.name}: cx_px, cy_px and distortion must be finite numbers; calibrate again")
        if self.distortion_model not in COEFFICIENTS:
            raise CalibError(
                f"camera {self.name}: distortion_model is {self.distortion_model!r} but must be one of "
                f"{', '.join(COEFFICIENTS)}; calibrate with one of these"
            )
        expected = COEFFICIENTS[self.distortion_model]
        if len(self.distortion) != expected:
            raise CalibError(
                f"camera {self.name}: distortion has {len(self.distortion)} coefficients, but distortion_model "
                f"{self.distortion_model} needs {expected}; correct either, or calibrate again"
            )

    @property
    def matrix(self) -> FloatArray:
        """The camera matrix K `[3, 3]`."""
        return np.array([[self.fx_px, 0.0, self.cx_px], [0.0, self.fy_px, self.cy_px], [0.0, 0.0, 1.0]])

    @cached_property
    def _lens(self) -> Distortion:
        return Distortion.of(self.distortion_model, self.distortion)

    def project(self, points_camera_m: ArrayLike) -> FloatArray:
        """Return pixels `[..., 2]` of points `[..., 3]` in the camera frame.

        NaN for points behind the camera, or beyond the largest radius that the lens images. Pixels outside the picture
        are returned as they are.
        """
        return self.project_with_jacobian(points_camera_m)[0]

    def project_with_jacobian(self, points_camera_m: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return the pixels as `project` does, and their derivatives `[..., 2, 3]` by the points."""
        points = np.asarray(points_camera_m, dtype=np.float64)
        in_front = points[..., 2] > 0
        depth = np.where(in_front, points[..., 2], np.nan)[..., np.newaxis]
        with np.errstate(over="ignore", invalid="ignore"):  # tiny depths overflow; the distortion returns NaN there
            normalised = points[..., :2] / depth
            distorted, d_distorted = self._lens.apply(normalised)
            focal = np.array([self.fx_px, self.fy_px])
            pixels = focal * distorted + np.array([self.cx_px, self.cy_px])
            by_xy = focal[:, np.newaxis] * d_distorted / depth[..., np.newaxis]
            by_depth = -np.einsum("...ij,...j->...i", by_xy, normalised)
        return pixels, np.concatenate([by_xy, by_depth[..., np.newaxis]], axis=-1)

    def unproject(self, pixels: ArrayLike) -> FloatArray:
        """Return unit rays `[..., 3]` in the camera frame through pixels `[..., 2]`; NaN where there is none."""
        points = np.asarray(pixels, dtype=np.float64)
        distorted = (points - np.array([self.cx_px, self.cy_px])) / np.array([self.fx_px, self.fy_px])
        normalised = self._lens.remove(distorted)
        rays = np.concatenate([normalised, np.ones((*normalised.shape[:-1], 1))], axis=-1)
        unit: FloatArray = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
        return unit

    def resize(self, factor: float) -> "CameraModel":
        """Return the camera for pictures resized by `factor`. The edges of the picture are fixed, not pixel (0, 0).

        The new size is rounded to whole pixels, and each axis is scaled by the ratio of the rounded sizes.
        """
        width_px, height_px = max(1, round(self.width_px * factor)), max(1, round(self.height_px * factor))
        scale_x, scale_y = width_px / self.width_px, height_px / self.height_px
        return replace(
            self,
            width_px=width_px,
            height_px=height_px,
            fx_px=self.fx_px * scale_x,
            fy_px=self.fy_px * scale_y,
            cx_px=(self.cx_px + 0.5) * scale_x - 0.5,
            cy_px=(self.cy_px + 0.5) * scale_y - 0.5,
        )
