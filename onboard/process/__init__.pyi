from .clock import DeviceClockFilter, RunClock, read_clocks, wall_clock_synchronised
from .console_lines import ConsoleLines
from .ending import ENDING_SIGNALS, told_to_end
from .memory import keep_memory
from .systemd import Notifier

__all__ = [
    "ENDING_SIGNALS",
    "ConsoleLines",
    "DeviceClockFilter",
    "Notifier",
    "RunClock",
    "keep_memory",
    "read_clocks",
    "told_to_end",
    "wall_clock_synchronised",
]
