"""Import of foreign recordings, CSV folders, ROS bags and WPILib logs, as run logs.

In: a folder, a bag or a log, and options that describe the robot. Out: a run log that `map` reads like a recorded one.
In the paper: its recorded data, which can be imported as CSV.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
