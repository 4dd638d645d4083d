"""Pictures and camera calibrations of ROS -> ours."""

from typing import Any, Final

import cv2
import numpy as np

from groundsbot.calib.camera import COEFFICIENTS, CameraModel, fitted_coefficients
from groundsbot.calib.errors import CalibError
from groundsbot.calib.foundation import is_jpeg
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.importing.bags.topics import COMPRESSED_IMAGE
from groundsbot.onboard.log import Picture, without_padding

_GREY: Final[dict[str, np.dtype[Any]]] = {
    "mono8": np.dtype(np.uint8),
    "8UC1": np.dtype(np.uint8),
    "mono16": np.dtype(np.uint16),
    "16UC1": np.dtype(np.uint16),
}
# Channels, and OpenCV's conversion to grey.
_COLOURED: Final = {
    "bgr8": (3, cv2.COLOR_BGR2GRAY),
    "8UC3": (3, cv2.COLOR_BGR2GRAY),
    "rgb8": (3, cv2.COLOR_RGB2GRAY),
    "bgra8": (4, cv2.COLOR_BGRA2GRAY),
    "rgba8": (4, cv2.COLOR_RGBA2GRAY),
    "bayer_rggb8": (1, cv2.COLOR_BayerRGGB2GRAY),
    "bayer_bggr8": (1, cv2.COLOR_BayerBGGR2GRAY),
    "bayer_gbrg8": (1, cv2.COLOR_BayerGBRG2GRAY),
    "bayer_grbg8": (1, cv2.COLOR_BayerGRBG2GRAY),
    "yuv422": (2, cv2.COLOR_YUV2GRAY_UYVY),
    "uyvy": (2, cv2.COLOR_YUV2GRAY_UYVY),
    "yuv422_yuy2": (2, cv2.COLOR_YUV2GRAY_YUY2),
    "yuyv": (2, cv2.COLOR_YUV2GRAY_YUY2),
}


def picture_of(where: str, msgtype: str, content: Any) -> Picture:  # noqa: ANN401 - made by rosbags
    """Return a message's picture: the bytes of an encoded file, or grey [height, width].

    Raises:
        OfflineError: an unsupported encoding, or fewer bytes than the size needs.
    """
    if msgtype == COMPRESSED_IMAGE:
        encoded = content.data.tobytes()
        return without_padding(encoded) if is_jpeg(encoded) else encoded
    depth = _GREY.get(content.encoding, np.dtype(np.uint8))
    if content.encoding not in _GREY and content.encoding not in _COLOURED:
        known = ", ".join([*_GREY, *_COLOURED])
        raise OfflineError(f"{where}: pictures are encoded as {content.encoding!r}, which is unsupported; use {known}")
    channels, to_grey = _COLOURED.get(content.encoding, (1, None))
    used = content.width * channels * depth.itemsize
    if content.step < used or len(content.data) < content.step * content.height or not used:
        raise OfflineError(
            f"{where}: a picture of {content.width}x{content.height} in {content.encoding} has {len(content.data)} "
            f"bytes in rows of {content.step}; correct what published it"
        )
    rows = content.data[: content.step * content.height].reshape(content.height, content.step)[:, :used]
    if depth.itemsize == 2:
        wide = np.ascontiguousarray(rows).view(">u2" if content.is_bigendian else "<u2")
        return np.asarray(wide >> 8, dtype=np.uint8)
    if to_grey is None:
        return np.ascontiguousarray(rows, dtype=np.uint8)
    shape = (content.height, content.width, channels) if channels > 1 else (content.height, content.width)
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(rows).reshape(shape), to_grey), dtype=np.uint8)


def camera_of(where: str, content: Any, *, rectified: bool) -> CameraModel:  # noqa: ANN401 - made by rosbags
    """Return the camera that a CameraInfo describes.

    Args:
        where: names bag and topic in errors.
        content: the message, of ROS 1 or 2.
        rectified: return the camera of rectified pictures, without distortion, else that of raw ones.

    Raises:
        OfflineError: it is not calibrated, or its pictures are binned or cropped.
    """
    # ROS 2 has these names in lower case.
    k, d, p = (np.asarray(getattr(content, name, getattr(content, name.upper(), ()))) for name in ("k", "d", "p"))
    roi = content.roi
    if max(content.binning_x, content.binning_y) > 1 or roi.x_offset or roi.y_offset:
        raise OfflineError(f"{where}: pictures are binned or a part of the sensor; give --robot with its `camera` set")
    matrix = p.reshape(3, 4)[:, :3] if rectified and p.any() else k.reshape(3, 3)
    model, coefficients = content.distortion_model or "plumb_bob", d.tolist()
    if rectified or not d.any():
        model, coefficients = "plumb_bob", [0.0] * COEFFICIENTS["plumb_bob"]
    try:
        return CameraModel(
            name="camera",
            width_px=content.width,
            height_px=content.height,
            fx_px=float(matrix[0, 0]),
            fy_px=float(matrix[1, 1]),
            cx_px=float(matrix[0, 2]),
            cy_px=float(matrix[1, 2]),
            distortion_model=model,
            distortion=tuple(fitted_coefficients(coefficients, COEFFICIENTS.get(model))),
        )
    except CalibError as error:
        raise OfflineError(f"{where}: {error}; or give --robot with its `camera` set") from error
