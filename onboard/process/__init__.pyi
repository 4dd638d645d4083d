from .children import kill_child, settle_child, signals_held_back
from .clock import DeviceClockFilter, RunClock, is_wall_clock_synchronised, read_clocks
from .console_lines import ConsoleLines
from .ending import stop_event
from .memory import keep_memory
from .systemd import Notifier

__all__ = [
    "ConsoleLines",
    "DeviceClockFilter",
    "Notifier",
    "RunClock",
    "is_wall_clock_synchronised",
    "keep_memory",
    "kill_child",
    "read_clocks",
    "settle_child",
    "signals_held_back",
    "stop_event",
]
