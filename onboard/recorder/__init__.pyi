from .disk.log_keeper import LogStatus
from .live_recorder import LiveRecorder
from .recorder import RecorderCore, RunIdentity
from .robot_files import RobotFiles, capture_settings

__all__ = [
    "LiveRecorder",
    "LogStatus",
    "RecorderCore",
    "RobotFiles",
    "RunIdentity",
    "capture_settings",
]
