"""A pinhole camera with lens distortion: points to pixels and back, and ROS camera_info files.

Frame: optical, x right, y down, z forward. Pixels: OpenCV's, centres at whole numbers, so the picture covers
(-0.5, width - 0.5) x (-0.5, height - 0.5).
"""

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated

import numpy as np
import yaml
from numpy.typing import ArrayLike
from pydantic import BaseModel, ConfigDict, Field

from calib.arrays import FloatArray
from calib.distortion import COEFFICIENTS, Distortion
from calib.errors import CalibError
from calib.files import written_whole
from calib.yaml_file import parse_mapping, read_text, validated


@dataclass(frozen=True)
class CameraModel:
    """Intrinsics of one camera at one picture size.

    `distortion` holds the coefficients in OpenCV's and ROS's order: plumb_bob (k1, k2, p1, p2, k3),
    rational_polynomial (k1, k2, p1, p2, k3, k4, k5, k6), equidistant (k1, k2, k3, k4).

    Raises:
        CalibError: a size, focal length or coefficient that no camera can have.
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
                f"camera {self.name}: distortion has {len(self.distortion)} coefficients but "
                f"{self.distortion_model} takes {expected}; add or remove some"
            )

    @property
    def matrix(self) -> FloatArray:
        """The camera matrix K `[3, 3]`."""
        return np.array([[self.fx_px, 0.0, self.cx_px], [0.0, self.fy_px, self.cy_px], [0.0, 0.0, 1.0]])

    @cached_property
    def _lens(self) -> Distortion:
        return Distortion.of(self.distortion_model, self.distortion)

    def project(self, points_camera_m: ArrayLike) -> FloatArray:
        """Pixels `[..., 2]` of points `[..., 3]` in the camera frame.

        NaN for points behind the camera or so far off its axis that the lens has no image of them. A pixel outside
        the picture is returned as it is.
        """
        return self.project_with_jacobian(points_camera_m)[0]

    def project_with_jacobian(self, points_camera_m: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """As `project`, with the derivatives `[..., 2, 3]` of the pixels by the points."""
        points = np.asarray(points_camera_m, dtype=np.float64)
        in_front = points[..., 2] > 0
        depth = np.where(in_front, points[..., 2], np.nan)[..., np.newaxis]
        with np.errstate(over="ignore", invalid="ignore"):  # a depth of almost nothing; refused by the lens
            normalised = points[..., :2] / depth
            distorted, d_distorted = self._lens.apply(normalised)
            focal = np.array([self.fx_px, self.fy_px])
            pixels = focal * distorted + np.array([self.cx_px, self.cy_px])
            by_xy = focal[:, np.newaxis] * d_distorted / depth[..., np.newaxis]
            by_depth = -np.einsum("...ij,...j->...i", by_xy, normalised)
        return pixels, np.concatenate([by_xy, by_depth[..., np.newaxis]], axis=-1)

    def unproject(self, pixels: ArrayLike) -> FloatArray:
        """Unit rays `[..., 3]` in the camera frame through pixels `[..., 2]`; NaN where the lens has no ray."""
        points = np.asarray(pixels, dtype=np.float64)
        distorted = (points - np.array([self.cx_px, self.cy_px])) / np.array([self.fx_px, self.fy_px])
        normalised = self._lens.remove(distorted)
        rays = np.concatenate([normalised, np.ones((*normalised.shape[:-1], 1))], axis=-1)
        unit: FloatArray = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
        return unit

    def scaled(self, factor: float) -> "CameraModel":
        """The same camera where its pictures are resized by `factor`: the picture's edges stay, not pixel (0, 0).

        A size that does not come out whole is rounded, and each axis scaled by what it really is.
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


class _Matrix(BaseModel):
    model_config = ConfigDict(strict=True)

    data: list[Annotated[float, Field(allow_inf_nan=False)]]


class _CameraMatrix(_Matrix):
    data: Annotated[list[Annotated[float, Field(allow_inf_nan=False)]], Field(min_length=9, max_length=9)]


class _CameraInfo(BaseModel):
    """What we use of a ROS camera_info file; the rest of it (rectification, projection) follows from this."""

    model_config = ConfigDict(strict=True)

    image_width: Annotated[int, Field(gt=0)]
    image_height: Annotated[int, Field(gt=0)]
    camera_name: str = "camera"
    camera_matrix: _CameraMatrix
    distortion_model: str
    distortion_coefficients: _Matrix


def read_camera_yaml(path: Path) -> CameraModel:
    """Reads a camera_info file as ROS's camera_calibration writes it.

    plumb_bob with four coefficients (no k3) is accepted, as are trailing zeros.

    Raises:
        CalibError: one line that names file, field, value, limit and way out.
    """
    info = validated(_CameraInfo, parse_mapping(read_text(path), str(path)), str(path))
    fx, skew, cx, *lower = info.camera_matrix.data
    below, fy, cy = lower[:3]
    if skew or below or lower[3:] != [0.0, 0.0, 1.0]:
        raise CalibError(
            f"{path}: camera_matrix.data is {info.camera_matrix.data} but must be [fx, 0, cx, 0, fy, cy, 0, 0, 1]; "
            "calibrate without skew"
        )
    coefficients = fitted_coefficients(info.distortion_coefficients.data, COEFFICIENTS.get(info.distortion_model))
    try:
        return CameraModel(
            info.camera_name,
            info.image_width,
            info.image_height,
            fx,
            fy,
            cx,
            cy,
            info.distortion_model,
            tuple(coefficients),
        )
    except CalibError as error:
        raise CalibError(f"{path}: {error}") from error


def fitted_coefficients(coefficients: list[float], expected: int | None) -> list[float]:
    """The coefficients without surplus zeros, and with plumb_bob's k3 where it was left out."""
    if expected == COEFFICIENTS["plumb_bob"] and len(coefficients) == expected - 1:
        return [*coefficients, 0.0]
    if expected is not None and not any(coefficients[expected:]):
        return coefficients[:expected]
    return coefficients


def write_camera_yaml(model: CameraModel, path: Path) -> None:
    """Writes a ROS camera_info file that `read_camera_yaml` gives back to the last bit; whole or not at all."""
    projection = np.hstack([model.matrix, np.zeros((3, 1))])
    info = {
        "image_width": model.width_px,
        "image_height": model.height_px,
        "camera_name": model.name,
        "camera_matrix": _as_ros_matrix(model.matrix),
        "distortion_model": model.distortion_model,
        "distortion_coefficients": _as_ros_matrix(np.array([model.distortion])),
        "rectification_matrix": _as_ros_matrix(np.eye(3)),
        "projection_matrix": _as_ros_matrix(projection),
    }
    text = yaml.safe_dump(info, sort_keys=False, default_flow_style=None, width=120)
    with written_whole(path) as partial:
        partial.write_text(text, encoding="utf-8")


def _as_ros_matrix(matrix: FloatArray) -> dict[str, int | list[float]]:
    rows, columns = matrix.shape
    return {"rows": rows, "cols": columns, "data": [float(value) for value in matrix.ravel()]}
