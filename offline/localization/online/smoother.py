"""A robot's drive in a map as its last pose sees it, kept to the result of a solver by a little work at each call.

What is new is taken at once by the root in front, linearised about where all was believed to be when that root began.
Behind it another root goes through the whole drive once more, a slice at each call, about where all is believed to be
now, and with observations weighed by what they leave over now. When it has caught up it is the new front, poses are
substituted back, the map's tags are judged, and the next one begins. So each round is a step of Gauss-Newton over the
whole drive, as a solver takes it, and the front is off by what the last few metres still bend.
"""

from collections.abc import Generator, Iterator
from typing import Final

import numpy as np

from groundsbot.calib.foundation import FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.calib.robot import Robot
from groundsbot.offline.alignment import TAG_GATE
from groundsbot.offline.localization.map_prior import MapPrior
from groundsbot.offline.localization.online.drive import DriveHistory, TagMeasurement
from groundsbot.offline.localization.online.information_root import SLICE, OnlineRoot
from groundsbot.offline.localization.online.kernels import PresentObservations
from groundsbot.offline.localization.online.moving_frame import pose_among
from groundsbot.offline.localization.online.prior import CalibrationNumbers, OnlinePrior
from groundsbot.offline.localization.online.queries import back_substitute, move, propagate
from groundsbot.offline.localization.online.tag_test import CALLED, TagJudge
from groundsbot.offline.measurements import UNMODELLED_SIGMA_M, TagKey
from groundsbot.offline.sam import Parameter

_POSES_A_SLICE: Final = 256


class Smoother:
    """Poses, tags and calibration of one drive, in the frame of its start or, once that is placed, of the map."""

    def __init__(self, known: MapPrior, robot: Robot, parameters: list[Parameter], numbers: CalibrationNumbers) -> None:
        """Stands at the start."""
        self._known, self._numbers = known, numbers
        self.drive = DriveHistory(robot, parameters)
        self._judge = TagJudge({}, {})
        self.is_placed = False
        self._calibration = numbers.mean.copy()
        self._places: list[FloatArray] = []
        self.front: OnlineRoot | None = self._new_root(None)
        self._work = self._rounds()

    @property
    def map_tags(self) -> dict[int, TagKey]:
        """The map's tag of each that holds the robot, by index."""
        return self._judge.held

    @property
    def places_m(self) -> FloatArray:
        """(T, 2) about where each tag is."""
        return np.array(self._places).reshape(-1, 2)

    @property
    def calibration(self) -> FloatArray:
        """(C,) about what it is."""
        return self._calibration

    def add_motion(self, motion: FloatArray, covariance: FloatArray, by_wheels: FloatArray) -> None:
        """One by the wheels."""
        drive = self.drive
        drive.add_motion(motion, covariance, by_wheels)
        n = len(drive.poses)
        drive.poses[-1] = propagate(drive.poses[-1], drive.motions(n - 2, n - 1), 0, self._calibration)
        self._take_last()

    def add_observation(self, tag: int, observation: TagMeasurement, scale: int, instances: tuple[TagKey, ...]) -> None:
        """Of a tag by its index; the map's tags that it may be."""
        self.drive.add_observation(tag, observation, scale)
        if tag == len(self._places):
            self._add_first_observation(tag, instances)
        self._take_last()

    def _take_last(self) -> None:
        if self.front is not None:
            self.front.take_last(self.drive)
            if self.front.is_determined:
                self.drive.poses[-1] = self._among_places(self.front)

    def _among_places(self, front: OnlineRoot) -> FloatArray:
        """(3,) the pose among the tags where those were when poses were last substituted back."""
        return pose_among(self.places_m, front.places_m, front.pose)

    def work(self) -> None:
        """Some more of the present round."""
        next(self._work)

    def _add_first_observation(self, tag: int, instances: tuple[TagKey, ...]) -> None:
        """A tag comes in where the map foretells it, or where the observation puts it."""
        drive, front = self.drive, self.front
        last = len(drive.keyframe) - 1
        sights = drive.sights(last, last + 1, int(drive.keyframe[last]))
        self._places.append(_place_m(sights, drive.poses[-1], self._calibration))
        if front is not None and self.is_placed:
            for of_map in instances:
                front.add_tag(_place_m(sights, front.point, front.prior.calibration), of_map)
                if front.normalised_innovation_squared(sights, UNMODELLED_SIGMA_M) < TAG_GATE:
                    self.map_tags[tag] = of_map
                    return
                front.drop_last_tag()
        self._judge.maybe[tag] = instances
        if front is not None:
            front.add_tag(_place_m(sights, front.point, front.prior.calibration), None)

    def place(self, T_map_start: FloatArray, held: dict[int, TagKey], maybe: dict[int, tuple[TagKey, ...]]) -> None:
        """Moves everything into the map's frame, in which these tags hold it; the front is there after a round."""
        self.drive.poses[:] = se2.compose(T_map_start, self.drive.poses)
        self._places = list(se2.apply(T_map_start, self.places_m))
        self._judge, self.is_placed, self.front = TagJudge(held, maybe), True, None
        self._work = self._rounds()

    def set_to(self, poses: FloatArray, places_m: FloatArray, calibration: FloatArray, held: dict[int, TagKey]) -> None:
        """All as a solver has it, and one whole round from there."""
        self.drive.poses[:], self._places, self._calibration = poses, list(places_m), calibration
        others = self._judge.maybe | {tag: (each,) for tag, each in self.map_tags.items()}
        self._judge = TagJudge(held, {tag: each for tag, each in others.items() if tag not in held})
        self.is_placed = True
        for _ in self._round(None):
            pass
        self._work = self._rounds()

    def _rounds(self) -> Iterator[None]:
        root = self.front
        while True:
            root = yield from self._round(root)
            yield
            yield from self._substitute_back(root)
            if self.is_placed:
                yield from self._judge.judge(root, len(self.drive.keyframe))

    def _round(self, last: OnlineRoot | None) -> Generator[None, None, OnlineRoot]:
        """Another root, which ends as the front."""
        root = self._new_root(last)
        while True:
            spent = 0
            while root.prior.n_tags < len(self._places) and spent < SLICE:
                root.add_tag(self._places[root.prior.n_tags], self.map_tags.get(root.prior.n_tags))
                spent += 4 * root.prior.n**2 + CALLED
            if root.prior.n_tags == len(self._places):
                root.advance(self.drive)
                if root.is_at_end_of(self.drive):
                    break
            yield
        if np.isfinite(root.step).all():
            self.front = root
        return root

    def _new_root(self, last: OnlineRoot | None) -> OnlineRoot:
        """At the start; what is known beforehand as in the last one, where the same tags hold."""
        prior = OnlinePrior(self._known, self._numbers, self._calibration)
        if last is not None and last.prior.held == {
            tag: each for tag, each in self.map_tags.items() if tag < last.prior.n_tags
        }:
            prior = last.prior.about(self._calibration, self.places_m)
        return OnlineRoot(prior, self.drive.poses[0], held=not self.is_placed)

    def _substitute_back(self, root: OnlineRoot) -> Iterator[None]:
        """Has the points be where the root puts them."""
        following, border, twist = root.step[:3], root.step[3:], root.twist
        self._calibration, self._places[: root.prior.n_tags] = root.calibration, list(root.places_m)
        move(root.point, following, twist, self.drive.poses[root.keyframe])
        n = 0
        for first, rows, points in root.eliminated_slices():
            poses = self.drive.poses[first : first + len(rows)]
            following, n = back_substitute(rows, points, following, border, twist, poses), n + len(rows)
            if n >= _POSES_A_SLICE:
                n = 0
                yield
        yield


def _place_m(sights: PresentObservations, pose: FloatArray, calibration: FloatArray) -> FloatArray:
    """(2,) where the first observation puts its tag; see `sam.ObservationFactors`."""
    numbers = calibration[sights.parameters[0]]
    first, second = sights.value[0] + sights.by_camera[0] @ numbers[4:]
    at = np.array([first * np.cos(second), first * np.sin(second)] if sights.polar[0] else [first, second])
    return se2.apply(se2.compose(pose, sights.mount[0] + numbers[:3]), at * (1.0 + numbers[3]))
