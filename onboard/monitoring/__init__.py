"""Watching a recorder: the check before a drive, status files, and their views for a person.

In: robot.yaml and devices, or a running recorder's state. Out: verdicts and figures. The paper has no such block.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
