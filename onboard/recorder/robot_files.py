"""Reading of robot.yaml and its camera files for the recorder."""

import re
from pathlib import Path
from typing import Final, NamedTuple

from groundsbot.calib.camera import CameraModel, read_camera_yaml
from groundsbot.calib.foundation import read_text
from groundsbot.calib.robot import Robot, parse_robot_yaml, read_robot_yaml
from groundsbot.onboard.camera import CameraSettings
from groundsbot.onboard.detection import DetectorSettings
from groundsbot.onboard.errors import OnboardError
from groundsbot.onboard.log import Cameras

_DEFAULT_SIZE_PX: Final = (1280, 720)
_SIZE: Final = re.compile(r"([1-9]\d{1,4})x([1-9]\d{1,4})")


class RobotCamera(NamedTuple):
    """A camera of a robot, with its files.

    Attributes:
        name: its name; empty for the only camera of a robot.
        robot: the robot with this camera alone.
        model: the calibration.
        settings: settings for the device.
    """

    name: str
    robot: Robot
    model: CameraModel
    settings: CameraSettings

    @property
    def in_words(self) -> str:
        """The camera as messages call it."""
        return f"camera {self.name}" if self.name else "camera"

    @property
    def detector_settings(self) -> DetectorSettings:
        """Settings of the detector for its pictures."""
        options = self.robot.recorder
        return DetectorSettings(
            tuple(options.families),
            options.detector,
            options.quad_decimate,
            options.jpeg_quality,
            self.model,
            options.detector_threads,
        )


class RobotFiles:
    """robot.yaml and its camera files, checked against each other.

    Attributes:
        path: path of robot.yaml.
        robot: the robot.
        text: text of robot.yaml.
        cameras: the cameras, in the order of robot.yaml; empty for wheels only.
    """

    def __init__(self, path: Path) -> None:
        """Read the files.

        Raises:
            CalibError: a file is missing or invalid.
            OnboardError: there is no device to record, or no calibration for a camera, or no device.
        """
        self.path = path
        self.text = read_text(path)
        self.robot: Robot = parse_robot_yaml(self.text, str(path))
        devices = self.robot.devices
        if devices.encoder_port is None and devices.camera is None and not self.robot.cameras:
            raise OnboardError(f"{path}: devices names neither encoder_port nor camera; give at least one to record")
        names = [] if devices.camera is None and not self.robot.cameras else self.robot.camera_names
        self.cameras = tuple(_read_camera(path, name, self.robot.with_camera(name)) for name in names)

    @property
    def models(self) -> Cameras:
        """The calibrations of the cameras."""
        named = {each.name: each.model for each in self.cameras}
        return named.get("") if not self.robot.cameras else named


def _read_camera(path: Path, name: str, robot: Robot) -> RobotCamera:
    """Return a camera of the robot in the file `path`; `robot` is the robot with this camera alone."""
    device = robot.devices.camera
    if device is None:
        raise OnboardError(
            f"{path}: cameras.{name}.device names no camera; name its device, or take the section {name} out"
        )
    if robot.camera is None:
        raise OnboardError(
            f"{path}: devices.camera is {device} but camera names no calibration; "
            "give a camera_info YAML or take devices.camera out"
        )
    model = read_camera_yaml(path.parent / robot.camera)
    return RobotCamera(name, robot, model, camera_settings_of(robot, path.parent, (model.width_px, model.height_px)))


def capture_settings(path: Path, camera: str | None, size: str | None) -> CameraSettings:
    """Return the settings for a camera that may have no calibration yet.

    Args:
        path: path of robot.yaml.
        camera: name of the camera; None for the only one.
        size: size of the pictures, as 1280x720; None for the calibration's, else 1280x720.

    Raises:
        CalibError: a file is missing or invalid.
        OnboardError: the robot has no camera, or several and none is named, or `size` is invalid.
    """
    robot = read_robot_yaml(path)
    if camera is None and len(robot.camera_names) > 1:
        names = ", ".join(robot.camera_names)
        raise OnboardError(f"{path}: the robot has several cameras; choose one by --camera: {names}")
    robot = robot.with_camera(camera if camera is not None else robot.camera_names[0])
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
