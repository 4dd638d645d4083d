"""Reading of robot.yaml and its camera file for the recorder."""

import re
from pathlib import Path
from typing import Final

from groundsbot.calib.camera import CameraModel, read_camera_yaml
from groundsbot.calib.foundation import read_text
from groundsbot.calib.robot import Robot, parse_robot_yaml, read_robot_yaml
from groundsbot.onboard.camera import CameraSettings
from groundsbot.onboard.detection import DetectorSettings
from groundsbot.onboard.errors import OnboardError

_DEFAULT_SIZE_PX: Final = (1280, 720)
_SIZE: Final = re.compile(r"([1-9]\d{1,4})x([1-9]\d{1,4})")


class RobotFiles:
    """robot.yaml and its camera file, checked against each other.

    Attributes:
        path: path of robot.yaml.
        robot: the robot.
        text: text of robot.yaml.
        camera: the calibration; None for wheels only.
        camera_settings: settings for the camera; None for wheels only.
    """

    def __init__(self, path: Path) -> None:
        """Read both files.

        Raises:
            CalibError: a file is missing or invalid.
            OnboardError: there is no device to record, or no calibration for the camera.
        """
        self.path = path
        self.text = read_text(path)
        self.robot: Robot = parse_robot_yaml(self.text, str(path))
        if self.robot.cameras:
            raise OnboardError(f"{path}: cameras is given, but this recorder has one; give its fields at the top")
        devices = self.robot.devices
        if devices.encoder_port is None and devices.camera is None:
            raise OnboardError(f"{path}: devices names neither encoder_port nor camera; give at least one to record")
        if devices.camera is not None and self.robot.camera is None:
            raise OnboardError(
                f"{path}: devices.camera is {devices.camera} but camera names no calibration; "
                "give a camera_info YAML or take devices.camera out"
            )
        self.camera: CameraModel | None = None
        self.camera_settings: CameraSettings | None = None
        if devices.camera is not None and self.robot.camera is not None:
            self.camera = read_camera_yaml(path.parent / self.robot.camera)
            self.camera_settings = camera_settings_of(
                self.robot, path.parent, (self.camera.width_px, self.camera.height_px)
            )

    @property
    def detector_settings(self) -> DetectorSettings:
        """Settings of the detector."""
        options = self.robot.recorder
        return DetectorSettings(
            tuple(options.families),
            options.detector,
            options.quad_decimate,
            options.jpeg_quality,
            self.camera,
            options.detector_threads,
        )


def capture_settings(path: Path, size: str | None) -> CameraSettings:
    """Return the settings for a camera that may have no calibration yet.

    Args:
        path: path of robot.yaml.
        size: size of the pictures, as 1280x720; None for the calibration's, else 1280x720.

    Raises:
        CalibError: a file is missing or invalid.
        OnboardError: the robot has no camera, or `size` is invalid.
    """
    robot = read_robot_yaml(path)
    calibration = path.parent / robot.camera if robot.camera is not None else None
    size_px = _DEFAULT_SIZE_PX
    if size is not None:
        found = _SIZE.fullmatch(size)
        if found is None:
            raise OnboardError(f"--size is {size!r} but must read like {_DEFAULT_SIZE_PX[0]}x{_DEFAULT_SIZE_PX[1]}")
        size_px = (int(found[1]), int(found[2]))
    elif calibration is not None and calibration.exists():
        model = read_camera_yaml(calibration)
        size_px = (model.width_px, model.height_px)
    return camera_settings_of(robot, path.parent, size_px)


def camera_settings_of(robot: Robot, folder: Path, size_px: tuple[int, int]) -> CameraSettings:
    """Return the settings for a robot's camera.

    Args:
        robot: the robot.
        folder: folder of robot.yaml, to which its paths are relative.
        size_px: width and height of the pictures to request.

    Raises:
        OnboardError: the robot has no camera.
    """
    devices = robot.devices
    if devices.camera is None:
        raise OnboardError(f"robot {robot.robot_id}: devices names no camera; give one in robot.yaml")
    return CameraSettings(
        str(folder / devices.camera),
        *size_px,
        devices.camera_fps,
        devices.camera_exposure_s,
        devices.camera_gain,
    )
