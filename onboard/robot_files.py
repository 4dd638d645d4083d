"""robot.yaml and the camera file it names, as the recorder needs them."""

from pathlib import Path

from calib.camera_model import CameraModel, read_camera_yaml
from calib.robot import Robot, parse_robot_yaml
from calib.yaml_file import read_text
from onboard.camera import CameraSettings
from onboard.detection_process import DetectorSettings
from onboard.errors import OnboardError


class RobotFiles:
    """robot.yaml and the camera file it names, read and fitting together.

    Attributes:
        path: of robot.yaml.
        robot: the robot.
        text: its file's text.
        camera: the calibration; None for wheels only.
        camera_settings: how to open the camera; None for wheels only.
    """

    def __init__(self, path: Path) -> None:
        """Reads them.

        Raises:
            CalibError: a file is missing or wrong.
            OnboardError: there is nothing to record, or no calibration for the camera.
        """
        self.path = path
        self.text = read_text(path)
        self.robot: Robot = parse_robot_yaml(self.text, str(path))
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
            self.camera_settings = CameraSettings(
                str(path.parent / devices.camera),
                self.camera.width_px,
                self.camera.height_px,
                devices.camera_fps,
                devices.camera_exposure_s,
                devices.camera_gain,
            )

    @property
    def detector_settings(self) -> DetectorSettings:
        """How to detect."""
        options = self.robot.recorder
        return DetectorSettings(tuple(options.families), options.detector, options.quad_decimate, options.jpeg_quality)
