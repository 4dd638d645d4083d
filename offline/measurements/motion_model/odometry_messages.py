"""Collects the odometry of one log from its messages, in flat arrays, which take a tenth of their memory."""

from array import array
from bisect import bisect_right

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.onboard.log import PlanarOdometry


class OdometryMessages:
    """Messages of `/odometry`, in order.

    Attributes:
        has_poses: whether they are poses in odom, by the first message; else distances of the wheels.
        covariances: of each step, nine numbers where it has one.
    """

    def __init__(self) -> None:
        """Begin without messages."""
        self.has_poses = False
        self.covariances: list[tuple[float, ...]] = []
        self._stamps_ns = array("q")
        self._left_m, self._right_m = array("d"), array("d")
        self._poses = array("d")  # x, y, theta

    def __len__(self) -> int:
        """Number of messages."""
        return len(self._stamps_ns)

    @property
    def stamps_ns(self) -> IntArray:
        """(N,) of all messages."""
        return np.array(self._stamps_ns, dtype=np.int64)

    @property
    def wheels_m(self) -> FloatArray:
        """(N, 2) cumulative distances of the left and of the right wheel, zeros where a message has a pose."""
        return np.column_stack([self._left_m, self._right_m])

    @property
    def poses(self) -> FloatArray:
        """(N, 3) x_m, y_m, theta_rad in odom, zeros where a message has none; empty without `has_poses`."""
        return np.array(self._poses).reshape(-1, 3)

    def add(self, message: PlanarOdometry) -> None:
        """Add a message."""
        if not self._stamps_ns:
            self.has_poses = message.WhichOneof("motion") == "pose"
        wheels, covariance = message.wheels, message.covariance
        self._stamps_ns.append(message.stamp_ns)
        self._left_m.append(wheels.left_m)
        self._right_m.append(wheels.right_m)
        self.covariances.append(tuple(covariance) if covariance else ())
        if self.has_poses:
            pose = message.pose
            self._poses.extend((pose.x_m, pose.y_m, pose.theta_rad))

    def forget(self, until_ns: int) -> None:
        """Remove messages up to a stamp, except the last, as the motion after the stamp begins there."""
        n = max(0, bisect_right(self._stamps_ns, until_ns) - 1)
        del self._stamps_ns[:n], self._left_m[:n], self._right_m[:n], self._poses[: 3 * n], self.covariances[:n]
