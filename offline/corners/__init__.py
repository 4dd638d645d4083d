"""Bundle adjustment on tag corners in pixels, after the planar solve.

In: a solved graph. Out: the map refined on corners, with SE(3) tag poses, SE(2) robot poses, camera mounts and focal
lengths. The paper estimates tag positions only.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
