"""Construction of the bundle adjustment on tag corners from a solved planar map."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Final, NamedTuple

import numpy as np

from groundsbot.calib.camera import CameraModel
from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray
from groundsbot.calib.robot import (
    CAMERA_PARAMETERS,
    EDGE_SHIFT,
    FOCAL_SCALE,
    MOUNT_PARAMETERS,
    TIME_OFFSET,
    Robot,
    camera_parameter,
)
from groundsbot.calib.tags import outward
from groundsbot.offline.corners.edge_directions import with_predicted_facings
from groundsbot.offline.corners.factors import CORNER_MOUNT, CornerFactors, SpatialState, columns_of
from groundsbot.offline.corners.heading_jitter import with_heading_jitter
from groundsbot.offline.corners.initial_calibration import initial_calibration
from groundsbot.offline.corners.initial_tag_poses import with_initial_tag_poses
from groundsbot.offline.corners.kernels.view import CornerObservations
from groundsbot.offline.corners.problem import CornerProblem
from groundsbot.offline.corners.upright_prior import NO_UPRIGHT_PRIOR, UprightFactors
from groundsbot.offline.measurements import Segment
from groundsbot.offline.sam import CalibrationPrior, Graph, ObservationFactors, Parameter, State

_CORNER_NOISE: Final = "sigma_corner_px"
_HEIGHT: Final = "mount_z_m"


@dataclass(frozen=True)
class CornerGraph:
    """A bundle adjustment problem, and what its variables stand for.

    Attributes:
        problem: factors on the pixels of tag corners and on odometry, with the columns of the variables.
        graph: planar graph of the same drives. It names segments, poses and tags, in the order that `problem` uses.
        parameters: (C,) calibration parameters in the order of `problem`: those of the planar graph, then those that
            only pixels of corners depend on, as the height of the camera.
    """

    problem: CornerProblem
    graph: Graph
    parameters: tuple[Parameter, ...]

    @property
    def has_pose(self) -> BoolArray:
        """Mask (T,) of tags with an estimated height and orientation."""
        return np.asarray(self.problem.columns.heights >= 0)

    def heights_of(self, segment: int) -> dict[str, int]:
        """Return the parameter index of the height of each camera of one segment that saw corners, by name."""
        run = self.graph.segments[segment].run
        heights = {name: _height_parameter(run.robot, name) for name in run.robot.camera_names}
        return {name: self.parameters.index(each) for name, each in heights.items() if each in self.parameters}


def corner_graph(
    graph: Graph, state: State, upright_sigma_rad: float | None = None
) -> tuple[CornerGraph, SpatialState]:
    """Build the problem and its initial state: the planar solution with tag poses and mounts fitted to detections.

    Args:
        graph: planar graph, with one observation for each detection.
        state: its solution.
        upright_sigma_rad: sigma to which tags are known to be mounted upright; None if they are not.
    """
    segments, masks = graph.segments, [segment.observations.from_corners for segment in graph.segments]
    seeing = [each for segment, mask in zip(segments, masks, strict=True) for each in _seeing_cameras(segment, mask)]
    of_corners = sorted({each for camera in seeing for each in (camera.height, camera.focal_scale)})
    parameters = (*graph.parameters, *of_corners)
    detections, cameras = _observations(graph, parameters, masks)
    floor = graph.problem
    n_tags = len(graph.tags)
    seen = np.bincount(detections.tag, minlength=n_tags) > 0
    kept = ~np.concatenate(masks)
    sigmas = np.array([parameter.sigma for parameter in parameters])
    problem = CornerProblem(
        odometry=floor.odometry,
        corners=CornerFactors(detections, cameras),
        observations=_observations_where(floor.observations, kept),
        prior=replace(floor.prior, sigma=sigmas, rows=np.pad(floor.prior.rows, ((0, 0), (0, len(of_corners)))))
        if len(floor.prior.rows)
        else CalibrationPrior(sigmas),
        measured=floor.measured,
        columns=columns_of(len(state.poses), seen, sigmas),
        anchor=floor.anchor,
        attitude_sigmas=np.zeros(3),
        upright=NO_UPRIGHT_PRIOR
        if upright_sigma_rad is None
        else UprightFactors(np.flatnonzero(seen), upright_sigma_rad),
    )
    start = SpatialState(
        poses=state.poses,
        tags=state.tags,
        calibration=np.concatenate([state.calibration, np.zeros(len(of_corners))]),
        heights_m=np.where(seen, np.nan, 0.0),
        turns=np.where(seen[:, None, None], np.nan, np.eye(3)),
    )
    start = initial_calibration(problem, with_initial_tag_poses(problem, start))
    jitter_rad = np.concatenate(
        [segment.observations.heading_jitter_rad[mask] for segment, mask in zip(segments, masks, strict=True)]
    )
    corners = with_predicted_facings(problem.corners, start)
    problem = replace(problem, corners=with_heading_jitter(corners, start, problem.columns, jitter_rad))
    vars(problem)["motions"] = floor.arrowhead.odometry  # cached property; odometry is in order of poses
    return CornerGraph(problem, graph, parameters), start


def _observations(
    graph: Graph, parameters: Sequence[Parameter], masks: Sequence[BoolArray]
) -> tuple[CornerObservations, tuple[CameraModel, ...]]:
    """Return the detections of all observations with corners, and their cameras."""
    floor = _observations_where(graph.problem.observations, np.concatenate(masks))
    cameras: list[CameraModel] = []
    shown: list[_CornerData] = []
    of_camera: list[tuple[int, int, int]] = []  # parameter indices of height and focal length, index of the camera
    places: list[IntArray] = []  # of the detections of each camera among all
    first = 0
    for segment, mask in zip(graph.segments, masks, strict=True):
        for each in _seeing_cameras(segment, mask):
            if each.model not in cameras:
                cameras.append(each.model)
            own = parameters.index(each.height), parameters.index(each.focal_scale)
            of_camera.append((*own, cameras.index(each.model)))
            shown.append(_corner_arrays(segment, each))
            places.append(first + np.flatnonzero(each.mask[mask]))
        first += int(mask.sum())
    in_order = np.argsort(np.concatenate(places))
    found = _CornerData(*(np.concatenate(each)[in_order] for each in zip(*shown, strict=True)))
    heights, focal, camera_of = np.repeat(of_camera, [len(each.sigma_px) for each in shown], axis=0)[in_order].T
    index: dict[str, IntArray] = {
        **dict(zip(MOUNT_PARAMETERS, floor.mount_parameters.T.astype(np.int64), strict=True)),
        **dict(zip(CAMERA_PARAMETERS, floor.camera_parameters.T.astype(np.int64), strict=True)),
        _HEIGHT: heights,
    }
    detections = CornerObservations(
        pose=floor.pose,
        tag=floor.tag,
        corners_px=found.corners_px,
        sigma_px=found.sigma_px,
        side_m=found.side_m,
        camera=camera_of,
        moved=found.moved,
        twist=found.twist,
        mount=found.mount,
        mount_parameters=np.column_stack([index[name] for name in CORNER_MOUNT]),
        time_parameter=index[TIME_OFFSET],
        scale_parameter=floor.scale_parameter.astype(np.int64),
        focal_parameter=focal,
        edge_parameter=index[EDGE_SHIFT],
        outward=outward(found.corners_px),
        jitter=np.zeros((len(floor.pose), 8)),
    )
    return CornerObservations._make(map(np.ascontiguousarray, detections)), tuple(cameras)


class _SeeingCamera(NamedTuple):
    """A camera of a segment with corners.

    Attributes:
        robot: the robot, as one with this camera only.
        model: its calibration.
        mask: (M,) which of the segment's observations are from corners that it saw.
        height, focal_scale: its parameters.
    """

    robot: Robot
    model: CameraModel
    mask: BoolArray
    height: Parameter
    focal_scale: Parameter


def _seeing_cameras(segment: Segment, mask: BoolArray) -> list[_SeeingCamera]:
    """Return the cameras of the observations (M,) with corners that a mask selects."""
    found, run = [], segment.run
    for number, name in enumerate(run.robot.camera_names):
        model, own = run.with_camera(number).camera, mask & (segment.observations.camera == number)
        if model is not None and own.any():
            height, focal = _height_parameter(run.robot, name), _focal_parameter(run.robot, name, model)
            found.append(_SeeingCamera(run.robot.with_camera(name), model, own, height, focal))
    return found


class _CornerData(NamedTuple):
    """The fields of `CornerObservations` that the planar graph does not have."""

    corners_px: FloatArray
    sigma_px: FloatArray
    side_m: FloatArray
    moved: FloatArray
    twist: FloatArray
    mount: FloatArray


def _corner_arrays(segment: Segment, camera: _SeeingCamera) -> _CornerData:
    """Return the corner data of the observations of one segment from corners that one camera saw."""
    robot, mask, observations = camera.robot, camera.mask, segment.observations
    corners_px, parts = observations.corners_px[mask], observations.parts.where(mask)
    unit = parts.of((_CORNER_NOISE,))[0]
    variance = _trace(observations.covariance[mask] - parts.rest) / _trace(unit)
    sides_m = np.array([robot.tag_size_m(tag.family, tag.tag_id)[0] for tag in segment.tags])
    moved, twist = _base_motion(segment, camera, observations.keyframe[mask], corners_px)
    twist[:, 2] = observations.turning_rad_s[mask]  # by the gyro, if there is one
    return _CornerData(
        corners_px,
        np.hypot(np.sqrt(variance), observations.corner_bias_px[mask, 1]) * observations.corner_sigmas[mask],
        sides_m[observations.tag[mask]],
        moved,
        twist,
        np.tile([getattr(robot.mount, name.removeprefix("mount_")) for name in CORNER_MOUNT], (len(corners_px), 1)),
    )


def _trace(matrices: FloatArray) -> FloatArray:
    """Return the traces (M,) of matrices (M, 2, 2), five times as fast as `numpy.trace`."""
    return np.asarray(matrices[:, 0, 0] + matrices[:, 1, 1])


def _base_motion(
    segment: Segment, camera: _SeeingCamera, keyframe: IntArray, corners_px: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return T_keyframe_base (M, 4, 3) by odometry at the readout of each corner's row, and the twist (M, 3) of base.

    The stamp of an image is that of its middle row.
    """
    robot = camera.robot
    stamps_ns = segment.stamps_ns[keyframe]
    wheel_segment = next(
        each for each in segment.run.wheel_segments if each.stamps_ns[0] <= stamps_ns[0] <= each.stamps_ns[-1]
    )
    twist = wheel_segment.twist_at(stamps_ns, robot.wheels.track_m)
    if robot.readout_s == 0.0:  # global shutter
        return np.zeros((*corners_px.shape[:-1], 3)), twist
    share = np.clip(corners_px[..., 1] / (camera.model.height_px - 1) - 0.5, -0.5, 0.5)
    rows_ns = stamps_ns[:, None] + np.rint(share * robot.readout_s * 1e9).astype(np.int64)
    return wheel_segment.motions(stamps_ns[:, None], rows_ns, robot.wheels.track_m), twist


def _height_parameter(robot: Robot, camera: str) -> Parameter:
    mount = robot.with_camera(camera).mount
    return Parameter(robot.robot_id, camera_parameter(_HEIGHT, camera), (mount.z_m,), mount.z_m_sigma)


def _focal_parameter(robot: Robot, camera: str, model: CameraModel) -> Parameter:
    """Return the parameter of the focal scale, which is fixed if robot.yaml has no sigma for it."""
    sigma = robot.with_camera(camera).focal_scale_sigma
    return Parameter(robot.robot_id, camera_parameter(FOCAL_SCALE, camera), (model.fx_px, model.fy_px), sigma)


def _observations_where(observations: ObservationFactors, kept: BoolArray) -> ObservationFactors:
    return ObservationFactors(*(getattr(observations, field.name)[kept] for field in fields(ObservationFactors)))
