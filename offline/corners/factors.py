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
from typing import Final, NamedTuple

import numpy as np

from groundsbot.calib.camera import CameraModel
from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.corners.kernels.lens import lenses_of
from groundsbot.offline.corners.kernels.view import CornerArrays, SpatialValues
from groundsbot.offline.measurements import UNIT_CORNERS
from groundsbot.offline.sam import Columns, Linearised, State

# The other calibration numbers that corners depend on, besides the time offset and the scale of the tag's batch.
CORNER_MOUNT: Final = ("mount_x_m", "mount_y_m", "mount_z_m", "mount_roll_rad", "mount_pitch_rad", "mount_yaw_rad")
# How a picture's base may stand on an uneven floor.
WOBBLE: Final = ("roll_rad", "pitch_rad", "height_m")

_LEVEL_OPTICAL: Final = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
_UP: Final = np.array([0.0, 0.0, 1.0])


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


class PredictedCorners(NamedTuple):
    """Predicted corners.

    Attributes:
        in_base: (M, 4, 3) the corners in base when their rows were read out.
        pixels: (M, 4, 2) before sides are seen too far out; NaN where the lens has no image of a corner.
        by_base: (M, 4, 2, 3) derivative of the pixels by in_base.
        in_keyframe: (M, 4, 3) the corners in base at the keyframe.
        R_base_camera: (M, 3, 3)
    """

    in_base: FloatArray
    pixels: FloatArray
    by_base: FloatArray
    in_keyframe: FloatArray
    R_base_camera: FloatArray


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

    def residual(self, state: SpatialState) -> FloatArray:
        """(M, 8), whitened; NaN where the lens has no image of a corner."""
        return self._residual(state, self._predict(state))

    def linearise(self, state: SpatialState, columns: SpatialColumns) -> tuple[Linearised, FloatArray]:
        """Residuals (M, 8), one block of `columns`, and derivatives (M, 8, 3) by WOBBLE.

        The last answer is kept: a floor's sigmas are looked for at one state.
        """
        if not self._last or self._last[0][0] is not state or self._last[0][1] is not columns:
            self._last[:] = [(state, columns, self._linearise(state, columns))]
        return self._last[0][2]

    def _linearise(self, state: SpatialState, columns: SpatialColumns) -> tuple[Linearised, FloatArray]:
        seen = self._predict(state)
        wobble = np.concatenate([_by_turning(seen.by_base, seen.in_base)[..., :2], -seen.by_base[..., 2:]], axis=-1)
        whitened = wobble.reshape(len(self.observations), 8, 3) / self.observations.sigma_px[:, None, None]
        block = self.columns(columns), self._jacobian(state, seen)
        return Linearised(self._residual(state, seen), (block,)), whitened

    def _jacobian(self, state: SpatialState, seen: PredictedCorners) -> FloatArray:
        looks = self.observations
        turned_rows = _about_up(looks.moved[..., 2] - (self._late(state) * looks.twist[:, 2])[:, None])
        by_keyframe = seen.by_base @ turned_rows.swapaxes(-1, -2)
        by_map = by_keyframe @ _about_up(state.poses[looks.pose, 2])[:, None].swapaxes(-1, -2)
        by_tag = by_map @ state.turns[looks.tag][:, None]  # by a corner's place in the tag's own axes
        corners = np.concatenate([self._corners(state), np.zeros((len(looks), 4, 1))], axis=-1)
        scale = 1.0 + state.calibration[looks.scale_parameter]
        by_scale = by_tag @ (corners / scale[:, None, None])[..., None]
        by_late = -_by_moving(seen.by_base, seen.in_base) @ looks.twist[:, None, :, None]
        by_focal = (seen.pixels - self._centres()) / self._focal(state)[:, None, None]
        jacobian = np.concatenate(
            [
                _by_moving(by_keyframe, seen.in_keyframe),
                by_map,
                -_by_turning(by_tag, corners),
                self._by_mount(state, seen),
                by_late,
                by_scale,
                by_focal[..., None],
                looks.outward[..., None],
            ],
            axis=-1,
        )
        whitened: FloatArray = jacobian.reshape(len(looks), 8, -1) / looks.sigma_px[:, None, None]
        return whitened

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

    def _residual(self, state: SpatialState, seen: PredictedCorners) -> FloatArray:
        looks = self.observations
        shifted = seen.pixels + state.calibration[looks.edge_parameter][:, None, None] * looks.outward
        off: FloatArray = (shifted - looks.corners_px) / looks.sigma_px[:, None, None]
        return off.reshape(len(looks), 8)

    def _corners(self, state: SpatialState) -> FloatArray:
        """(M, 4, 2) in the tag's own axes."""
        side_m = self.observations.side_m * (1.0 + state.calibration[self.observations.scale_parameter])
        return UNIT_CORNERS * side_m[:, None, None]

    def _late(self, state: SpatialState) -> FloatArray:
        """(M,) seconds by which each stamp is late: the picture shows where base was so long before it."""
        return state.calibration[self.observations.time_parameter]

    def _mount(self, state: SpatialState) -> tuple[FloatArray, FloatArray]:
        """(M, 6) as corrected, and R_base_camera (M, 3, 3)."""
        mount = self.observations.mount + state.calibration[self.observations.mount_parameters]
        roll, pitch, yaw = mount[:, 3], mount[:, 4], mount[:, 5]
        return mount, _about_up(yaw) @ _rotation_about_y(pitch) @ _about_forward(roll) @ _LEVEL_OPTICAL

    def _predict(self, state: SpatialState) -> PredictedCorners:
        looks = self.observations
        flat = self._corners(state)
        in_map = flat @ state.turns[looks.tag][..., :2].swapaxes(-1, -2)
        in_map[..., :2] += state.tags[looks.tag][:, None]
        in_map[..., 2] += state.heights_m[looks.tag][:, None]
        in_keyframe = _from(state.poses[looks.pose][:, None], in_map)
        late = np.zeros((len(looks), 1, 3))
        late[:, 0] = -self._late(state)[:, None] * looks.twist
        in_base = _from(se2.compose(looks.moved, se2.exp(late)), in_keyframe)
        mount, rotation = self._mount(state)
        in_camera = (in_base - mount[:, None, :3]) @ rotation
        pixels, by_camera = self._project(in_camera)
        focal, centres = self._focal(state)[:, None, None], self._centres()
        pixels, by_camera = centres + focal * (pixels - centres), focal[..., None] * by_camera
        return PredictedCorners(in_base, pixels, by_camera @ rotation[:, None].swapaxes(-1, -2), in_keyframe, rotation)

    def _focal(self, state: SpatialState) -> FloatArray:
        """(M,) true focal length over that of the camera's file."""
        return np.asarray(1.0 + state.calibration[self.observations.focal_parameter], dtype=np.float64)

    def _centres(self) -> FloatArray:
        """(M, 1, 2) principal points."""
        return np.array([[each.cx_px, each.cy_px] for each in self.cameras])[self.observations.camera][:, None]

    def _project(self, in_camera: FloatArray) -> tuple[FloatArray, FloatArray]:
        if len(self.cameras) == 1:
            return self.cameras[0].project_with_jacobian(in_camera)
        pixels, by_camera = np.empty((*in_camera.shape[:-1], 2)), np.empty((*in_camera.shape[:-1], 2, 3))
        for i, camera in enumerate(self.cameras):
            own = self.observations.camera == i
            pixels[own], by_camera[own] = camera.project_with_jacobian(in_camera[own])
        return pixels, by_camera

    def _by_mount(self, state: SpatialState, seen: PredictedCorners) -> FloatArray:
        """(M, 4, 2, 6) by CORNER_MOUNT: a camera that turns about an axis of base sees all else turn back."""
        mount, _ = self._mount(state)
        pitch, yaw = mount[:, 4], mount[:, 5]
        cos, sin = np.cos(yaw), np.sin(yaw)
        zero = np.zeros_like(yaw)
        roll_axis = np.stack([cos * np.cos(pitch), sin * np.cos(pitch), -np.sin(pitch)], axis=-1)
        pitch_axis = np.stack([-sin, cos, zero], axis=-1)
        axes = np.stack([roll_axis, pitch_axis, np.broadcast_to(_UP, pitch_axis.shape)], axis=1)
        about = seen.in_base - mount[:, None, :3]
        by_turn = _by_turning(seen.by_base, about) @ axes[:, None].swapaxes(-1, -2)
        return np.concatenate([-seen.by_base, by_turn], axis=-1)


def spatial_values(state: SpatialState) -> SpatialValues:
    """For compiled functions."""
    return SpatialValues(state.poses, state.tags, state.calibration, state.heights_m, state.turns)


def _by_moving(by_point: FloatArray, point: FloatArray) -> FloatArray:
    """(M, 4, 2, 3) by the right perturbation of the planar pose that a point is seen from: it moves by -(d + w x p)."""
    by_theta = by_point[..., 0] * point[..., 1, None] - by_point[..., 1] * point[..., 0, None]
    return np.concatenate([-by_point[..., :2], by_theta[..., None]], axis=-1)


def _by_turning(by_point: FloatArray, point: FloatArray) -> FloatArray:
    """(M, 4, 2, 3) by a small turn w of the axes that a point is given in: there it moves by -(w x p)."""
    x, y, z = (point[..., i, None] for i in range(3))
    by_x, by_y, by_z = (by_point[..., i] for i in range(3))
    return np.stack([by_y * z - by_z * y, by_z * x - by_x * z, by_x * y - by_y * x], axis=-1)


def _from(T_a_b: FloatArray, points_a: FloatArray) -> FloatArray:
    """Points (..., 3) of frame a in frame b, which stands on the same floor: T is planar (..., 3)."""
    seen = np.empty(np.broadcast_shapes(T_a_b.shape, points_a.shape))
    cos, sin = np.cos(T_a_b[..., 2]), np.sin(T_a_b[..., 2])
    x, y = points_a[..., 0] - T_a_b[..., 0], points_a[..., 1] - T_a_b[..., 1]
    seen[..., 0], seen[..., 1], seen[..., 2] = cos * x + sin * y, cos * y - sin * x, points_a[..., 2]
    return seen


def _about_up(angle_rad: FloatArray) -> FloatArray:
    return _about(angle_rad, 0, 1)


def _rotation_about_y(angle_rad: FloatArray) -> FloatArray:
    return _about(angle_rad, 2, 0)


def _about_forward(angle_rad: FloatArray) -> FloatArray:
    return _about(angle_rad, 1, 2)


def _about(angle_rad: FloatArray, first: int, second: int) -> FloatArray:
    """Turns (..., 3, 3) from the first axis towards the second."""
    turn = np.zeros((*angle_rad.shape, 3, 3))
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    turn[..., first, first] = turn[..., second, second] = cos
    turn[..., first, second], turn[..., second, first] = -sin, sin
    turn[..., 3 - first - second, 3 - first - second] = 1.0
    return turn
