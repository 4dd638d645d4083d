from .command import calibrate_camera, check_camera

__all__ = [
    "calibrate_camera",
    "check_camera",
]
