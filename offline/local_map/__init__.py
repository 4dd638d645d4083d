"""The local map of a single drive, and its goodness of fit.

In: a segment. Out: `LocalMap` (poses and tags in the frame of the drive's start, with their joint covariance) and its
test of goodness of fit. In the paper: the local map of each robot.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
