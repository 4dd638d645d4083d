"""Cameras: Video4Linux devices, video files and folders of pictures with one interface.

In: robot.yaml's camera settings. Out: encoded pictures, each with the time of its exposure. In the paper: the camera.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
