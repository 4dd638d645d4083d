"""Camera models and camera files: points in the camera frame to pixels and back.

In: a camera file (ROS camera_info or Kalibr), or intrinsics as a vector. Out: `CameraModel`, its distortion with
Jacobians, its uncertainty, and poses of a camera before a planar target. In the paper: the camera behind its sensor
model.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
