"""Reading of Kalibr's camera files (camchain.yaml): `cam0: {camera_model, intrinsics, distortion_model, ...}`.

Source: Kalibr's wiki, Yaml formats. Supported is Kalibr's pinhole camera with radtan, equidistant or no distortion. Its
equidistant model is OpenCV's fisheye.
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
    """Return whether the content of a YAML file is a Kalibr camchain."""
    return any(name in content for name in ("cam0", "cam1"))


def camera_from_kalibr(content: Mapping[str, Any], source: str) -> CameraModel:
    """Return the camera of a camchain with one camera.

    Args:
        content: content of the file.
        source: name of the file in errors.

    Raises:
        CalibError: the chain has several cameras, or an unsupported or invalid one.
    """
    names = [name for name in content if str(name).startswith("cam") and isinstance(content[name], Mapping)]
    if len(names) != 1:
        raise CalibError(f"{source}: has {len(names)} cameras ({', '.join(names)}); keep only the one to use")
    camera = validate(_KalibrCamera, content[names[0]], f"{source}: {names[0]}")
    if camera.camera_model != "pinhole" or camera.distortion_model not in _DISTORTIONS:
        raise CalibError(
            f"{source}: {names[0]} is {camera.camera_model} with {camera.distortion_model} but must be pinhole with "
            f"{', '.join(_DISTORTIONS)}; calibrate with one of these"
        )
    if len(camera.intrinsics) != 4:
        raise CalibError(
            f"{source}: {names[0]}.intrinsics has {len(camera.intrinsics)} numbers but must have 4: fx, fy, cx, cy"
        )
    kind = _DISTORTIONS[camera.distortion_model]
    coefficients = camera.distortion_coeffs or [0.0] * 4
    if len(coefficients) != 4:
        raise CalibError(
            f"{source}: {names[0]}.distortion_coeffs has {len(coefficients)} numbers but must have 4; add zeros"
        )
    values = (*coefficients, 0.0) if kind == "plumb_bob" else tuple(coefficients)  # k3 = 0
    (width_px, height_px), (fx, fy, cx, cy) = camera.resolution, camera.intrinsics
    try:
        return CameraModel(names[0], width_px, height_px, fx, fy, cx, cy, kind, values)
    except CalibError as error:
        raise CalibError(f"{source}: {error}") from error
