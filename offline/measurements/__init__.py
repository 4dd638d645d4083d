"""The front end: one run log to keyframes, odometry factors and tag measurements, each with its covariance.

In: a run log. Out: `Run` and `Segment` (one unbroken segment of a drive), with everything that the estimate takes from
them. In the paper: the motion model (`motion_model/`) and the sensor model (`sensor_model/`).
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
