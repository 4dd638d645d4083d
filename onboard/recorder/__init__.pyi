from .disk.log_keeper import LogStatus
from .live_recorder import LiveRecorder
from .recorder import RecorderCore, Run
from .robot_files import RobotFiles, capture_settings

__all__ = [
    "LiveRecorder",
    "LogStatus",
    "RecorderCore",
    "RobotFiles",
    "Run",
    "capture_settings",
]
