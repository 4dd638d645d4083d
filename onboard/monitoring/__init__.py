"""Monitoring of a recorder: the check before a drive, status files, and their display.

In: robot.yaml and devices, or the state of a running recorder. Out: verdicts and figures. The paper has no such block.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
