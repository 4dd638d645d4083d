"""Construction of one estimation problem from segments: its variables, its factors, and which variables are fixed."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray
from groundsbot.calib.robot import CAMERA_PARAMETERS, MOUNT_PARAMETERS, Mount
from groundsbot.offline.measurements import Segment, TagKey
from groundsbot.offline.sam.factors.odometry_and_observations import (
    CalibrationPrior,
    Columns,
    ObservationFactors,
    OdometryFactors,
    State,
    whitening,
)
from groundsbot.offline.sam.parameters import (
    NO_PARAMETER,
    Parameter,
    camera_parameters_of,
    mount_parameters_of,
    odometry_parameters_of,
    parameters_of_wheels,
    scale_parameter_of,
)
from groundsbot.offline.sam.solver import Problem

_Scalar = TypeVar("_Scalar", bound=np.generic)
_MOUNT: Final = "mount_"


@dataclass(frozen=True)
class Graph:
    """An estimation problem with the meaning of its variables.

    Attributes:
        segments: segments in order; the first pose of the first one is fixed and defines the frame.
        first_pose: (S,) index of each segment's first pose among all poses.
        tags: tags in order.
        parameters: parameters in order; the first one is fixed at zero.
    """

    problem: Problem
    segments: tuple[Segment, ...]
    first_pose: IntArray
    tags: tuple[TagKey, ...]
    parameters: tuple[Parameter, ...]

    @cached_property
    def _index(self) -> dict[Parameter, int]:
        """The index of each parameter."""
        return _index_of(self.parameters)

    @property
    def has_corners(self) -> bool:
        """Whether any observation was computed from corners that are in the log."""
        return any(segment.observations.from_corners.any() for segment in self.segments)

    def poses_of(self, state: State, segment: int) -> FloatArray:
        """Return the poses (K, 3) of one segment."""
        first = int(self.first_pose[segment])
        return state.poses[first : first + len(self.segments[segment].stamps_ns)]

    def odometry_calibration(self, state: State, segment: int) -> FloatArray:
        """Return the corrections (P,) of one segment's odometry: WHEEL_PARAMETERS, then those of a gyro, if any."""
        return state.calibration[self.odometry_parameters(segment)]

    def odometry_parameters(self, segment: int) -> IntArray:
        """Return the parameter index (P,) of each column of one segment's `SegmentOdometry.jacobian`."""
        return _indices(self._index, odometry_parameters_of(self.segments[segment]))

    def wheel_parameters(self, segment: int) -> IntArray:
        """Return the parameter indices (3,) of one segment's WHEEL_PARAMETERS."""
        return _indices(self._index, parameters_of_wheels(self.segments[segment].run.robot))

    def mounts_of(self, state: State, segment: int) -> dict[str, Mount]:
        """Return the corrected mounts of one segment's cameras by name; empty for a log without a camera."""
        run, mounts = self.segments[segment].run, dict[str, Mount]()
        of_cameras = camera_parameters_of(self.segments[segment])
        for number, (name, of_camera) in enumerate(zip(run.robot.camera_names, of_cameras, strict=True)):
            if run.with_camera(number).camera is None:
                continue
            parameters = [*mount_parameters_of(run.robot, name), *of_camera]
            found = state.calibration[_indices(self._index, parameters)].tolist()
            corrections = zip((*MOUNT_PARAMETERS, *CAMERA_PARAMETERS), found, strict=True)
            mount = run.robot.with_camera(name).mount.model_dump()
            for parameter, value in corrections:
                if parameter.startswith(_MOUNT):
                    mount[parameter.removeprefix(_MOUNT)] += value
            mounts[name] = Mount.model_validate(mount)
        return mounts

    def tag_scales(self, segment: int) -> IntArray:
        """Return the parameter indices of the scales of all tag batches that one segment observed."""
        owner = self.segments[segment]
        scales = sorted({scale_parameter_of(owner, tag) for tag in owner.tags}, key=lambda p: p[:3])
        return _indices(self._index, scales)

    def start(self, poses: FloatArray, tags: dict[TagKey, FloatArray], calibration: dict[Parameter, float]) -> State:
        """Return initial values of all variables, given those of the poses and of some others.

        Args:
            poses: (P, 3) T_map_base (x_m, y_m, theta_rad) of all keyframes of all segments, in order.
            tags: initial positions (2,) of tags in map, in m. Any other tag starts at the mean of the positions that
                its observations predict from the poses.
            calibration: initial corrections of calibration parameters. Any other correction starts at zero.
        """
        values = np.array([calibration.get(p, 0.0) for p in self.parameters])
        state = State(poses, np.zeros((len(self.tags), 2)), values)
        places = self.problem.observations.places_in_map(state)
        n = np.maximum(self.n_observations(), 1)
        mean = np.stack(
            [np.bincount(self.problem.observations.tag, places[:, i], len(self.tags)) / n for i in (0, 1)], axis=-1
        )
        start = [tags.get(tag, mean[i]) for i, tag in enumerate(self.tags)]
        return State(poses, np.array(start).reshape(-1, 2), values)

    def tags_of(self, state: State) -> dict[TagKey, FloatArray]:
        """Return the position (2,) of each tag in map, in metres."""
        return dict(zip(self.tags, state.tags, strict=True))

    def calibration_of(self, state: State) -> dict[Parameter, float]:
        """Return the estimated correction of each calibration parameter to the value in robot.yaml."""
        return dict(zip(self.parameters, state.calibration.tolist(), strict=True))

    def n_observations(self) -> IntArray:
        """Return the number of observations (T,) of each tag."""
        return np.bincount(self.problem.observations.tag, minlength=len(self.tags))


def build_graph(segments: Sequence[Segment]) -> Graph:
    """Build one problem from all segments; the first pose of the first segment is fixed and defines the frame."""
    tags = tuple(sorted({tag for segment in segments for tag in segment.tags}))
    parameters = tuple(sorted({p for segment in segments for p in _parameters(segment)}, key=lambda p: p[:3]))
    parameters = (NO_PARAMETER, *parameters)
    index = _index_of(parameters)
    lengths = np.array([len(segment.stamps_ns) for segment in segments])
    first_pose = np.concatenate([[0], np.cumsum(lengths)[:-1]])
    observations = _observation_factors(segments, first_pose, tags, index)
    problem = Problem(
        odometry=_odometry_factors(segments, first_pose, index),
        observations=observations,
        prior=_calibration_prior(segments, index),
        columns=columns_of(int(lengths.sum()), len(tags), np.array([p.sigma > 0.0 for p in parameters])),
        anchor=middle_observations(observations, len(tags)),
    )
    return Graph(problem, tuple(segments), first_pose, tags, parameters)


def unheld(graph: Graph) -> Graph:
    """Return the graph with a free first pose, for problems whose frame is determined by priors."""
    columns = graph.problem.columns
    poses, tags, calibration = (
        np.where(each >= 0, each + 3, -1) for each in (columns.poses, columns.tags, columns.calibration)
    )
    poses[0] = np.arange(3)
    return replace(graph, problem=replace(graph.problem, columns=Columns(poses, tags, calibration, columns.n + 3)))


def middle_observations(observations: ObservationFactors, n_tags: int) -> IntArray:
    """Return the pose index (T,) of each tag's middle observation."""
    order = np.argsort(observations.tag, kind="stable")
    count = np.bincount(observations.tag, minlength=n_tags)
    middle = order[np.cumsum(count) - count + count // 2]
    return np.asarray(observations.pose[middle])


def columns_of(n_poses: int, n_tags: int, is_free: BoolArray) -> Columns:
    """Return columns of poses in order, then tags, then free calibration parameters; the first pose is fixed."""
    poses = np.arange(-3, 3 * n_poses - 3).reshape(n_poses, 3)
    poses[0] = -1
    first_tag = 3 * n_poses - 3
    tags = first_tag + np.arange(2 * n_tags).reshape(n_tags, 2)
    calibration = np.where(is_free, first_tag + 2 * n_tags + np.cumsum(is_free) - 1, -1)
    return Columns(poses, tags, calibration, first_tag + 2 * n_tags + int(is_free.sum()))


def _odometry_factors(
    segments: Sequence[Segment], first_pose: IntArray, index: Mapping[Parameter, int]
) -> OdometryFactors:
    first, indices, jacobians = [], [], []
    most = max(segment.odometry.jacobian.shape[2] for segment in segments)
    for segment, start in zip(segments, first_pose, strict=True):
        n, jacobian = len(segment.odometry), segment.odometry.jacobian
        first.append(start + np.arange(n))
        own, n_missing = _indices(index, odometry_parameters_of(segment)), most - jacobian.shape[2]
        indices.append(np.tile(np.pad(own, (0, n_missing)), (n, 1)))  # the first parameter is fixed at zero
        jacobians.append(np.pad(jacobian, ((0, 0), (0, 0), (0, n_missing))) if n_missing else jacobian)
    return OdometryFactors(
        first=np.concatenate(first),
        motion=_in_one([segment.odometry.motion for segment in segments]),
        whitening=whitening(_in_one([segment.odometry.covariance for segment in segments])),
        jacobian=_in_one(jacobians),
        parameters=np.concatenate(indices, dtype=np.int32),
    )


def _calibration_prior(segments: Sequence[Segment], index: Mapping[Parameter, int]) -> CalibrationPrior:
    """Return the priors of robot.yaml, and the joint prior from differences between gyro and wheel headings.

    A QR decomposition reduces the heading differences to at most as many rows as there are parameters.
    """
    sigma = np.array([p.sigma for p in index])
    blocks, walks = [np.zeros((0, len(index) + 1))], dict[str, FloatArray]()
    for segment in segments:
        differences = segment.odometry.differences
        if differences is None:
            continue
        at = _indices(index, odometry_parameters_of(segment))
        rows = np.zeros((len(differences.rows), len(index) + 1))
        rows[:, at], rows[:, -1] = differences.rows, differences.values
        walk = np.zeros((len(differences.walk_rows), len(index) + 1))
        walk[:, at] = differences.walk_rows
        blocks.append(rows)
        walks[differences.owner] = walk  # parts of a segment share its bias
    rows = np.concatenate([*blocks, *walks.values()])
    if not len(rows):
        return CalibrationPrior(sigma)
    rows[:, :-1] *= sigma > 0.0
    triangle: FloatArray = np.asarray(np.linalg.qr(rows, mode="r"))[: len(index)]
    return CalibrationPrior(sigma, np.ascontiguousarray(triangle[:, :-1]), np.ascontiguousarray(triangle[:, -1]))


def _observation_factors(
    segments: Sequence[Segment], first_pose: IntArray, tags: Sequence[TagKey], index: Mapping[Parameter, int]
) -> ObservationFactors:
    tag_index = {tag: i for i, tag in enumerate(tags)}
    pose, tag, mount, mount_parameters, scale_parameter, camera_parameters = [], [], [], [], [], []
    for segment, start in zip(segments, first_pose, strict=True):
        observations = segment.observations
        own_tags = np.array([tag_index[t] for t in segment.tags], dtype=np.int64)
        scales = _indices(index, [scale_parameter_of(segment, t) for t in segment.tags])
        pose.append(start + observations.keyframe)
        tag.append(own_tags[observations.tag])
        robot = segment.run.robot
        mount.append(segment.T_base_sensor)
        mounts = [_indices(index, mount_parameters_of(robot, name)) for name in robot.camera_names]
        own_mount = np.array(mounts)[observations.camera]
        mount_parameters.append(np.where(observations.in_camera[:, None], own_mount, 0))
        of_cameras = [_indices(index, each) for each in camera_parameters_of(segment)]
        camera_parameters.append(np.array(of_cameras)[observations.camera])
        scale_parameter.append(scales[observations.tag])
    return ObservationFactors(
        pose=np.concatenate(pose),
        tag=np.concatenate(tag),
        value=_in_one([segment.observations.value for segment in segments]),
        polar=_in_one([segment.observations.polar for segment in segments]),
        whitening=whitening(_in_one([segment.observations.covariance for segment in segments])),
        mount=np.concatenate(mount),
        mount_parameters=np.concatenate(mount_parameters, dtype=np.int32),
        scale_parameter=np.concatenate(scale_parameter, dtype=np.int32),
        by_camera=_in_one([segment.observations.by_camera for segment in segments]),
        camera_parameters=np.concatenate(camera_parameters, dtype=np.int32),
        turning_rad_s=_in_one([segment.observations.turning_rad_s for segment in segments]),
    )


def _in_one(arrays: Sequence[NDArray[_Scalar]]) -> NDArray[_Scalar]:
    """Return arrays in one, since a copy takes much of a drive's memory without one where they follow each other."""
    if len(arrays) == 1 and arrays[0].flags.c_contiguous:
        return arrays[0]
    whole = arrays[0].base
    if isinstance(whole, np.ndarray) and all(_is_part(each, whole) for each in arrays):
        begins = [(_address(each) - _address(whole)) // whole.strides[0] for each in arrays]
        ends = [begin + len(each) for begin, each in zip(begins, arrays, strict=True)]
        if begins[1:] == ends[:-1]:
            return whole[begins[0] : ends[-1]]
    return np.concatenate(arrays)


def _is_part(array: NDArray[_Scalar], whole: NDArray[_Scalar]) -> bool:
    """Return whether an array is some consecutive rows of another."""
    is_like = array.dtype == whole.dtype and array.shape[1:] == whole.shape[1:]
    return array.base is whole and is_like and array.flags.c_contiguous and whole.flags.c_contiguous


def _address(array: NDArray[_Scalar]) -> int:
    return int(array.__array_interface__["data"][0])


def _parameters(segment: Segment) -> list[Parameter]:
    robot, observations = segment.run.robot, segment.observations
    found = odometry_parameters_of(segment) + [scale_parameter_of(segment, tag) for tag in segment.tags]
    for number, (name, of_camera) in enumerate(zip(robot.camera_names, camera_parameters_of(segment), strict=True)):
        found += of_camera
        if (observations.in_camera & (observations.camera == number)).any():
            found += mount_parameters_of(robot, name)
    return [p for p in found if p != NO_PARAMETER]


def _index_of(parameters: Sequence[Parameter]) -> dict[Parameter, int]:
    """Return the index of each parameter; of a fleet there are more than a search for each would be quick in."""
    return {each: i for i, each in enumerate(parameters)}


def _indices(index: Mapping[Parameter, int], wanted: Sequence[Parameter]) -> IntArray:
    return np.array([index.get(each, 0) for each in wanted], dtype=np.int64)
