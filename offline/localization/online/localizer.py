"""A robot in a finished map, one observation at a time, each answered after a bounded piece of work.

Until it knows where in the map it is, the robot makes a small map of its own, in the frame of its start, and looks in
it for tags that lie as the map has them (`online.start_search`). From then on everything is in the map's frame: each
further tag of the map joins where the map foretells it from those that did already, with what is left of the map's
joint covariance. So the map's uncertainty is in each pose, and a tag that comes again is not taken for new information.
The whole drive is linearised anew and its tags judged anew all the while, a little at each call (`online.smoother`).
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.calib.robot import CAMERA_PARAMETERS, Robot
from groundsbot.offline.alignment import GROUP_MARGIN, reason_not_joined
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.localization.map_prior import MapPrior, prior_from_map
from groundsbot.offline.localization.online.drive import TagMeasurement
from groundsbot.offline.localization.online.prior import CalibrationNumbers
from groundsbot.offline.localization.online.settle import localize_drive, solve_again
from groundsbot.offline.localization.online.smoother import Smoother
from groundsbot.offline.localization.online.start_search import SeenTags, StartSearch
from groundsbot.offline.localization.placement import Located
from groundsbot.offline.maps import MapResult
from groundsbot.offline.measurements import TagKey
from groundsbot.offline.sam import (
    NO_PARAMETER,
    Parameter,
    mount_parameters_of,
    parameter_of_scale,
    parameters_of_camera,
    parameters_of_wheels,
)

_WARMING_CALLS: Final = 10  # two rounds
_DOUBTFUL: Final = "tags that lie elsewhere than the map has them may as well be those that stayed; settle"
_TO_BE_TOLD: Final = "found, and told after some more motions or observations"


@dataclass(frozen=True)
class OnlinePose:
    """Where the robot is now: T_map_base (3,) and its covariance (3, 3), map frame, (x, y, theta)."""

    T_map_base: FloatArray
    covariance: FloatArray


class OnlineLocalizer:
    """Takes motions and tag observations in order of time."""

    def __init__(self, known: MapResult, robot: Robot, component: int = 0) -> None:
        """Knows nothing yet of where the robot is.

        Args:
            known: of `read_map` or `build_map`.
            robot: whose wheels, mount and tag sizes they are.
            component: of the map; its frame is used.

        Raises:
            OfflineError: there is no such component, or its numbers are none.
        """
        if not 0 <= component < len(known.components):
            raise OfflineError(f"component {component}: the map has {len(known.components)}")
        self._known = prior_from_map(known.components[component], "the map")
        self._robot = robot
        self._parameters = _parameters(robot, self._known)
        self._scales = {parameter: i for i, parameter in enumerate(self._parameters)}
        numbers = _numbers(self._parameters, self._known)
        self._smoother = Smoother(self._known, robot, self._parameters, numbers)
        _warm_up(Smoother(self._known, robot, self._parameters, numbers), self._known, self._scales)
        self._search = StartSearch(self._known)
        self._index: dict[TagKey, int] = {}  # of each tag seen, by its id
        self._doubt = ""
        self._judged: frozenset[TagKey] = frozenset()  # do not hold, and `settle` knew of them

    @property
    def pose(self) -> OnlinePose | None:
        """Where the robot is; None while that is not known or in doubt, and `reason` says why."""
        front = self._smoother.front
        if self.reason or front is None:
            return None
        pose = front.pose
        cos, sin = np.cos(pose[2]), np.sin(pose[2])
        turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
        return OnlinePose(pose, turn @ front.pose_covariance() @ turn.T)

    @property
    def reason(self) -> str:
        """Why the robot's place is not known; empty when it is."""
        if not self._smoother.is_placed:
            return self._search.reason
        if self._smoother.front is None or not self._smoother.front.is_determined:
            return _TO_BE_TOLD
        return self._doubt or (_DOUBTFUL if self._is_in_doubt() else "")

    @property
    def moved_tags(self) -> tuple[TagKey, ...]:
        """Tags of the map that hang elsewhere now; they do not hold the robot in the map."""
        if not self._smoother.is_placed:
            return ()
        instances = [self._known.instances[tag] for tag in self._contradicting()]
        return tuple(sorted(each[0] for each in instances if len(each) == 1))

    def add_motion(self, motion: FloatArray, covariance: FloatArray, by_wheels: FloatArray) -> OnlinePose | None:
        """A motion by the wheels, as of `SegmentOdometry`.

        Args:
            motion: (3,) from the last pose to the next, by nominal calibration.
            covariance: (3, 3) of its right tangent.
            by_wheels: (3, 3) derivative of that tangent by wheel_scale, wheel_ratio and track_scale.
        """
        self._smoother.add_motion(motion, covariance, by_wheels)
        self._smoother.work()
        return self.pose

    def add_observation(self, observation: TagMeasurement) -> OnlinePose | None:
        """A tag seen from where the robot is."""
        if not (np.isfinite(observation.value).all() and np.isfinite(observation.covariance).all()):
            raise OfflineError(
                f"tag {observation.tag_id}: its observation {observation.value.tolist()} holds no numbers"
            )
        tag = TagKey(observation.family, observation.tag_id)
        scale = parameter_of_scale(self._robot, tag)
        if scale in self._scales:
            index = self._index.setdefault(tag, len(self._index))
            self._smoother.add_observation(index, observation, self._scales[scale], self._known.instances.get(tag, ()))
            if self._smoother.is_placed:
                self._smoother.work()
            else:
                self._look()
        return self.pose

    def settle(self) -> OnlinePose | None:
        """Solves all motions and observations so far again, as `localize` does, and goes on from there.

        What is done at each call comes to the same but for the last few metres. Here a tag that does not hold the robot
        puts all to the question: the drive is placed anew by what all its tags say together, and where that is not
        sure, `pose` is None. This takes as long as it takes to solve the drive, some 20 ms for 100 m, and some 200 ms
        where the question is put: for moments in which there is time.
        """
        smoother = self._smoother
        if smoother.is_placed and not self._doubt and not self._contradicting():
            self._settle(None)
        if not smoother.is_placed or self._doubt or self._contradicting():
            placed = localize_drive(smoother, self._index, self._known)
            if placed is not None and placed.is_sure:
                self._settle(placed)
            elif smoother.is_placed and placed is not None:
                self._doubt = reason_not_joined("the map", "the drive", placed.shared, placed.alignment)
        return self.pose

    def _settle(self, placed: Located | None) -> None:
        solve_again(self._smoother, self._index, self._parameters, self._known, placed)
        self._doubt = ""
        self._judged = frozenset(self._contradicting())

    def _contradicting(self) -> list[TagKey]:
        """Tags seen that may be the map's, and do not lie where it has them."""
        held = self._smoother.map_tags
        return [tag for tag, index in self._index.items() if tag in self._known.instances and index not in held]

    def _is_in_doubt(self) -> bool:
        """Whether the tags that contradict since all was judged may as well be those that stayed.

        As of two groups of tags in `alignment.pairwise`, one that moved as one and one that stayed.
        """
        others = len(set(self._contradicting()) - self._judged)
        return others > 1 and len(self._smoother.map_tags) < GROUP_MARGIN * others

    def _look(self) -> None:
        """Looks for the start."""
        front, tags = self._smoother.front, list(self._index)
        if front is None:
            return
        start = self._search.search(SeenTags(tuple(tags), front.places_m, front.tags_covariance()))
        if start is not None:
            held = dict(start.tags)
            maybe = {i: self._known.instances.get(tag, ()) for tag, i in self._index.items() if i not in held}
            self._smoother.place(start.T_map_start, held, maybe)


def _warm_up(smoother: Smoother, known: MapPrior, scales: dict[Parameter, int]) -> None:
    """Calls all that is compiled once, in a drive that nobody drives: compiling or loading takes its time."""
    if not known.tags:
        return
    of_map, scale = known.tags[0], max(scales.values())
    smoother.add_motion(np.array([0.1, 0.0, 0.0]), 1e-4 * np.eye(3), np.eye(3))
    value, by_camera = np.array([1.0, 0.0]), np.zeros((2, len(CAMERA_PARAMETERS)))
    observation = TagMeasurement(of_map.family, of_map.tag_id, value, 1e-2 * np.eye(2), by_camera)
    smoother.add_observation(0, observation, scale, (of_map,))
    smoother.place(np.zeros(3), {0: of_map}, {})
    for _ in range(_WARMING_CALLS):
        smoother.add_observation(0, observation, scale, (of_map,))
        smoother.work()
    if smoother.front is not None:
        smoother.front.pose_covariance()


def _numbers(parameters: list[Parameter], known: MapPrior) -> CalibrationNumbers:
    """As robot.yaml says, and as the map found it where it did."""
    in_known = known.numbers_among(parameters)
    mean, covariance = np.zeros(len(parameters)), np.diag([p.sigma**2 for p in parameters])
    own, in_map = list(in_known), list(in_known.values())
    rows: IntArray = np.full(len(parameters), -1, dtype=np.int64)
    rows[own] = known.rows([], in_map)
    mean[own] = known.calibration.values[in_map]
    covariance[np.ix_(own, own)] = known.covariance[np.ix_(rows[own], rows[own])]
    free = np.diag(covariance) > 0.0
    return CalibrationNumbers(mean, covariance, np.where(free, np.cumsum(free) - 1, -1), rows)


def _parameters(robot: Robot, known: MapPrior) -> list[Parameter]:
    """All that observations of the map's tags, and of others of the same batches, depend on."""
    scales = {parameter_of_scale(robot, tag) for tag in known.tags}
    return [
        NO_PARAMETER,
        *parameters_of_wheels(robot),
        *mount_parameters_of(robot),
        *parameters_of_camera(robot),
        *sorted(scales, key=lambda p: p[:3]),
    ]
