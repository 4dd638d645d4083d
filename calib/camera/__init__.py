"""Camera models and camera files: projection of points in the camera frame to pixels, and its inverse.

In: a camera file (ROS camera_info or Kalibr), or intrinsics as a vector. Out: `CameraModel`, its distortion with
Jacobians, its uncertainty, and poses of a planar target. In the paper: the camera of its sensor model.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
