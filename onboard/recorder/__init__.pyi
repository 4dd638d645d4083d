from .disk.log_keeper import LogStatus
from .live_recorder import LiveRecorder
from .recorder import RecorderCore, RunIdentity
from .robot_files import RobotCamera, RobotFiles, capture_settings
from .watching import Watcher

__all__ = [
    "LiveRecorder",
    "LogStatus",
    "RecorderCore",
    "RobotCamera",
    "RobotFiles",
    "RunIdentity",
    "Watcher",
    "capture_settings",
]
