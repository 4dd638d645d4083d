"""A robot in a finished map, one reading at a time: some 0.3 ms each, about 2 ms where a tag is seen first.

Until it knows where in the map it is, the robot makes a small map of its own, in the frame of its start, and looks in
it for tags that lie as the map has them (`online_start`). From then on everything is in the map's frame: each further
tag of the map joins the state where the map foretells it from those that did already, with what is left of the map's
joint covariance. So the map's uncertainty is in each pose, and a tag that comes again is not taken for new information.
"""

from dataclasses import dataclass, replace
from functools import cache
from typing import Final

import numpy as np
from scipy.special import chdtri

from calib.arrays import FloatArray, IntArray
from calib.robot import Robot
from offline.alignment_rivals import GROUP_MARGIN
from offline.errors import OfflineError
from offline.factors import ReadingFactors, whitening
from offline.graph import (
    NO_PARAMETER,
    Parameter,
    mount_parameters_of,
    parameter_of_scale,
    parameters_of_camera,
    parameters_of_wheels,
)
from offline.joint_fit import TAG_GATE, UNMODELLED_SIGMA_M
from offline.known_map import KnownMap, known_map
from offline.located import Located
from offline.merge_report import why_not_joined
from offline.online_drive import Drive, TagReading
from offline.online_filter import OnlineFilter
from offline.online_held import HeldTags
from offline.online_start import SeenTags, Start, StartSearch
from offline.result import MapResult
from offline.run import TagKey

# What a tag's readings differ by from what is foretold, all those of one sighting together, by chance this rarely.
_FALSE_ALARM: Final = 1e-6
# A tag that was moved may be anywhere about.
_ANYWHERE_M: Final = 10.0
_MOST_COUNTED: Final = 200
_DOUBTFUL: Final = "tags that lie elsewhere than the map has them may as well be those that stayed; settle"


@dataclass(frozen=True)
class OnlinePose:
    """Where the robot is now: T_map_base (3,) and its covariance (3, 3), map frame, (x, y, theta)."""

    T_map_base: FloatArray
    covariance: FloatArray


class OnlineLocalizer:
    """Takes motions and tag readings in order of time."""

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
        self._known = known_map(known.components[component], "the map")
        self._robot = robot
        self._parameters = _parameters(robot, self._known)
        self._numbers = self._known.numbers_among(self._parameters)
        self._filter = OnlineFilter(*self._calibration())
        self._wheels = self._indices(parameters_of_wheels(robot))
        self._search = StartSearch(self._known)
        self._index: dict[TagKey, int] = {}  # of each tag seen, by its id
        self._held = HeldTags(self._known, list(self._numbers.values()))
        self._start: Start | None = None
        self._is_located = False
        self._drive = Drive(robot)
        self._surprise: dict[TagKey, tuple[float, int]] = {}
        self._moved: dict[TagKey, TagKey] = {}
        self._doubt = ""
        self._judged: frozenset[TagKey] = frozenset()  # do not hold, and `settle` knew of them

    @property
    def pose(self) -> OnlinePose | None:
        """Where the robot is; None while that is not known or in doubt, and `reason` says why."""
        if self.reason:
            return None
        cos, sin = np.cos(self._filter.pose[2]), np.sin(self._filter.pose[2])
        turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
        return OnlinePose(self._filter.pose.copy(), turn @ self._filter.covariance[:3, :3] @ turn.T)

    @property
    def reason(self) -> str:
        """Why the robot's place is not known; empty when it is."""
        if self._is_located:
            return self._doubt or (_DOUBTFUL if self._is_in_doubt() else "")
        return self._search.reason or "found, and told after the next motion or reading"

    @property
    def moved_tags(self) -> tuple[TagKey, ...]:
        """Tags of the map that hang elsewhere now; they do not hold the robot in the map."""
        return tuple(sorted(self._moved.values())) if self._is_located else ()

    def add_motion(self, motion: FloatArray, covariance: FloatArray, by_wheels: FloatArray) -> OnlinePose | None:
        """A motion by the wheels, as of `ChainOdometry`.

        Args:
            motion: (3,) from the last pose to the next, by nominal calibration.
            covariance: (3, 3) of its right tangent.
            by_wheels: (3, 3) derivative of that tangent by wheel_scale, wheel_ratio and track_scale.
        """
        if self._start is not None and not self._is_located:
            self._begin(self._start)
        self._filter.move(motion, covariance, by_wheels, self._wheels)
        self._drive.add_motion(motion, covariance, by_wheels, self._filter.pose)
        return self.pose

    def add_reading(self, reading: TagReading) -> OnlinePose | None:
        """A tag seen from where the robot is."""
        if not (np.isfinite(reading.value).all() and np.isfinite(reading.covariance).all()):
            raise OfflineError(f"tag {reading.tag_id}: its reading {reading.value.tolist()} holds no numbers")
        tag = TagKey(reading.family, reading.tag_id)
        scale = parameter_of_scale(self._robot, tag)
        if scale in self._parameters:
            if self._start is not None and not self._is_located:
                self._begin(self._start)
            self._drive.add_reading(tag, reading)
            self._take(tag, self._factors(reading, scale))
        return self.pose

    def settle(self) -> OnlinePose | None:
        """Solves all motions and readings so far again, as `localize` does, and goes on from there.

        A filter takes each motion and reading as it looked when it came, and each tag as held or moved when it was seen
        first. Here a tag that does not hold the robot puts all to the question: the drive is placed anew by what all
        its tags say together, and where that is not sure, `pose` is None. This takes as long as it takes to solve the
        drive, some 20 ms for 100 m, and some 200 ms where the question is put: for moments in which there is time.
        """
        if self._is_located and not self._doubt and not self._contradicting():
            self._settle(self._held.own, {}, None)
        if not self._is_located or self._doubt or self._contradicting():
            placed = self._drive.judged(self._known)
            if placed is not None and placed.is_sure:
                self._settle(placed.names(), placed.others(), placed)
            elif self._is_located and placed is not None:
                self._doubt = why_not_joined("the map", "the drive", placed.shared, placed.alignment)
        return self.pose

    def _settle(self, held: dict[TagKey, TagKey], loose: dict[TagKey, TagKey], placed: Located | None) -> None:
        tags = list(self._index)
        held = self._drive.settle(self._filter, self._known, self._parameters, tags, held, loose, placed)
        self._held.set_to(held)
        self._moved = self._moved_of(held)
        self._is_located, self._doubt = True, ""
        self._judged = frozenset(self._contradicting())

    def _contradicting(self) -> list[TagKey]:
        """Tags seen that may be the map's, and do not lie where it has them."""
        return [tag for tag in self._index if tag in self._known.instances and tag not in self._held.own]

    def _is_in_doubt(self) -> bool:
        """Whether the tags that contradict since all was judged may as well be those that stayed.

        As of two groups of tags in `alignment`, one that moved as one and one that stayed.
        """
        others = len(set(self._contradicting()) - self._judged)
        return others > 1 and len(self._held.own) < GROUP_MARGIN * others

    def _take(self, tag: TagKey, factors: ReadingFactors) -> None:
        if tag not in self._index:
            self._first_sight(tag, factors)
        else:
            at = np.array([self._index[tag]])
            factors = _of_tag(factors, at)
            if self._is_held(tag):
                self._check(tag, factors)
            self._filter.read(factors)
        if not self._is_located:
            self._look()  # what it finds comes in with the next motion or reading: that takes its time too
        elif tag in self._index and not self._is_held(tag):
            self._hold_after_all(tag)

    def _first_sight(self, tag: TagKey, factors: ReadingFactors) -> None:
        """A tag joins the state where the map foretells it, or where the reading puts it."""
        if self._is_located:
            for of_map in self._known.instances.get(tag, ()):
                mean, by_state, covariance = self._foretold([of_map])
                index = self._filter.add_tag(mean, by_state, covariance)
                own = _of_tag(factors, np.array([index]))
                if self._filter.surprise(own, UNMODELLED_SIGMA_M) < TAG_GATE:
                    self._index[tag] = index
                    self._held.add([of_map], [tag])
                    self._filter.read(own)
                    return
                self._filter.drop_last_tag()
        self._index[tag] = self._filter.add_seen_tag(factors)
        self._name_moved(tag)

    def _check(self, tag: TagKey, factors: ReadingFactors) -> None:
        """Lets go of a tag whose readings together lie elsewhere: moved by less than a single one tells."""
        square, n = self._surprise.get(tag, (0.0, 0))
        square, n = square + min(self._filter.surprise(factors), 2.0 * TAG_GATE), n + 1
        self._surprise[tag] = (square, n) if n < _MOST_COUNTED else (0.0, 0)
        if n > 1 and square > _most(n):
            self._held.drop(tag)
            self._filter.loosen(self._index[tag], _ANYWHERE_M)
            self._name_moved(tag)

    def _hold_after_all(self, tag: TagKey) -> None:
        """A tag that seemed elsewhere, and lies where the map has it after more readings."""
        if self._surprise.get(tag) is not None:
            return
        for of_map in self._known.instances.get(tag, ()):
            mean, by_state, covariance = self._foretold([of_map])
            columns = self._filter.columns_of([self._index[tag]])
            jacobian = -by_state
            jacobian[:, columns] += np.eye(2)
            off = mean - self._filter.tags[self._index[tag]]
            spread = jacobian @ self._filter.covariance @ jacobian.T + covariance
            spread += UNMODELLED_SIGMA_M**2 * np.eye(2)
            if float(off @ np.linalg.solve(spread, off)) < TAG_GATE:
                self._filter.correct(np.arange(len(self._filter.covariance)), jacobian, off, covariance)
                self._held.add([of_map], [tag])
                self._moved.pop(tag, None)
                return

    def _look(self) -> None:
        """Looks for the start."""
        tags = list(self._index)
        columns = self._filter.columns_of(range(len(tags)))
        covariance = self._filter.covariance[np.ix_(columns, columns)]
        self._start = self._search.look(SeenTags(tuple(tags), self._filter.tags, covariance))

    def _begin(self, start: Start) -> None:
        """Moves all into the map's frame."""
        tags = list(self._index)
        own = [i for i, _ in start.tags]
        of_map = [tag for _, tag in start.tags]
        numbers = self._filter.columns_of([], list(self._numbers))
        by_numbers, spread = self._held.foretold(of_map)
        mean = self._known.mean[self._known.rows(of_map)]
        known_numbers = self._known.calibration.values[list(self._numbers.values())]

        def known() -> tuple[FloatArray, FloatArray]:
            foretold = mean + by_numbers @ (self._filter.calibration[list(self._numbers)] - known_numbers)
            return foretold - self._filter.tags[own].reshape(-1), spread

        jacobian = np.concatenate([np.eye(2 * len(own)), -by_numbers], axis=1)
        self._filter.place(start.T_map_start, np.concatenate([self._filter.columns_of(own), numbers]), jacobian, known)
        self._drive.move_frame(start.T_map_start)
        self._is_located = True
        self._held.add(of_map, [tags[i] for i in own])
        self._moved.clear()
        for tag in tags:
            if not self._is_held(tag):
                self._name_moved(tag)

    def _foretold(self, of_map: list[TagKey]) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Mean (2 k,) of tags of the map by the state, its derivative (2 k, n) by that, and its own covariance."""
        by, covariance = self._held.foretold(of_map)
        held = [self._index[tag] for tag in self._held.own]
        off = self._filter.values_of([], list(self._numbers)) - self._known.calibration.values[self._held.numbers]
        off = np.concatenate([off, (self._filter.tags[held] - self._known.places_m[self._held.places]).reshape(-1)])
        columns = np.concatenate([self._filter.columns_of([], list(self._numbers)), self._filter.columns_of(held)])
        by_state = np.zeros((len(by), len(self._filter.covariance)))
        by_state[:, columns] = by
        return self._known.mean[self._known.rows(of_map)] + by @ off, by_state, covariance

    def _is_held(self, tag: TagKey) -> bool:
        return tag in self._held.own

    def _moved_of(self, held: dict[TagKey, TagKey]) -> dict[TagKey, TagKey]:
        """Tags that may be the map's and are none of those held."""
        instances = {tag: self._known.instances.get(tag, ()) for tag in self._index if tag not in held}
        return {tag: each[0] for tag, each in instances.items() if len(each) == 1}

    def _name_moved(self, tag: TagKey) -> None:
        instances = self._known.instances.get(tag, ())
        if len(instances) == 1:
            self._moved[tag] = instances[0]

    def _calibration(self) -> tuple[FloatArray, FloatArray]:
        """As robot.yaml says, and as the map found it where it did."""
        values, sigmas = np.zeros(len(self._parameters)), np.array([p.sigma for p in self._parameters])
        covariance = np.diag(sigmas**2)
        own, in_map = list(self._numbers), list(self._numbers.values())
        values[own] = self._known.calibration.values[in_map]
        rows = self._known.rows([], in_map)
        covariance[np.ix_(own, own)] = self._known.covariance[np.ix_(rows, rows)]
        return values, covariance

    def _indices(self, wanted: list[Parameter]) -> IntArray:
        return np.array([self._parameters.index(each) for each in wanted], dtype=np.int64)

    def _factors(self, reading: TagReading, scale: Parameter) -> ReadingFactors:
        mount = self._robot.mount
        in_camera, by_camera = reading.in_camera, reading.by_camera
        of_mount = mount_parameters_of(self._robot) if in_camera else [NO_PARAMETER] * 3
        is_told = in_camera and by_camera is not None
        of_camera = parameters_of_camera(self._robot) if is_told else [NO_PARAMETER] * 3
        return ReadingFactors(
            pose=np.zeros(1, dtype=np.int64),
            tag=np.zeros(1, dtype=np.int64),
            value=np.asarray(reading.value, dtype=np.float64)[None],
            polar=np.array([reading.polar]),
            whitening=whitening(np.asarray(reading.covariance, dtype=np.float64)[None]),
            mount=np.array([[mount.x_m, mount.y_m, mount.yaw_rad] if in_camera else [0.0, 0.0, 0.0]]),
            mount_parameters=self._indices(of_mount)[None],
            scale_parameter=self._indices([scale]),
            by_camera=np.zeros((1, 2, 3)) if by_camera is None else np.asarray(by_camera, dtype=np.float64)[None],
            camera_parameters=self._indices(of_camera)[None],
        )


def _parameters(robot: Robot, known: KnownMap) -> list[Parameter]:
    """All that readings of the map's tags, and of others of the same batches, depend on."""
    scales = {parameter_of_scale(robot, tag) for tag in known.tags}
    return [
        NO_PARAMETER,
        *parameters_of_wheels(robot),
        *mount_parameters_of(robot),
        *parameters_of_camera(robot),
        *sorted(scales, key=lambda p: p[:3]),
    ]


def _of_tag(factors: ReadingFactors, tag: IntArray) -> ReadingFactors:
    return replace(factors, tag=tag)


@cache
def _most(n: int) -> float:
    """Squared sigmas that n readings have by chance, but for `_FALSE_ALARM`."""
    return float(chdtri(2 * n, _FALSE_ALARM))
