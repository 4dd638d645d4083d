"""The camera of PhotonVision's results: its calibration from the log, and what can be said of its picture's size."""

from pathlib import Path
from typing import Final

import numpy as np

from groundsbot.calib.camera import COEFFICIENTS, CameraModel, fitted_coefficients
from groundsbot.calib.errors import CalibError
from groundsbot.calib.foundation import FloatArray
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.importing.wpilog.reader import WpiLog, WpiTopic
from groundsbot.offline.importing.wpilog.structs import last_numbers
from groundsbot.offline.measurements import read_robot_file

_BEYOND_EDGE_PX: Final = 5.0  # corners are crossings of fitted sides, and may lie beyond the picture
# Sizes of cameras' pictures that FRC teams use.
_USUAL_SIZES: Final = (
    (320, 240),
    (640, 400),
    (640, 480),
    (800, 600),
    (1024, 768),
    (1280, 720),
    (1280, 800),
    (1280, 960),
    (1280, 1024),
    (1456, 1088),
    (1600, 1200),
    (1600, 1304),
    (1920, 1080),
    (1920, 1200),
    (2592, 1944),
    (3840, 2160),
)


def photon_camera(
    log: WpiLog, topic: WpiTopic, corners_px: FloatArray, robot_file: Path | None
) -> tuple[CameraModel, str] | None:
    """Return the camera of a topic of PhotonVision, and a remark; None where neither log nor robot.yaml has it.

    Args:
        log: the log.
        topic: PhotonVision's results.
        corners_px: (M, 4, 2) all that were seen, which lie within the picture.
        robot_file: its camera goes before the log's.

    Raises:
        GroundsbotError: robot.yaml cannot be read, or the log's calibration cannot be one.
    """
    given = read_robot_file(robot_file).camera if robot_file is not None else None
    if given is not None:
        return given, f"camera: as in {robot_file}"
    matrix = last_numbers(log, f"{topic.parent}/cameraIntrinsics")
    distortion = last_numbers(log, f"{topic.parent}/cameraDistortion")
    if matrix is None or len(matrix) != 9 or not matrix.any():
        return None
    size = _size(matrix[2], matrix[5], corners_px)
    numbers = [0.0] * COEFFICIENTS["plumb_bob"] if distortion is None else distortion.tolist()
    numbers = fitted_coefficients(numbers, COEFFICIENTS["plumb_bob"])
    kind = "plumb_bob" if len(numbers) == COEFFICIENTS["plumb_bob"] else "rational_polynomial"
    try:
        model = CameraModel(
            "camera",
            size[0],
            size[1],
            float(matrix[0]),
            float(matrix[4]),
            float(matrix[2]),
            float(matrix[5]),
            kind,
            tuple(fitted_coefficients(numbers, COEFFICIENTS[kind])),
        )
    except CalibError as error:
        raise OfflineError(f"{log.path}: {topic.parent}/cameraIntrinsics: {error}; or give --robot") from error
    said = (
        f"camera: {topic.parent}/cameraIntrinsics and cameraDistortion; the log has no picture size, "
        f"{size[0]}x{size[1]} is the usual one nearest to its principal point"
    )
    return model, said


def _size(cx_px: float, cy_px: float, corners_px: FloatArray) -> tuple[int, int]:
    """Return the usual size that holds all corners and whose middle is nearest to the principal point."""
    width, height = (corners_px.reshape(-1, 2).max(axis=0, initial=0.0) - _BEYOND_EDGE_PX).tolist()
    fitting = [each for each in _USUAL_SIZES if each[0] >= width and each[1] >= height]
    if not fitting:
        return int(np.ceil(width)) + 1, int(np.ceil(height)) + 1
    return min(fitting, key=lambda size: float(np.hypot(0.5 * size[0] - cx_px, 0.5 * size[1] - cy_px)))
