"""Covariances of odometry's steps, and of the poses that they add up to."""

import numpy as np

from groundsbot.calib.foundation.arrays import FloatArray


def covariances_of_steps(poses: FloatArray) -> FloatArray:
    """(N, 3, 3) in base: by the metre driven, and a little where it stands; zero for the first."""
    driven_m = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    by_metre = np.array([[1e-3, 0.0, 0.0], [0.0, 4e-4, 1e-4], [0.0, 1e-4, 9e-4]])
    steps = (driven_m[:, None, None] + 1e-4) * by_metre
    return np.concatenate([np.zeros((1, 3, 3)), steps])


def accumulate(poses: FloatArray, steps: FloatArray) -> FloatArray:
    """(N, 3, 3) in odom, of poses reached by such steps: that of the one before, carried on, and the step's own."""
    found = [np.zeros((3, 3))]
    for before, after, step in zip(poses[:-1], poses[1:], steps[1:], strict=True):
        dx, dy, _ = after - before
        cos, sin = np.cos(after[2]), np.sin(after[2])
        turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
        carry = np.array([[1.0, 0.0, -dy], [0.0, 1.0, dx], [0.0, 0.0, 1.0]])
        found.append(carry @ found[-1] @ carry.T + turn @ step @ turn.T)
    return np.array(found)
