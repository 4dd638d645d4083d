"""Bundle adjustment on tag corners in pixels, after the planar solve.

In: a solved graph. Out: the map refined on corners: tags in space, robots on the floor, mount and focal length. The
paper stops at tag positions.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
