"""Inspection and repair of logs: summaries, salvaging damaged logs, detecting tags again in recorded pictures.

In: run logs. Out: a summary, or a new log; the old one is not changed. In the paper: its recorded data.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
