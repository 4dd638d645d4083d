"""Tags that moved, false detections, tags that share an id, and breaks of odometry.

In: solved maps, alone or joined. Out: the same with outliers split off, and each one's kind and evidence. The paper
assumes tags that do not move.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
