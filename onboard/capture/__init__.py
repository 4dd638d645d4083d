"""Capture of pictures of a calibration board with the robot's camera, with instructions how to hold the board.

In: the camera's pictures. Out: a folder of pictures for `groundsbot-calib camera`. The paper has no such block.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
