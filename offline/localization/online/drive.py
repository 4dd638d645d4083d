"""Stores the motions and observations of an online drive, as factors for a sweep and as a segment for a batch solve."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import cos, sin
from typing import Any, Final

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.calib.robot import CAMERA_PARAMETERS, WHEEL_PARAMETERS, Gyro, Robot
from groundsbot.offline.local_map import run_without_log, segment_from_arrays
from groundsbot.offline.localization.online.kernels import Motions, PresentObservations
from groundsbot.offline.measurements import HeadingDifferences, Segment, TagKey
from groundsbot.offline.sam import (
    NO_PARAMETER,
    Parameter,
    mount_parameters_of,
    parameters_of_camera,
    parameters_of_gyro,
    parameters_of_wheels,
    whitening,
)

DRIVE: Final = "the drive"  # its name
# The bias of a gyro is let walk in steps of this time, since each is as much work as an observation.
_WALK_PERIOD_S: Final = 5.0
_ROOM: Final = 1024


@dataclass(frozen=True)
class TagMeasurement:
    """One observation of a tag.

    Attributes:
        family, tag_id: of the tag.
        value: (2,) range_m and bearing_rad, positive to the left; or x_m and y_m.
        covariance: (2, 2) of the value.
        by_camera: (2, 5) its derivative with respect to `calib.robot.CAMERA_PARAMETERS`; None where not known.
        polar: whether the value is (range, bearing).
        in_camera: whether the value is in the camera's planar frame (position and yaw of the mount), not in base.
        camera: its name in `Robot.camera_names`, which is empty for a robot with one camera.
    """

    family: str
    tag_id: int
    value: FloatArray
    covariance: FloatArray
    by_camera: FloatArray | None = None
    polar: bool = True
    in_camera: bool = True
    camera: str = ""

    def __repr__(self) -> str:
        return f"<TagMeasurement {self.family}:{self.tag_id} at {tuple(self.value.tolist())}>"


@dataclass(frozen=True)
class GyroDifference:
    """The turn by a gyro less that by the wheels, of one motion that was fused with the gyro.

    Attributes:
        row: (6,) derivative with respect to WHEEL_PARAMETERS, GYRO_PARAMETERS and the gyro's bias, over its sigma.
        value: the difference under nominal calibration, over its sigma.
        duration_s: duration of the motion.
    """

    row: FloatArray
    value: float
    duration_s: float


class GrowingArrays:
    """Named arrays that grow by rows, with doubling capacity; copying those of an hour's drive takes below 1 ms."""

    def __init__(self, **columns: tuple[tuple[int, ...], type]) -> None:
        """Begin without rows; `columns` gives the shape and type of a row in each array."""
        self.n = 0
        self._columns: dict[str, Any] = {
            name: np.empty((_ROOM, *shape), kind) for name, (shape, kind) in columns.items()
        }

    def append(self, **row: Any) -> None:  # noqa: ANN401 (what a column takes)
        """Append one row."""
        if self.n == len(next(iter(self._columns.values()))):
            self._columns = {name: np.concatenate([each, np.empty_like(each)]) for name, each in self._columns.items()}
        for name, value in row.items():
            self._columns[name][self.n] = value
        self.n += 1

    def drop_first(self, n: int) -> None:
        """Remove the first n rows."""
        self.n -= n
        for name, each in self._columns.items():
            self._columns[name][: self.n] = each[n : n + self.n].copy()

    def __getitem__(self, name: str) -> Any:  # noqa: ANN401 (of the column's type)
        """Return a view of a column."""
        return self._columns[name][: self.n]


class DriveHistory:
    """Motions, observations and present pose estimates of a drive, in order of time.

    Attributes:
        n_observed: number of all observations so far, with those that were forgotten.
    """

    def __init__(self, robot: Robot, parameters: Sequence[Parameter]) -> None:
        """Begin with one pose at the identity.

        Args:
            robot: robot with the mount.
            parameters: calibration parameters, which factors refer to by index; with those of a gyro, motions may be
                fused with one.
        """
        self._robot = robot
        index = {parameter: i for i, parameter in enumerate(parameters)}
        of_gyro = [each for each in parameters_of_gyro(robot, DRIVE, 1) if each in index]
        self._of_odometry = [index[each] for each in (*parameters_of_wheels(robot), *of_gyro)]
        self._bias_walk = (robot.gyro or Gyro()).bias_walk_rad_s_per_sqrt_s ** 2 if of_gyro else 0.0
        self._walked_s = 0.0  # since the bias last changed
        self._names = list(robot.camera_names)
        self._of_mount = {name: [index[each] for each in mount_parameters_of(robot, name)] for name in self._names}
        self._of_camera = {name: [index[each] for each in parameters_of_camera(robot, name)] for name in self._names}
        mounts = {name: robot.with_camera(name).mount for name in self._names}
        self._mounts = {name: (each.x_m, each.y_m, each.yaw_rad) for name, each in mounts.items()}
        self._none = index[NO_PARAMETER]
        self.n_observed = 0
        square, n_camera, n = ((3, 3), float), len(CAMERA_PARAMETERS), len(self._of_odometry)
        self._motions = GrowingArrays(
            motion=((5,), float), covariance=square, whitening=square, jacobian=((3, n), float), parameters=((n,), int),
            difference=((n + 1,), float), bias_walk=((), float),
        )  # fmt: skip
        self._poses = GrowingArrays(T=((3,), float))
        self._poses.append(T=np.zeros(3))
        self._observations = GrowingArrays(
            keyframe=((), int), tag=((), int), value=((2,), float), covariance=((2, 2), float), polar=((), bool),
            in_camera=((), bool), camera=((), int), whitening=((2, 2), float), mount=((3,), float),
            by_camera=((2, n_camera), float), parameters=((4 + n_camera,), int),
        )  # fmt: skip

    @property
    def poses(self) -> FloatArray:
        """(K, 3) present estimates of the keyframes' poses, where factors are linearised; a writable view."""
        poses: FloatArray = self._poses["T"]
        return poses

    @property
    def keyframe(self) -> IntArray:
        """(R,) the keyframe of each observation."""
        keyframe: IntArray = self._observations["keyframe"]
        return keyframe

    @property
    def tag(self) -> IntArray:
        """(R,) the index of the tag of each observation."""
        tag: IntArray = self._observations["tag"]
        return tag

    def add_motion(
        self, motion: FloatArray, covariance: FloatArray, by_odometry: FloatArray, difference: GyroDifference | None
    ) -> None:
        """Append a motion; its pose in `poses` is a copy of the one before, to be set by the caller.

        Args:
            motion: (3,) pose of the base (m, m, rad) in the frame of the last one.
            covariance: (3, 3) of its right tangent.
            by_odometry: (3, 3) derivative of that tangent with respect to WHEEL_PARAMETERS; (3, 6) with a gyro, whose
                GYRO_PARAMETERS and bias follow.
            difference: difference between gyro and wheels; None if the motion was not fused with a gyro.
        """
        x, y, theta = np.asarray(motion).tolist()
        jacobian, row = np.zeros((3, len(self._of_odometry))), np.zeros(len(self._of_odometry) + 1)
        jacobian[:, : by_odometry.shape[1]] = by_odometry
        bias_walk = 0.0
        if difference is not None:
            row[:-1], row[-1] = difference.row, difference.value
            self._walked_s += difference.duration_s
            if self._walked_s >= _WALK_PERIOD_S:
                bias_walk, self._walked_s = self._bias_walk * self._walked_s, 0.0
        self._motions.append(
            motion=(x, y, theta, cos(theta), sin(theta)),
            covariance=covariance,
            whitening=whitening(np.asarray(covariance)),
            jacobian=jacobian,
            parameters=self._of_odometry,
            difference=row,
            bias_walk=bias_walk,
        )
        self._poses.append(T=self._poses["T"][-1])

    def add_observation(self, tag: int, observation: TagMeasurement, scale: int) -> None:
        """Append an observation from the last pose.

        Args:
            tag: index of the tag.
            observation: observation of the tag.
            scale: index of the parameter that scales the tag's size.
        """
        in_camera, name = observation.in_camera, observation.camera
        of_mount = self._of_mount[name] if in_camera else [self._none] * 3
        has_derivative = in_camera and observation.by_camera is not None
        of_camera = self._of_camera[name] if has_derivative else [self._none] * len(CAMERA_PARAMETERS)
        self._observations.append(
            keyframe=self._poses.n - 1,
            tag=tag,
            value=observation.value,
            covariance=observation.covariance,
            polar=observation.polar,
            in_camera=in_camera,
            camera=self._names.index(name) if in_camera else 0,
            whitening=whitening(np.asarray(observation.covariance, dtype=np.float64)),
            mount=self._mounts[name] if in_camera else 0.0,
            by_camera=0.0 if observation.by_camera is None else observation.by_camera,
            parameters=[*of_mount, scale, *of_camera],
        )
        self.n_observed += 1

    def forget(self, keyframe: int) -> int:
        """Forget the motions to a keyframe, the poses before it, and the observations up to it.

        The keyframe becomes the first one.

        Returns:
            The number of observations that were forgotten.
        """
        n = int(np.searchsorted(self.keyframe, keyframe, side="right"))
        self._poses.drop_first(keyframe)
        self._motions.drop_first(keyframe)
        self._observations.drop_first(n)
        self._observations["keyframe"][:] -= keyframe
        return n

    def motions(self, begin: int, end: int) -> Motions:
        """Return the motions from keyframe `begin` to keyframe `end`."""
        return Motions(*(self._motions[name][begin:end] for name in Motions._fields))

    def observations(self, begin: int, end: int, keyframe: int) -> PresentObservations:
        """Return observations `begin` to `end` - 1, their keyframes as offsets from `keyframe`."""
        table = self._observations
        return PresentObservations(
            table["keyframe"][begin:end] - keyframe,
            *(table[name][begin:end] for name in PresentObservations._fields[1:]),
        )

    def segment(self, tags: Mapping[TagKey, int]) -> Segment:
        """Return the drive as a segment, as from a log; `tags` gives the index of each observed tag."""
        ordered = tuple(sorted(tags))
        place = np.empty(max(tags.values(), default=-1) + 1, dtype=np.int64)
        place[[tags[tag] for tag in ordered]] = np.arange(len(tags))
        motions, observations = self._motions, self._observations
        segment = segment_from_arrays(
            run_without_log(DRIVE, self._robot, ordered),
            np.arange(self._poses.n),
            (motions["motion"][:, :3], motions["covariance"], motions["jacobian"]),
            ordered,
            observations["keyframe"],
            place[observations["tag"]],
            observations["value"],
            observations["covariance"],
            observations["by_camera"],
            observations["polar"],
            observations["in_camera"],
            camera=observations["camera"],
        )
        differences = self._differences()
        return replace(segment, odometry=replace(segment.odometry, differences=differences))

    def _differences(self) -> HeadingDifferences | None:
        """Return the differences between gyro and wheels, with one bias for the whole segment; None without a gyro."""
        rows = self._motions["difference"]
        n = rows.shape[1] - 1
        if n == len(WHEEL_PARAMETERS):
            return None
        step = np.flatnonzero(rows.any(axis=1))
        return HeadingDifferences(step, rows[step, :-1], rows[step, -1], np.zeros((0, n)), DRIVE)
