"""RANSAC transforms between local maps from shared tags, their mutual consistency, and merging.

In: local maps. Out: transforms between pairs, and components of maps with one frame each. In the paper: the RANSAC
alignment of the robots' local maps.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
