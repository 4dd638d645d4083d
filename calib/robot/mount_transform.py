"""The mount of a camera as a rigid transform of scipy, which the laptop computes with."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

# The camera's axes (x right, y down, z forward) in a frame with x forward, y left, z up.
R_LEVEL_OPTICAL = Rotation.from_matrix([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def transform_of(x_m: float, y_m: float, z_m: float, zyx_rad: Sequence[float]) -> RigidTransform:
    """Return the transform of points from the camera's optical frame to base.

    Args:
        x_m: position of the lens, as y_m and z_m.
        y_m: likewise.
        z_m: likewise.
        zyx_rad: yaw, pitch and roll.
    """
    turned = Rotation.from_euler("ZYX", zyx_rad)
    return RigidTransform.from_components(np.array([x_m, y_m, z_m]), rotation=turned * R_LEVEL_OPTICAL)
