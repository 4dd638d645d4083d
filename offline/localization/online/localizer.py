"""Localizes a robot in a finished map online, with bounded work for each motion and observation.

Until its pose in the map is known, the robot makes a small map in the frame of its start, and searches for a set of
tags with the same arrangement in the finished map (`online.start_search`). Then everything is transformed into the
map's frame. Each further tag of the map is added with its distribution conditional on those in use, so every pose
covariance includes the map's uncertainty, and repeated observations of a tag are not independent information on the
map. Relinearisation of the drive and tests of its tags continue in slices at each call; keyframes older than a fixed
lag are marginalised (`online.smoother`).
"""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.calib.robot import CAMERA_PARAMETERS, Gyro, Robot
from groundsbot.offline.alignment import GROUP_MARGIN, reason_not_joined
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.localization.map_prior import MapPrior, prior_from_map
from groundsbot.offline.localization.online.drive import DRIVE, GyroDifference, TagMeasurement
from groundsbot.offline.localization.online.prior import CalibrationNumbers
from groundsbot.offline.localization.online.settle import localize_drive, solve_again
from groundsbot.offline.localization.online.smoother import Smoother
from groundsbot.offline.localization.online.start_search import SeenTags, StartSearch
from groundsbot.offline.localization.placement import Located
from groundsbot.offline.maps import MapResult
from groundsbot.offline.measurements import GyroEstimate, TagKey
from groundsbot.offline.sam import (
    NO_PARAMETER,
    Parameter,
    mount_parameters_of,
    parameter_of_scale,
    parameters_of_camera,
    parameters_of_gyro,
    parameters_of_wheels,
)

_WARMING_CALLS: Final = 10  # two rounds
_DOUBTFUL: Final = "the tags that contradict the map may be the unmoved ones, so the pose is in doubt; call settle()"
_PENDING: Final = "the start was found; the pose is available after some more motions or observations"


@dataclass(frozen=True)
class OnlinePose:
    """The present pose of the robot.

    Attributes:
        T_map_base: (3,) x_m, y_m, theta_rad.
        covariance: (3, 3) in the map frame, of (x, y, theta).
    """

    T_map_base: FloatArray
    covariance: FloatArray

    def __repr__(self) -> str:
        x_m, y_m, theta_rad = self.T_map_base
        return f"<OnlinePose x {x_m:.3f} m, y {y_m:.3f} m, {theta_rad:.4f} rad>"


class OnlineLocalizer:
    """An online localizer, to which motions and tag observations are added in order of time."""

    def __init__(self, known: MapResult, robot: Robot, component: int = 0, *, has_gyro: bool = False) -> None:
        """Begin a drive at an unknown pose.

        Args:
            known: the map, from `read_map` or `build_map`.
            robot: robot with the wheels, the mount and the tag sizes.
            component: index of the map's component, whose frame is used.
            has_gyro: whether motions may be fused with the robot's gyro.

        Raises:
            OfflineError: there is no such component, or it has values that are not finite.
        """
        if not 0 <= component < len(known.components):
            most = len(known.components) - 1
            raise OfflineError(f"component {component}: the map has no such component; give 0 to {most}")
        self._known = prior_from_map(known.components[component], "the map")
        self._robot = robot
        self._parameters = _parameters(robot, self._known, has_gyro=has_gyro)
        self._scales = {parameter: i for i, parameter in enumerate(self._parameters)}
        self._numbers = numbers = _numbers(self._parameters, self._known)
        self._smoother = Smoother(self._known, robot, self._parameters, numbers)
        _warm_up(
            Smoother(self._known, robot, self._parameters, numbers), self._known, self._scales, robot.camera_names[0]
        )
        self._search = StartSearch(self._known)
        self._index: dict[TagKey, int] = {}  # of each observed tag
        self._doubt = ""
        self._known_mismatches: frozenset[TagKey] = frozenset()  # as of the last `settle`

    @property
    def pose(self) -> OnlinePose | None:
        """The present pose; None while it is not known or in doubt, with the reason in `reason`."""
        front = self._smoother.front
        if self.reason or front is None:
            return None
        pose = front.pose
        cos, sin = np.cos(pose[2]), np.sin(pose[2])
        rotation = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
        return OnlinePose(pose, rotation @ front.pose_covariance() @ rotation.T)

    @property
    def reason(self) -> str:
        """Why the robot's pose is not known; empty where it is."""
        if not self._smoother.is_placed:
            return self._search.reason
        if self._smoother.front is None or not self._smoother.front.is_determined:
            return _PENDING
        return self._doubt or (_DOUBTFUL if self._is_in_doubt() else "")

    def gyro_estimate(self) -> GyroEstimate | None:
        """Return the estimated calibration of wheels and gyro, by which motions are fused; None without a gyro."""
        parameters = [*parameters_of_wheels(self._robot), *parameters_of_gyro(self._robot, DRIVE, 1)]
        index = {parameter: i for i, parameter in enumerate(self._parameters)}
        front = self._smoother.front
        if parameters[-1] not in index:
            return None
        at = [index[each] for each in parameters]
        values = self._smoother.calibration[at]
        covariance = self._numbers.covariance[np.ix_(at, at)]
        if front is not None:
            values, covariance = front.calibration[at], front.calibration_covariance(np.array(at))
        return GyroEstimate(self._robot.gyro or Gyro(), values, covariance)

    @property
    def moved_tags(self) -> tuple[TagKey, ...]:
        """Tags of the map that moved since it was made; they do not constrain the pose."""
        if not self._smoother.is_placed:
            return ()
        instances = [self._known.instances[tag] for tag in self._mismatches()]
        return tuple(sorted(each[0] for each in instances if len(each) == 1))

    def add_motion(
        self,
        motion: FloatArray,
        covariance: FloatArray,
        by_odometry: FloatArray,
        difference: GyroDifference | None = None,
    ) -> OnlinePose | None:
        """Add a motion as `segments_of` returns them, and return the new pose.

        Args:
            motion: (3,) from the last pose to the next, by nominal calibration.
            covariance: (3, 3) of its right tangent.
            by_odometry: (3, 3) derivative of that tangent with respect to wheel_scale, wheel_ratio and track_scale. For
                a motion fused with a gyro (3, 6): then gyro_scale, gyro_time_offset_s and the bias in rad/s.
            difference: between gyro and wheels, for a motion fused with a gyro.
        """
        self._smoother.add_motion(motion, covariance, by_odometry, difference)
        self._smoother.work()
        return self.pose

    def add_observation(self, observation: TagMeasurement) -> OnlinePose | None:
        """Add an observation of a tag from the present pose, and return the new pose.

        Raises:
            OfflineError: a value or covariance is not finite, or the robot has no such camera.
        """
        if observation.in_camera and observation.camera not in self._robot.camera_names:
            names = ", ".join(map(repr, self._robot.camera_names))
            raise OfflineError(
                f"tag {observation.tag_id}: the robot has no camera {observation.camera!r}; its cameras are {names}"
            )
        if not (np.isfinite(observation.value).all() and np.isfinite(observation.covariance).all()):
            raise OfflineError(
                f"tag {observation.tag_id}: its observation {observation.value.tolist()} or the covariance is not "
                "finite; leave it out"
            )
        tag = TagKey(observation.family, observation.tag_id)
        scale = parameter_of_scale(self._robot, tag)
        if scale in self._scales:
            index = self._index.setdefault(tag, len(self._index))
            self._smoother.add_observation(index, observation, self._scales[scale], self._known.instances.get(tag, ()))
            if self._smoother.is_placed:
                self._smoother.work()
            else:
                self._search_start()
        return self.pose

    def settle(self) -> OnlinePose | None:
        """Solve the drive again, as `localize` does, and continue from the solution.

        Of a long drive these are the keyframes that the smoother has not marginalised: the last 2048 or somewhat more.

        The solution differs from the online estimate only in the last few metres, unless tags contradict the map. Then
        the drive is aligned with the map again by all its tags, and `pose` is None where that alignment is not certain.
        The time is that of a batch solve: about 20 ms for 100 m, and 200 ms with an alignment.
        """
        smoother = self._smoother
        if smoother.is_placed and not self._doubt and not self._mismatches():
            self._settle(None)
        if not smoother.is_placed or self._doubt or self._mismatches():
            placed = localize_drive(smoother, self._index, self._known)
            if placed is not None and placed.is_certain:
                self._settle(placed)
            elif smoother.is_placed and placed is not None:
                self._doubt = reason_not_joined("the map", "the drive", placed.shared, placed.alignment)
        return self.pose

    def _settle(self, placed: Located | None) -> None:
        solve_again(self._smoother, self._index, self._parameters, self._known, placed)
        self._doubt = ""
        self._known_mismatches = frozenset(self._mismatches())

    def _mismatches(self) -> list[TagKey]:
        """Return the observed tags that may be in the map, and do not have its prior."""
        held = self._smoother.map_tags
        return [tag for tag, index in self._index.items() if tag in self._known.instances and index not in held]

    def _is_in_doubt(self) -> bool:
        """Whether the tags that contradict the map since the last `settle` may be the unmoved ones.

        The criterion is that of `alignment.pairwise` for two groups of tags, of which one moved as a whole.
        """
        others = len(set(self._mismatches()) - self._known_mismatches)
        return others > 1 and len(self._smoother.map_tags) < GROUP_MARGIN * others

    def _search_start(self) -> None:
        """Continue the search for the start."""
        front, tags = self._smoother.front, list(self._index)
        if front is None:
            return
        start = self._search.search(SeenTags(tuple(tags), front.places_m, front.tags_covariance()))
        if start is not None:
            held = dict(start.tags)
            maybe = {i: self._known.instances.get(tag, ()) for tag, i in self._index.items() if i not in held}
            self._smoother.place(start.T_map_start, held, maybe)


def _warm_up(smoother: Smoother, known: MapPrior, scales: dict[Parameter, int], camera: str) -> None:
    """Call all compiled functions once on a made-up drive, so that no later call waits for compilation."""
    if not known.tags:
        return
    of_map, scale = known.tags[0], max(scales.values())
    smoother.add_motion(np.array([0.1, 0.0, 0.0]), 1e-4 * np.eye(3), np.eye(3), None)
    value, by_camera = np.array([1.0, 0.0]), np.zeros((2, len(CAMERA_PARAMETERS)))
    of_first = TagMeasurement(of_map.family, of_map.tag_id, value, 1e-2 * np.eye(2), by_camera)
    observation = replace(of_first, camera=camera)
    smoother.add_observation(0, observation, scale, (of_map,))
    smoother.place(np.zeros(3), {0: of_map}, {})
    for _ in smoother.marginalise(1):
        pass
    for _ in range(_WARMING_CALLS):
        smoother.add_observation(0, observation, scale, (of_map,))
        smoother.work()
    if smoother.front is not None:
        smoother.front.pose_covariance()


def _numbers(parameters: list[Parameter], known: MapPrior) -> CalibrationNumbers:
    """Return the prior on the calibration: the map's where it has a parameter, else that of robot.yaml."""
    in_known = known.numbers_among(parameters)
    mean, covariance = np.zeros(len(parameters)), np.diag([p.sigma**2 for p in parameters])
    own, in_map = list(in_known), list(in_known.values())
    rows: IntArray = np.full(len(parameters), -1, dtype=np.int64)
    rows[own] = known.rows([], in_map)
    mean[own] = known.calibration.values[in_map]
    covariance[np.ix_(own, own)] = known.covariance[np.ix_(rows[own], rows[own])]
    free = np.diag(covariance) > 0.0
    return CalibrationNumbers(mean, covariance, np.where(free, np.cumsum(free) - 1, -1), rows)


def _parameters_of_camera(robot: Robot, camera: str) -> list[Parameter]:
    """Return the parameters of a camera; the one that all have in common is among those of the first only."""
    found = [*mount_parameters_of(robot, camera), *parameters_of_camera(robot, camera)]
    first = robot.camera_names[0]
    return found if camera == first else [each for each in found if each not in parameters_of_camera(robot, first)]


def _parameters(robot: Robot, known: MapPrior, *, has_gyro: bool) -> list[Parameter]:
    """Return all parameters that observations of the map's tags, and of other tags of their batches, depend on."""
    scales = {parameter_of_scale(robot, tag) for tag in known.tags}
    return [
        NO_PARAMETER,
        *parameters_of_wheels(robot),
        *(parameters_of_gyro(robot, DRIVE, 1) if has_gyro else []),
        *(each for camera in robot.camera_names for each in _parameters_of_camera(robot, camera)),
        *sorted(scales, key=lambda p: p[:3]),
    ]
