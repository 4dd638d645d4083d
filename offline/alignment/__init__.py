"""How local maps lie to each other: RANSAC over shared tags, which transforms hold together, merging.

In: local maps. Out: transforms between pairs, and components of maps with one frame each. In the paper: the RANSAC
alignment of the robots' local maps.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
