from .camera import Camera, CameraEndedError, CameraLostError, CameraSettings, Frame
from .factory import camera_for

__all__ = [
    "Camera",
    "CameraEndedError",
    "CameraLostError",
    "CameraSettings",
    "Frame",
    "camera_for",
]
