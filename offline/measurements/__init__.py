"""The front end: turns a run log into keyframes, odometry factors and tag observations with covariances.

In: a run log. Out: `Run`, the measurements of one log, and `Segment`, a part of it with unbroken odometry. In the paper
these are the motion model (`motion_model/`) and the sensor model (`sensor_model/`).
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
