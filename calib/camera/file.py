"""Camera files: ROS camera_info read and written, Kalibr's chains read.

ROS reads the fields it knows and passes over others; so what our calibration says of its own errors stands in the same
file, under `groundsbot_estimate`.
"""

from pathlib import Path
from typing import Annotated, Final, Self

import numpy as np
import yaml
from pydantic import BaseModel, ConfigDict, Field, model_validator

from groundsbot.calib.camera.distortion import COEFFICIENTS
from groundsbot.calib.camera.kalibr import camera_from_kalibr, is_kalibr
from groundsbot.calib.camera.model import CameraModel
from groundsbot.calib.errors import CalibError
from groundsbot.calib.foundation import FloatArray, atomic_write, parse_mapping, read_text, validate

_ROUNDED_UP: Final = 1.001  # by whoever wrote the file


class _Matrix(BaseModel):
    model_config = ConfigDict(strict=True)

    data: list[Annotated[float, Field(allow_inf_nan=False)]]


class _CameraMatrix(_Matrix):
    data: Annotated[list[Annotated[float, Field(allow_inf_nan=False)]], Field(min_length=9, max_length=9)]


class CameraEstimate(BaseModel):
    """What a calibration says of its own errors.

    `parameters` are in the order of `calib.camera.parameters`, `covariance` is theirs, row by row.
    """

    model_config = ConfigDict(strict=True, frozen=True)

    n_views: Annotated[int, Field(gt=0)]
    n_corners: Annotated[int, Field(gt=0)]
    corner_sigma_px: Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
    expected_error_px: Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
    parameters: list[str]
    sigmas: list[Annotated[float, Field(ge=0.0, allow_inf_nan=False)]]
    covariance: list[Annotated[float, Field(allow_inf_nan=False)]]

    @model_validator(mode="after")
    def _sizes_agree(self) -> Self:
        n = len(self.parameters)
        if len(self.sigmas) != n or len(self.covariance) != n * n:
            raise ValueError(f"sigmas and covariance must have {n} and {n * n} numbers for {n} parameters")
        largest, diagonal = np.outer(self.sigmas, self.sigmas), np.diag(self.matrix())
        if (np.abs(self.matrix()) > _ROUNDED_UP * largest).any() or (_ROUNDED_UP * diagonal < np.diag(largest)).any():
            raise ValueError(
                "covariance must have the sigmas' squares on its diagonal, and nothing beyond two sigmas' product"
            )
        return self

    def matrix(self) -> FloatArray:
        """The covariance (n, n)."""
        n = len(self.parameters)
        return np.array(self.covariance).reshape(n, n)


class _Estimated(BaseModel):
    model_config = ConfigDict(strict=True)

    groundsbot_estimate: CameraEstimate | None = None


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
    """Reads a camera_info file as ROS's camera_calibration writes it, or a Kalibr camchain with one camera.

    plumb_bob with four coefficients (no k3) is accepted, as are trailing zeros.

    Raises:
        CalibError: one line that names file, field, value, limit and way out.
    """
    content = parse_mapping(read_text(path), str(path))
    if is_kalibr(content):
        return camera_from_kalibr(content, str(path))
    info = validate(_CameraInfo, content, str(path))
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


def read_estimate(path: Path) -> CameraEstimate | None:
    """What a camera file says of its own errors; None where it says nothing.

    Raises:
        CalibError: it says something that cannot be.
    """
    return validate(_Estimated, parse_mapping(read_text(path), str(path)), str(path)).groundsbot_estimate


def fitted_coefficients(coefficients: list[float], expected: int | None) -> list[float]:
    """The coefficients without surplus zeros, and with plumb_bob's k3 where it was left out."""
    if expected == COEFFICIENTS["plumb_bob"] and len(coefficients) == expected - 1:
        return [*coefficients, 0.0]
    if expected is not None and not any(coefficients[expected:]):
        return coefficients[:expected]
    return coefficients


def write_camera_yaml(model: CameraModel, path: Path, estimate: CameraEstimate | None = None) -> None:
    """Writes a ROS camera_info file that `read_camera_yaml` gives back to the last bit; whole or not at all."""
    projection = np.hstack([model.matrix, np.zeros((3, 1))])
    info: dict[str, object] = {
        "image_width": model.width_px,
        "image_height": model.height_px,
        "camera_name": model.name,
        "camera_matrix": _as_ros_matrix(model.matrix),
        "distortion_model": model.distortion_model,
        "distortion_coefficients": _as_ros_matrix(np.array([model.distortion])),
        "rectification_matrix": _as_ros_matrix(np.eye(3)),
        "projection_matrix": _as_ros_matrix(projection),
    }
    if estimate is not None:
        info["groundsbot_estimate"] = estimate.model_dump()
    text = yaml.safe_dump(info, sort_keys=False, default_flow_style=None, width=120)
    with atomic_write(path) as partial:
        partial.write_text(text, encoding="utf-8")


def _as_ros_matrix(matrix: FloatArray) -> dict[str, int | list[float]]:
    rows, columns = matrix.shape
    return {"rows": rows, "cols": columns, "data": [float(value) for value in matrix.ravel()]}
