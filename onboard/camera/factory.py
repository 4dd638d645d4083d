"""Selection of the camera class for the device of robot.yaml."""

from pathlib import Path

from groundsbot.onboard.camera.camera import Camera, CameraSettings, VideoCamera
from groundsbot.onboard.process import RunClock


def camera_for(settings: CameraSettings, clock: RunClock, since_ns: int) -> Camera:
    """Return the camera for a device name.

    Args:
        settings: settings from robot.yaml.
        clock: the run's clock.
        since_ns: older pictures in a folder are ignored.
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
    return FolderCamera(path, clock, since_ns)  # the folder may be created later
