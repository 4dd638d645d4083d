"""Reprojection factors of tag corners in pixels.

The base has an SE(2) pose T in map, the camera an SE(3) mount on the base, and the tag an SE(3) pose (R, p) in map. A
corner c of the tag is at q = R c + p in map, at b = T^-1 q in base, and at k = R_mount^T (b - p_mount) in the camera.
Its pixels follow from the lens model with distortion. With a rolling shutter the pose of base at the readout of each
corner's row is predicted by odometry.

On an uneven floor the base of an image has a small roll, pitch and height. These three nuisance parameters are the same
for all corners of an image, and are eliminated image by image. This is equivalent to whitening by the marginal
covariance R + J S J^T, in Woodbury's form.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from groundsbot.calib.camera import CameraModel
from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray
from groundsbot.offline.corners.kernels.lens import lenses_of
from groundsbot.offline.corners.kernels.linearisation import N_DETECTION, linearise_corners
from groundsbot.offline.corners.kernels.view import CornerObservations, SpatialValues
from groundsbot.offline.sam import Columns, Linearised, State

# Mount parameters of a camera, in the order of `CornerObservations.mount`.
CORNER_MOUNT: Final = ("mount_x_m", "mount_y_m", "mount_z_m", "mount_roll_rad", "mount_pitch_rad", "mount_yaw_rad")
# Attitude and height of the base of an image on an uneven floor.
ATTITUDE: Final = ("roll_rad", "pitch_rad", "height_m")


@dataclass(frozen=True)
class SpatialState(State):
    """A state with SE(3) tag poses.

    Attributes:
        heights_m: (T,) heights of the tags' centres above the floor.
        turns: (T, 3, 3) R_map_tag.
    """

    heights_m: FloatArray
    turns: FloatArray


@dataclass(frozen=True)
class SpatialColumns(Columns):
    """The columns of each variable in the tangent vector; -1 where fixed.

    Attributes:
        heights: (T,) columns of additive perturbations.
        turns: (T, 3) columns of right perturbations R exp(d), about the tag's axes.
    """

    heights: IntArray
    turns: IntArray


@dataclass(frozen=True)
class CornerFactors:
    """The reprojection factors r = (predicted - detected) / sigma, with eight residuals per detection."""

    observations: CornerObservations
    cameras: tuple[CameraModel, ...]

    @cached_property
    def _last(self) -> list[tuple[SpatialState, SpatialColumns, tuple[Linearised, FloatArray]]]:
        """Last state, columns and result of `linearise`; at most one entry."""
        return []

    @cached_property
    def lenses(self) -> FloatArray:
        """Lens parameters of the cameras for compiled functions."""
        return lenses_of(self.cameras)

    def linearise(self, state: SpatialState, columns: SpatialColumns) -> tuple[Linearised, FloatArray]:
        """Return residuals (M, 8), one block of `columns`, and derivatives (M, 8, 3) with respect to ATTITUDE.

        Residuals are NaN where a lens has no image of a corner. The last result is cached, since a fit of the floor's
        sigmas evaluates one state many times.
        """
        if not self._last or self._last[0][0] is not state or self._last[0][1] is not columns:
            self._last[:] = [(state, columns, self._linearise(state, columns))]
        return self._last[0][2]

    def _linearise(self, state: SpatialState, columns: SpatialColumns) -> tuple[Linearised, FloatArray]:
        n = self.observations.n
        residual, jacobian, by_attitude = np.empty((n, 8)), np.empty((n, 8, N_DETECTION)), np.empty((n, 8, 3))
        linearise_corners(self.observations, self.lenses, spatial_values(state), residual, jacobian, by_attitude)
        return Linearised(residual, ((self.columns(columns), jacobian),)), by_attitude

    def columns(self, columns: SpatialColumns) -> IntArray:
        """Return columns (M, 19) of pose, tag position, tag rotation, mount, time, scale, focal length and edges."""
        detections = self.observations
        return np.concatenate(
            [
                columns.poses[detections.pose],
                columns.tags[detections.tag],
                columns.heights[detections.tag][:, None],
                columns.turns[detections.tag],
                columns.calibration[detections.mount_parameters],
                columns.calibration[detections.time_parameter][:, None],
                columns.calibration[detections.scale_parameter][:, None],
                columns.calibration[detections.focal_parameter][:, None],
                columns.calibration[detections.edge_parameter][:, None],
            ],
            axis=-1,
        )


def spatial_values(state: SpatialState) -> SpatialValues:
    """Return the state for compiled functions."""
    return SpatialValues(state.poses, state.tags, state.calibration, state.heights_m, state.turns)


def columns_of(n_poses: int, free: BoolArray, sigmas: FloatArray) -> SpatialColumns:
    """Return columns of poses, tag positions, heights and rotations, and calibration, in this order.

    The first pose, exact parameters, and heights and rotations of tags without detections (free is False) are fixed.
    """
    n_tags = len(free)
    poses = np.arange(-3, 3 * n_poses - 3).reshape(n_poses, 3)
    poses[0] = -1
    n = 3 * n_poses - 3
    tags = n + np.arange(2 * n_tags).reshape(n_tags, 2)
    n += 2 * n_tags
    index = np.where(free, np.cumsum(free) - 1, -1)
    heights = np.where(free, n + index, -1)
    n += int(free.sum())
    turns = np.where(free[:, None], n + 3 * index[:, None] + np.arange(3), -1)
    n += 3 * int(free.sum())
    known = sigmas > 0.0
    calibration = np.where(known, n + np.cumsum(known) - 1, -1)
    return SpatialColumns(poses, tags, calibration, n + int(known.sum()), heights, turns)
