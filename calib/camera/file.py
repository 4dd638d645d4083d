"""Camera files: reading of ROS camera_info and Kalibr's camchain, writing of ROS camera_info.

ROS ignores unknown fields. The uncertainty of a calibration is therefore stored in the same file, as
`groundsbot_estimate`.
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

_ROUNDED_UP: Final = 1.001  # allowance for rounded numbers in the file


class _Matrix(BaseModel):
    model_config = ConfigDict(strict=True)

    data: list[Annotated[float, Field(allow_inf_nan=False)]]


class _CameraMatrix(_Matrix):
    data: Annotated[list[Annotated[float, Field(allow_inf_nan=False)]], Field(min_length=9, max_length=9)]


class CameraEstimate(BaseModel):
    """Uncertainty of a calibration.

    Attributes:
        n_views: number of views used.
        n_corners: number of corners used.
        corner_sigma_px: sigma of a typical corner's coordinate.
        expected_error_px: RMS over the picture of the expected prediction error.
        parameters: names of the intrinsics, in the order of `calib.camera.parameters`.
        sigmas: their standard deviations.
        covariance: their covariance, row by row.
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
                "covariance must have the squared sigmas on its diagonal and no entry beyond the product of two sigmas"
            )
        return self

    def matrix(self) -> FloatArray:
        """Return the covariance (n, n)."""
        n = len(self.parameters)
        return np.array(self.covariance).reshape(n, n)


class _Estimated(BaseModel):
    model_config = ConfigDict(strict=True)

    groundsbot_estimate: CameraEstimate | None = None


class _CameraInfo(BaseModel):
    """Fields of a ROS camera_info file that are used; the others (rectification, projection) follow from them."""

    model_config = ConfigDict(strict=True)

    image_width: Annotated[int, Field(gt=0)]
    image_height: Annotated[int, Field(gt=0)]
    camera_name: str = "camera"
    camera_matrix: _CameraMatrix
    distortion_model: str
    distortion_coefficients: _Matrix


def read_camera_yaml(path: Path) -> CameraModel:
    """Read a camera_info file as written by ROS's camera_calibration, or a Kalibr camchain with one camera.

    plumb_bob with four coefficients (no k3) and trailing zeros are accepted.

    Raises:
        CalibError: the file is unreadable or has an invalid value.
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
    """Return the uncertainty stored in a camera file, or None if it has none.

    Raises:
        CalibError: the stored values are invalid.
    """
    return validate(_Estimated, parse_mapping(read_text(path), str(path)), str(path)).groundsbot_estimate


def fitted_coefficients(coefficients: list[float], expected: int | None) -> list[float]:
    """Return the coefficients without surplus zeros, and with a zero k3 if plumb_bob has four."""
    if expected == COEFFICIENTS["plumb_bob"] and len(coefficients) == expected - 1:
        return [*coefficients, 0.0]
    if expected is not None and not any(coefficients[expected:]):
        return coefficients[:expected]
    return coefficients


def write_camera_yaml(model: CameraModel, path: Path, estimate: CameraEstimate | None = None) -> None:
    """Write a ROS camera_info file, atomically; `read_camera_yaml` returns the same model to the last bit."""
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
