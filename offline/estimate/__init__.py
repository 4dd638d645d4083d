"""One heavy-tailed model of all drives of a map: its start values, its joint solve, its noise, and what it finds.

In: segments. Out: `JointEstimate`: poses and tags of each component, calibration, noise, and findings. In the paper:
local maps, RANSAC, joint solve; it departs from the paper in the distributions (docs/estimate/model.md). Read
`estimate.py` first.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
