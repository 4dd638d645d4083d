"""The measurements before a keyframe, marginalised onto its pose, the calibration and the tags.

A fixed-lag smoother eliminates the poses that left its window once and keeps what they tell about the rest (Dong-Si and
Mourikis, "Motion tracking with fixed-lag smoothing", 2011). No prior is part of it, so that it stays valid when a tag
is found to have moved. Odometry and observations do not depend on the frame, so it is moved along with the tags.
"""

from dataclasses import dataclass

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.localization.online.moving_frame import pose_among


@dataclass(frozen=True)
class Marginal:
    """Measurements |J x - d|^2 on the step x of a pose and the border from their linearisation points.

    Attributes:
        rows: (3 + n, 4 + n) J by the pose's right tangent, d, and J by the border, as in `online.kernels`.
        point: (3,) linearisation point of the pose.
        calibration: (C,) that of the calibration.
        places_m: (T, 2) those of the tags.
    """

    rows: FloatArray
    point: FloatArray
    calibration: FloatArray
    places_m: FloatArray

    def about(self, point: FloatArray, calibration: FloatArray, places_m: FloatArray, columns: IntArray) -> FloatArray:
        """Return `rows` about other linearisation points.

        They are first moved with the tags near the pose, which is exact, and then shifted by what is left.

        Args:
            point: (3,) of the pose.
            calibration: (C,)
            places_m: (>= T, 2) of the tags.
            columns: (C,) column of each calibration parameter in the border, -1 where it is fixed.
        """
        n_tags = len(self.places_m)
        moved = pose_among(places_m[:n_tags], self.places_m, self.point, point)
        T = se2.compose(moved, se2.inverse(self.point))
        shift_m = places_m[:n_tags] - se2.apply(T, self.places_m)
        free = columns >= 0
        shift = np.concatenate([(calibration - self.calibration)[free], shift_m.reshape(-1)])
        rows, first = self.rows.copy(), 4 + int(free.sum())
        cos, sin = np.cos(T[2]), np.sin(T[2])
        by_tags = rows[:, first:].reshape(len(rows), n_tags, 2)
        rows[:, first:] = (by_tags @ np.array([[cos, sin], [-sin, cos]])).reshape(len(rows), 2 * n_tags)
        rows[:, 3] -= rows[:, :3] @ se2.log(se2.compose(se2.inverse(moved), point)) + rows[:, 4:] @ shift
        return rows
