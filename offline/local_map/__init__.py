"""One drive alone: its local map, and whether the drive fits together in itself.

In: a segment. Out: `LocalMap` (poses and tags in the frame of the drive's start, with their joint covariance) and its
test of goodness of fit. In the paper: the local map of each robot.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
