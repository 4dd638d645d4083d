"""Plane geometry: SE(2) on arrays, and the arc on which a differential drive moves.

In: poses (x_m, y_m, theta_rad) and wheel advances in metres. Out: composed, inverted and fitted transforms, motions and
their Jacobians. In the paper: the exact arc of the motion model, and the transform between two robots' frames.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
