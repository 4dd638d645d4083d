"""The recorder of wheels and camera into a run log, which tolerates the faults of docs/faults.md.

In: bytes from the wheel controller and pictures, each with its time. Out: a run log. `recorder.RecorderCore` is the
core without threads or devices, `live_recorder` adds them, and `disk/` writes to a disk that may be slow, full or
failing. In the paper: the robot that collects data.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
