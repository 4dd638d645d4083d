from .distortion import COEFFICIENTS, Distortion
from .file import CameraEstimate, fitted_coefficients, read_camera_yaml, read_estimate, write_camera_yaml
from .model import CameraModel
from .parameters import parameter_names, parameters_of, pixels_by_parameters, undistorted_camera, with_parameters
from .planar_pose import board_pose

__all__ = [
    "COEFFICIENTS",
    "CameraEstimate",
    "CameraModel",
    "Distortion",
    "board_pose",
    "fitted_coefficients",
    "parameter_names",
    "parameters_of",
    "pixels_by_parameters",
    "read_camera_yaml",
    "read_estimate",
    "undistorted_camera",
    "with_parameters",
    "write_camera_yaml",
]
