from .battery import battery_rows, read_batteries
from .check import DeviceCheck, ShowPicture, check_robot
from .push_check import check_push
from .recording import Recording
from .status import STATUS_SUFFIX, Status, is_alive
from .status_rows import rows
from .status_view import print_once, show_live

__all__ = [
    "STATUS_SUFFIX",
    "DeviceCheck",
    "Recording",
    "ShowPicture",
    "Status",
    "battery_rows",
    "check_push",
    "check_robot",
    "is_alive",
    "print_once",
    "read_batteries",
    "rows",
    "show_live",
]
