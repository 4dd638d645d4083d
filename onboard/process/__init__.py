"""What a program that runs for hours on the robot's computer needs from its process.

In: the operating system. Out: the run's clock and the mapping of the wheel controller's clock onto it, ending on a
signal, console lines that never block, systemd's notifications, memory that stays with the process. The paper has no
such block.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
