"""The camera that robot.yaml asks for."""

from pathlib import Path

from groundsbot.onboard.camera.camera import Camera, CameraSettings, VideoCamera
from groundsbot.onboard.process import RunClock


def camera_for(settings: CameraSettings, clock: RunClock, since_ns: int) -> Camera:
    """The source that the device's name means.

    Args:
        settings: of robot.yaml.
        clock: the run's clock.
        since_ns: pictures in a folder that are older are left alone.
    """
    from groundsbot.onboard.camera.folder import FolderCamera
    from groundsbot.onboard.camera.v4l2 import V4l2Camera

    path = Path(settings.device)
    if path.is_dir():
        return FolderCamera(path, clock, since_ns)
    if path.is_file():
        return VideoCamera(path, clock)
    if settings.device.startswith("/dev/"):
        return V4l2Camera(settings, clock)
    return FolderCamera(path, clock, since_ns)  # it may be made yet
