"""Clocks, signals, console, memory and systemd for a program that runs for hours on the robot's computer.

In: the operating system. Out: the run's clock and the mapping of the wheel controller's clock to it, a stop event set
by signals, console output that never blocks, systemd notifications, and settings of the memory allocator. The paper has
no such block.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
