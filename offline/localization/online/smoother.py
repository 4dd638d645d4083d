"""An incremental smoother of a drive in a map, with bounded work for each motion and observation.

New measurements are added at once to the front root, which is linearised about the estimate at the time the root was
begun. Behind it another root processes the whole drive again, a slice at each call, about the present estimate and with
weights by the present residuals. When it has caught up it becomes the front, poses are substituted back, the map's tags
are tested, and the next root is begun. Each such round is a Gauss-Newton step over the whole drive, as a solver takes
it, so the result differs from the solver's only by the nonlinearity of the last few metres.

Poses older than a fixed lag are marginalised between two rounds, so that memory and the time of a round are bounded.
"""

from collections.abc import Generator, Iterator
from typing import Final

import numpy as np

from groundsbot.calib.foundation import FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.calib.robot import Robot
from groundsbot.offline.alignment import TAG_GATE
from groundsbot.offline.localization.map_prior import MapPrior
from groundsbot.offline.localization.online.drive import DriveHistory, GyroDifference, TagMeasurement
from groundsbot.offline.localization.online.information_root import SLICE, OnlineRoot
from groundsbot.offline.localization.online.kernels import PresentObservations
from groundsbot.offline.localization.online.marginal import Marginal
from groundsbot.offline.localization.online.moving_frame import pose_among
from groundsbot.offline.localization.online.prior import CalibrationNumbers, OnlinePrior
from groundsbot.offline.localization.online.queries import back_substitute, move, propagate
from groundsbot.offline.localization.online.tag_test import CALLED, TagTest
from groundsbot.offline.measurements import UNMODELLED_SIGMA_M, TagKey
from groundsbot.offline.sam import Parameter

_POSES_A_SLICE: Final = 256
# Keyframes that are linearised again in each round; at ten a second, those of the last three minutes.
_LAG: Final = 2048
_LEAST_MARGINALISED: Final = 256  # keyframes at once


class Smoother:
    """Poses, tags and calibration of one drive, in the frame of its start until `place`, and of the map from then on.

    Attributes:
        drive: motions, observations and present poses.
        is_placed: whether the frame is the map's.
        front: the root that contains all measurements; None until the first round after `place`.
    """

    def __init__(self, known: MapPrior, robot: Robot, parameters: list[Parameter], numbers: CalibrationNumbers) -> None:
        """Begin at the start of a drive.

        Args:
            known: the map.
            robot: that drives.
            parameters: parameters of calibration.
            numbers: the prior on them.
        """
        self._known, self._numbers = known, numbers
        self.drive = DriveHistory(robot, parameters)
        self._tag_test = TagTest({}, {})
        self.is_placed = False
        self._calibration = numbers.mean.copy()
        self._places: list[FloatArray] = []
        self._before: Marginal | None = None  # of the keyframes that the drive has forgotten
        self.front: OnlineRoot | None = self._new_root(None)
        self._work = self._rounds()

    @property
    def map_tags(self) -> dict[int, TagKey]:
        """The map's tag for each tag with the map's prior, by index."""
        return self._tag_test.held

    @property
    def places_m(self) -> FloatArray:
        """(T, 2) present linearisation points of the tags."""
        return np.array(self._places).reshape(-1, 2)

    @property
    def calibration(self) -> FloatArray:
        """(C,) present linearisation point of the calibration."""
        return self._calibration

    def add_motion(
        self, motion: FloatArray, covariance: FloatArray, by_odometry: FloatArray, difference: GyroDifference | None
    ) -> None:
        """Add a motion; the arguments are those of `DriveHistory.add_motion`."""
        drive = self.drive
        drive.add_motion(motion, covariance, by_odometry, difference)
        n = len(drive.poses)
        drive.poses[-1] = propagate(drive.poses[-1], drive.motions(n - 2, n - 1), 0, self._calibration)
        self._add_last()

    def add_observation(self, tag: int, observation: TagMeasurement, scale: int, instances: tuple[TagKey, ...]) -> None:
        """Add an observation.

        Args:
            tag: index of the tag.
            observation: observation of the tag.
            scale: index of the parameter that scales the tag's size.
            instances: the map's tags that it may be.
        """
        self.drive.add_observation(tag, observation, scale)
        if tag == len(self._places):
            self._add_first_observation(tag, instances)
        self._add_last()

    def _add_last(self) -> None:
        if self.front is not None:
            self.front.add_last(self.drive)
            if self.front.is_determined:
                self.drive.poses[-1] = self._among_places(self.front)

    def _among_places(self, front: OnlineRoot) -> FloatArray:
        """Return (3,) the front's pose relative to the present linearisation points of the tags near it."""
        return pose_among(self.places_m, front.places_m, front.pose, self.drive.poses[-1])

    def work(self) -> None:
        """Process a slice of the present round."""
        next(self._work)

    def _add_first_observation(self, tag: int, instances: tuple[TagKey, ...]) -> None:
        """Add a new tag, with the map's prior if the observation agrees with it, else at the observed position."""
        drive, front = self.drive, self.front
        last = len(drive.keyframe) - 1
        observations = drive.observations(last, last + 1, int(drive.keyframe[last]))
        self._places.append(_place_m(observations, drive.poses[-1], self._calibration))
        if front is not None and self.is_placed:
            for of_map in instances:
                front.add_tag(_place_m(observations, front.point, front.prior.calibration), of_map)
                if front.normalised_innovation_squared(observations, UNMODELLED_SIGMA_M) < TAG_GATE:
                    self.map_tags[tag] = of_map
                    return
                front.drop_last_tag()
        self._tag_test.maybe[tag] = instances
        if front is not None:
            front.add_tag(_place_m(observations, front.point, front.prior.calibration), None)

    def place(self, T_map_start: FloatArray, held: dict[int, TagKey], maybe: dict[int, tuple[TagKey, ...]]) -> None:
        """Transform the drive into the map's frame; `front` is None until the next round ends.

        Args:
            T_map_start: (3,) the start in the map.
            held: the map's tag for each tag with the map's prior, by index.
            maybe: the map's tags that each other tag may be, by index.
        """
        self.drive.poses[:] = se2.compose(T_map_start, self.drive.poses)
        self._places = list(se2.apply(T_map_start, self.places_m))
        self._tag_test, self.is_placed, self.front = TagTest(held, maybe), True, None
        self._work = self._rounds()

    def set_to(self, poses: FloatArray, places_m: FloatArray, calibration: FloatArray, held: dict[int, TagKey]) -> None:
        """Set the state to a solver's solution, and process one whole round from there.

        Args:
            poses: (K, 3)
            places_m: (T, 2)
            calibration: (C,)
            held: the map's tag for each tag with the map's prior, by index.
        """
        self.drive.poses[:], self._places, self._calibration = poses, list(places_m), calibration
        others = self._tag_test.maybe | {tag: (each,) for tag, each in self.map_tags.items()}
        self._tag_test = TagTest(held, {tag: each for tag, each in others.items() if tag not in held})
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
            root.discard_rows()
            if self.is_placed:
                yield from self._tag_test.update(root, self.drive.n_observed)
            n_old = len(self.drive.poses) - _LAG
            if n_old >= _LEAST_MARGINALISED:
                yield from self.marginalise(n_old)

    def _round(self, last: OnlineRoot | None) -> Generator[None, None, OnlineRoot]:
        """Process the whole drive with a new root, in slices, and make it the front."""
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
        """Return a root without measurements; it reuses the prior of the last one where the held tags are the same."""
        prior = OnlinePrior(self._known, self._numbers, self._calibration)
        if last is not None and last.prior.held == {
            tag: each for tag, each in self.map_tags.items() if tag < last.prior.n_tags
        }:
            prior = last.prior.about(self._calibration, self.places_m)
        return self._root_about(prior, held=not self.is_placed)

    def _root_about(self, prior: OnlinePrior, *, held: bool) -> OnlineRoot:
        """Return a root with the measurements that the drive has forgotten."""
        point, before = self.drive.poses[0], None
        if self._before is not None:
            before = self._before.about(point, self._calibration, self.places_m, self._numbers.columns)
        return OnlineRoot(prior, point, held=held, before=before)

    def marginalise(self, n: int) -> Iterator[None]:
        """Marginalise the first n keyframes, in slices, and forget them."""
        flat = OnlinePrior(self._known, self._numbers, self._calibration, is_flat=True)
        root = self._root_about(flat, held=False)
        root.discard_rows()
        for place_m in self._places:
            root.add_tag(place_m, None)
        n_observations = int(np.searchsorted(self.drive.keyframe, n, side="right"))
        while root.keyframe < n or root.n_observations < n_observations:
            yield
            root.advance(self.drive, n)
        marginal = root.marginal()
        if self.front is not None and np.isfinite(marginal.rows).all():
            self._before = marginal
            self.front.renumber(n, self.drive.forget(n))

    def _substitute_back(self, root: OnlineRoot) -> Iterator[None]:
        """Set the linearisation points to the estimates of a root, in slices."""
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


def _place_m(observations: PresentObservations, pose: FloatArray, calibration: FloatArray) -> FloatArray:
    """Return (2,) the position of a tag by its first observation; see `sam.ObservationFactors`."""
    numbers = calibration[observations.parameters[0]]
    first, second = observations.value[0] + observations.by_camera[0] @ numbers[4:]
    at = np.array([first * np.cos(second), first * np.sin(second)] if observations.polar[0] else [first, second])
    return se2.apply(se2.compose(pose, observations.mount[0] + numbers[:3]), at * (1.0 + numbers[3]))
