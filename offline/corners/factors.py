"""Tag corners in pixels against where a robot on the floor, its camera and the tag put them.

A robot stands at an SE(2) pose, its camera sits on it by an SE(3) mount, a tag hangs at an SE(3) pose in map. A corner
c of the tag's face lies at q = R c + p in map, at b = T^-1 q in base, at k = R_mount^T (b - p_mount) in the camera, and
in the picture where the whole lens model, distortion included, has it. With a rolling shutter each corner is seen from
where the wheels say that the robot was when its row was read out.

A floor is not quite even: a picture may be taken from a base that rolls, pitches and stands higher by a little. These
three numbers are the same for all corners of a picture, so they are eliminated picture by picture, which is whitening
by the marginal covariance R + J S J^T in Woodbury's form.
"""

from dataclasses import dataclass, fields
from functools import cached_property
from typing import Final

import numpy as np

from groundsbot.calib.camera import CameraModel
from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray
from groundsbot.offline.corners.kernels.lens import lenses_of
from groundsbot.offline.corners.kernels.linearisation import N_LOOK, linearise_corners
from groundsbot.offline.corners.kernels.view import CornerArrays, SpatialValues
from groundsbot.offline.sam import Columns, Linearised, State

# The other calibration numbers that corners depend on, besides the time offset and the scale of the tag's batch.
CORNER_MOUNT: Final = ("mount_x_m", "mount_y_m", "mount_z_m", "mount_roll_rad", "mount_pitch_rad", "mount_yaw_rad")
# How a picture's base may stand on an uneven floor.
WOBBLE: Final = ("roll_rad", "pitch_rad", "height_m")


@dataclass(frozen=True)
class SpatialState(State):
    """A state whose tags hang in space.

    Attributes:
        heights_m: (T,) of the tags' centres above the floor.
        turns: (T, 3, 3) R_map_tag.
    """

    heights_m: FloatArray
    turns: FloatArray


@dataclass(frozen=True)
class SpatialColumns(Columns):
    """Where each variable sits in the tangent vector.

    Attributes:
        heights: (T,); added.
        turns: (T, 3); a small turn about the tag's own axes, R exp(d).
    """

    heights: IntArray
    turns: IntArray


@dataclass(frozen=True)
class CornerObservations:
    """M tags seen in pictures.

    Attributes:
        pose: (M,) index of the keyframe; tag: (M,) of the tag.
        corners_px: (M, 4, 2) raw pixels.
        sigma_px: (M,) of each coordinate.
        side_m: (M,) of the tag, as robot.yaml has it.
        camera: (M,) index into the cameras.
        moved: (M, 4, 3) T_keyframe_base by the wheels, when each corner's row was read out.
        twist: (M, 3) velocity of base (x, y, theta per second) at the keyframe.
        mount: (M, 6) nominal CORNER_MOUNT.
        mount_parameters: (M, 6), time_parameter: (M,), scale_parameter: (M,), focal_parameter: (M,), edge_parameter:
            (M,): indices into the calibration.
        outward: (M, 4, 2) how far corners move per pixel by which the tag's sides are seen further out
            (`edge_directions`).
    """

    pose: IntArray
    tag: IntArray
    corners_px: FloatArray
    sigma_px: FloatArray
    side_m: FloatArray
    camera: IntArray
    moved: FloatArray
    twist: FloatArray
    mount: FloatArray
    mount_parameters: IntArray
    time_parameter: IntArray
    scale_parameter: IntArray
    focal_parameter: IntArray
    edge_parameter: IntArray
    outward: FloatArray

    def __len__(self) -> int:
        """Number of looks."""
        return len(self.pose)

    def where(self, which: BoolArray | IntArray) -> "CornerObservations":
        """Those of a mask, or of indices."""
        return CornerObservations(*(getattr(self, field.name)[which] for field in fields(self)))


@dataclass(frozen=True)
class CornerFactors:
    """r = (predicted - seen) / sigma, eight numbers a look."""

    observations: CornerObservations
    cameras: tuple[CameraModel, ...]

    @cached_property
    def _last(self) -> list[tuple[SpatialState, SpatialColumns, tuple[Linearised, FloatArray]]]:
        """What was linearised last, where, and for which columns; at most one."""
        return []

    @cached_property
    def arrays(self) -> CornerArrays:
        """The looks for compiled functions."""
        return CornerArrays(
            *(np.ascontiguousarray(getattr(self.observations, field.name)) for field in fields(CornerObservations))
        )

    @cached_property
    def lenses(self) -> FloatArray:
        """Of the cameras, for compiled functions."""
        return lenses_of(self.cameras)

    def linearise(self, state: SpatialState, columns: SpatialColumns) -> tuple[Linearised, FloatArray]:
        """Residuals (M, 8), one block of `columns`, and derivatives (M, 8, 3) by WOBBLE.

        The last answer is kept: a floor's sigmas are looked for at one state.
        """
        if not self._last or self._last[0][0] is not state or self._last[0][1] is not columns:
            self._last[:] = [(state, columns, self._linearise(state, columns))]
        return self._last[0][2]

    def _linearise(self, state: SpatialState, columns: SpatialColumns) -> tuple[Linearised, FloatArray]:
        n = len(self.observations)
        residual, jacobian, by_attitude = np.empty((n, 8)), np.empty((n, 8, N_LOOK)), np.empty((n, 8, 3))
        linearise_corners(self.arrays, self.lenses, spatial_values(state), residual, jacobian, by_attitude)
        return Linearised(residual, ((self.columns(columns), jacobian),)), by_attitude

    def columns(self, columns: SpatialColumns) -> IntArray:
        """(M, 19) of pose, tag's place, its turn, mount, time, scale, focal length and sides."""
        looks = self.observations
        return np.concatenate(
            [
                columns.poses[looks.pose],
                columns.tags[looks.tag],
                columns.heights[looks.tag][:, None],
                columns.turns[looks.tag],
                columns.calibration[looks.mount_parameters],
                columns.calibration[looks.time_parameter][:, None],
                columns.calibration[looks.scale_parameter][:, None],
                columns.calibration[looks.focal_parameter][:, None],
                columns.calibration[looks.edge_parameter][:, None],
            ],
            axis=-1,
        )


def spatial_values(state: SpatialState) -> SpatialValues:
    """For compiled functions."""
    return SpatialValues(state.poses, state.tags, state.calibration, state.heights_m, state.turns)
