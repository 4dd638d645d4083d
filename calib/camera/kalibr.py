"""Cameras as Kalibr writes them (camchain.yaml): `cam0: {camera_model, intrinsics, distortion_model, ...}`.

Source: Kalibr's wiki, Yaml formats. Only Kalibr's pinhole with radtan, equidistant or no distortion is a camera that we
have; its equidistant is OpenCV's fisheye.
"""

from collections.abc import Mapping
from typing import Annotated, Any, Final

from pydantic import BaseModel, ConfigDict, Field

from groundsbot.calib.camera.model import CameraModel
from groundsbot.calib.errors import CalibError
from groundsbot.calib.foundation import validate

_DISTORTIONS: Final = {"radtan": "plumb_bob", "equidistant": "equidistant", "none": "plumb_bob"}
_FinitePart = Annotated[float, Field(allow_inf_nan=False)]


class _KalibrCamera(BaseModel):
    model_config = ConfigDict(strict=True)

    camera_model: str
    intrinsics: list[_FinitePart]
    distortion_model: str
    distortion_coeffs: list[_FinitePart] = []
    resolution: Annotated[list[Annotated[int, Field(gt=0)]], Field(min_length=2, max_length=2)]


def is_kalibr(content: Mapping[str, Any]) -> bool:
    """Whether the content of a YAML file is a chain of cameras."""
    return any(name in content for name in ("cam0", "cam1"))


def camera_from_kalibr(content: Mapping[str, Any], source: str) -> CameraModel:
    """The one camera of a chain.

    Args:
        content: of the file.
        source: names the file in errors.

    Raises:
        CalibError: several cameras, or one that we do not have.
    """
    names = [name for name in content if str(name).startswith("cam") and isinstance(content[name], Mapping)]
    if len(names) != 1:
        raise CalibError(f"{source}: has {len(names)} cameras ({', '.join(names)}); leave the one that is meant")
    camera = validate(_KalibrCamera, content[names[0]], f"{source}: {names[0]}")
    if camera.camera_model != "pinhole" or camera.distortion_model not in _DISTORTIONS:
        raise CalibError(
            f"{source}: {names[0]} is {camera.camera_model} with {camera.distortion_model} but must be pinhole with "
            f"{', '.join(_DISTORTIONS)}; calibrate with one of these"
        )
    if len(camera.intrinsics) != 4:
        raise CalibError(f"{source}: {names[0]}.intrinsics has {len(camera.intrinsics)} numbers but pinhole takes 4")
    kind = _DISTORTIONS[camera.distortion_model]
    coefficients = camera.distortion_coeffs or [0.0] * 4
    if len(coefficients) != 4:
        raise CalibError(f"{source}: {names[0]}.distortion_coeffs has {len(coefficients)} numbers but must have 4")
    values = (*coefficients, 0.0) if kind == "plumb_bob" else tuple(coefficients)  # no k3
    (width_px, height_px), (fx, fy, cx, cy) = camera.resolution, camera.intrinsics
    try:
        return CameraModel(names[0], width_px, height_px, fx, fy, cx, cy, kind, values)
    except CalibError as error:
        raise CalibError(f"{source}: {error}") from error
