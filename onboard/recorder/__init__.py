"""The recorder: wheels and camera into a run log, through every fault of docs/faults.md.

In: bytes of the wheel controller and pictures, each with its time. Out: a run log. `recorder.RecorderCore` is the core
without threads or devices, `live_recorder` adds them, `disk/` keeps the log on a disk that may be slow, full or
failing. In the paper: the robot that collects data.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
