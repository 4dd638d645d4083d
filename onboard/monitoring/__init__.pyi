from .check import check_robot
from .housekeeping import Housekeeper
from .push_check import check_push
from .status import STATUS_SUFFIX, is_alive
from .status_view import print_once, show_live

__all__ = [
    "STATUS_SUFFIX",
    "Housekeeper",
    "check_push",
    "check_robot",
    "is_alive",
    "print_once",
    "show_live",
]
