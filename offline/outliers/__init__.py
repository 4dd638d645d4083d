"""Detection of tags that moved, false detections, duplicate ids, and breaks of odometry.

In: solved maps, alone or joined. Out: the same maps with outliers split off, and the kind and evidence of each outlier.
The paper assumes that tags do not move.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
