"""A Gaussian over the robot's pose, its calibration and the tags seen so far, in square root information form.

All factors are linearised about fixed points, poses perturbed on the right: observations and motions can be taken in
any order of slices, and the sum of all is exactly the step that a solver would take from these points (Bierman,
"Factorization Methods for Discrete Sequential Estimation", 1977; Kaess, Ranganathan and Dellaert, "iSAM: Incremental
smoothing and mapping", 2008). A motion costs as many operations as there are numbers in the border (calibration and
tags), an observation their square.
"""

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from groundsbot.calib.foundation import FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.localization.online.drive import DriveHistory
from groundsbot.offline.localization.online.kernels import BY_POINTS, Border, Motions, PresentObservations, sweep
from groundsbot.offline.localization.online.moving_frame import (
    BorderPrior,
    minimise_on_arcs,
    pose_among,
    rotate_step,
    twist_of,
)
from groundsbot.offline.localization.online.prior import OnlinePrior, pad
from groundsbot.offline.localization.online.queries import (
    carry_rows,
    huber_weight,
    leave_one_out_test,
    move,
    predict,
    propagate,
    through,
)
from groundsbot.offline.measurements import UNMODELLED_SIGMA_M, TagKey
from groundsbot.offline.sam import HUBER_THRESHOLD, Values

_DIAGONAL: Final = np.arange(3), np.arange(3)
# Of a start that is the frame: far below what anything is known to, and far above rounding.
_HELD_SIGMA: Final = 1e-6
_MOST_MOTIONS: Final = 128  # in one slice
# Multiplications in one slice: some 0.4 ms.
SLICE: Final = 600_000
# Costs that are worked out for one step: warm, most steps take one or two.
_LEAST_COSTS: Final = 2
_MOST_COSTS: Final = 24


class LeaveOneOut(NamedTuple):
    """A tag of the map whose place there does not count: all else moves by `by_shift` (3 + n, 2) times its shift.

    Attributes:
        at: its first column in the border.
        shift_m: (2,) from where the map has it, and covariance (2, 2).
    """

    at: int
    by_shift: FloatArray
    shift_m: FloatArray
    covariance: FloatArray


class OnlineRoot:
    """What motions and observations up to some keyframe say.

    Attributes:
        prior: of the border, and the points of that.
        point: (3,) that of the present pose.
        keyframe: of that; n_observations: taken.
    """

    def __init__(self, prior: OnlinePrior, start: FloatArray, *, held: bool) -> None:
        """Knows what is known beforehand.

        Args:
            prior: grows with this root.
            start: (3,) first pose, about which it is linearised.
            held: whether that is the frame.
        """
        self.prior, self.point = prior, start.copy()
        self.keyframe, self.n_observations = 0, 0
        n, room = prior.n, prior.room
        self._pose, self._root, self._right = np.zeros((3, 4 + room)), np.zeros((room, room)), np.zeros(room)
        self._root[:n, :n], self._right[:n] = prior.root, prior.root @ prior.off
        if held:
            self._pose[:, :3] = np.eye(3) / _HELD_SIGMA
            self._pose[:, 3] = -se2.log(start) / _HELD_SIGMA
        self._at_tags = np.array([prior.first_tag])
        self._left: list[tuple[FloatArray, FloatArray]] = []
        self._relaxed = np.zeros(n)  # of the last step: where the next one is looked for
        self._step: FloatArray | None = None

    # What it holds.

    @property
    def step(self) -> FloatArray:
        """(3 + n,) of pose and border, from the points, in the drive's own frame; see `online.moving_frame`."""
        if self._step is None:
            n = self.prior.n
            z = np.zeros(n)
            if self.prior.held:
                z[: len(self._relaxed)] = self._relaxed
                most = min(max(SLICE // (6 * n**2 + 1), _LEAST_COSTS), _MOST_COSTS)
                self._relaxed = z = minimise_on_arcs(self._border, self._prior, z, most)
            self._step = self.through(np.concatenate([self._pose[:, 3], self._right[:n] + z]))
        return self._step

    @property
    def offsets(self) -> FloatArray:
        """(n,) of the border, from its points in the map."""
        return rotate_step(self._prior, self.step[3:], self.prior.first_tag)

    @property
    def twist(self) -> FloatArray:
        """(5,) of the tags' mean motion in the step: turn, motion, and their middle."""
        return twist_of(self._prior, self.step[3:], self.prior.first_tag)

    @property
    def is_determined(self) -> bool:
        """Whether anything tells where the pose is."""
        return bool((self._pose[_DIAGONAL] != 0.0).all())

    @property
    def pose(self) -> FloatArray:
        """(3,) x_m, y_m, theta_rad."""
        found = np.empty(3)
        move(self.point, self.step, self.twist, found)
        return found

    @property
    def calibration(self) -> FloatArray:
        """(C,) numbers."""
        found, columns = self.prior.calibration.copy(), self.prior.columns
        found[columns >= 0] += self.step[3 + columns[columns >= 0]]
        return found

    @property
    def places_m(self) -> FloatArray:
        """(T, 2) of the tags."""
        return self.prior.places_m + self.offsets[self.prior.first_tag :].reshape(-1, 2)

    def pose_covariance(self) -> FloatArray:
        """(3, 3) perturbed on the right."""
        return self.variance_of(np.eye(3, 3 + self.prior.n))

    def tags_covariance(self) -> FloatArray:
        """(2 T, 2 T) of the tags."""
        return self.variance_of(np.eye(2 * self.prior.n_tags, 3 + self.prior.n, 3 + self.prior.first_tag))

    def variance_of(self, rows: FloatArray) -> FloatArray:
        """(m, m) of rows (m, 3 + n) times pose and border."""
        root = self.carry(rows)
        return root @ root.T

    def carry(self, rows: FloatArray) -> FloatArray:
        """(m, 3 + n) whose square is that."""
        return carry_rows(self._border, self._pose, rows, self.prior.n)

    def through(self, right: FloatArray) -> FloatArray:
        """(3 + n,) by pose and border, of a right-hand side."""
        return through(self._border, self._pose, right, self.prior.n)

    @property
    def _border(self) -> Border:
        return Border(self._root, self._right, self.prior.columns, self._at_tags)

    @property
    def _prior(self) -> BorderPrior:
        prior = self.prior
        return BorderPrior(*prior.whole)

    # Tags.

    def add_tag(self, place_m: FloatArray, of_map: TagKey | None) -> None:
        """One more tag, linearised about a place; where the map has it, or of which nothing is known yet."""
        n = self.prior.n
        rows = self.prior.add(place_m, of_map)
        room = self.prior.room
        if room > len(self._root):
            self._root, self._right = pad(self._root, (room, room)), pad(self._right, (room,))
            self._pose = pad(self._pose, (3, 4 + room))
        self._root[n : n + 2, : n + 2], self._right[n : n + 2] = rows, rows @ self.prior.off
        self._pose[:, 4 + n : 6 + n] = 0.0
        self._step = None

    def drop_last_tag(self) -> None:
        """Forgets the tag that was added last, before anything of it is read."""
        self.prior.drop_last()
        self._relaxed = self._relaxed[: self.prior.n]
        self._step = None

    def squared_distance(self, tag: int) -> float:
        """Squared sigmas of a tag that holds the robot against all else, 1 cm in each coordinate allowed for."""
        prior, at = self.prior, self.prior.first_tag + 2 * tag
        off = self.offsets - prior.off
        return leave_one_out_test(self._border, self._pose, self._prior.root, off, prior.n, at, UNMODELLED_SIGMA_M**2)

    def leave_one_out(self, tag: int) -> LeaveOneOut:
        """What comes of all if one tag that holds the robot did not: its shift is one more unknown."""
        prior, at = self.prior, self.prior.first_tag + 2 * tag
        ways = prior.root[:, at : at + 2].T @ prior.root  # of the prior's information
        taken = self.carry(np.concatenate([np.zeros((2, 3)), ways], axis=1))
        checked = ways[:, at : at + 2] - taken @ taken.T
        covariance = np.asarray(np.linalg.pinv(checked, rcond=1e-9, hermitian=True), dtype=np.float64)
        by_shift = np.column_stack([self.through(each.copy()) for each in taken])
        return LeaveOneOut(at, by_shift, covariance @ ways @ (self.offsets - prior.off), covariance)

    def free_squares(self, free: Sequence[tuple[int, TagKey]], lifted: LeaveOneOut | None = None) -> float:
        """Likewise of tags that do not hold the robot, against where the map has them; as if another did not."""
        prior = self.prior
        tags, of_map = [tag for tag, _ in free], [each for _, each in free]
        by, covariance = prior.by_others(*of_map)
        ways = np.concatenate([np.zeros((len(by), 3)), -by], axis=1)
        at = 3 + prior.first_tag + (2 * np.array(tags)[:, None] + np.arange(2)).reshape(-1)
        ways[np.arange(len(by)), at] += 1.0
        spread = self.variance_of(ways) + covariance + UNMODELLED_SIGMA_M**2 * np.eye(len(by))
        moved = self.offsets
        off_m = (prior.places_m.reshape(-1) + moved[prior.first_tag :])[at - 3 - prior.first_tag]
        off_m -= prior.predict_m(by, moved, *of_map)
        if lifted is not None:
            by_shift = ways @ lifted.by_shift + by[:, lifted.at : lifted.at + 2]
            off_m = off_m + by_shift @ lifted.shift_m
            spread += by_shift @ lifted.covariance @ by_shift.T
        return float(off_m @ np.linalg.solve(spread, off_m))

    # Motions and observations.

    def is_at_end_of(self, drive: DriveHistory) -> bool:
        """Whether all motions and observations are taken."""
        return self.keyframe == len(drive.poses) - 1 and self.n_observations == len(drive.keyframe)

    def advance(self, drive: DriveHistory) -> None:
        """Add a slice of the drive's motions and observations, weighted by their residuals at its poses."""
        keyframes, last = drive.keyframe, len(drive.poses) - 1
        until = min(len(keyframes), self.n_observations + max(1, SLICE // (4 * self.prior.n**2 + 1)))
        end = int(keyframes[until]) if until < len(keyframes) else last
        end = min(end, self.keyframe + _MOST_MOTIONS)
        until = min(until, int(np.searchsorted(keyframes, end, side="right")))
        sights = drive.sights(self.n_observations, until, self.keyframe)
        points = np.concatenate([self.point[None], drive.poses[self.keyframe + 1 : end + 1]])
        self._take(drive, points, sights, np.full(until - self.n_observations, BY_POINTS))

    def take_last(self, drive: DriveHistory) -> None:
        """Takes what came last, one motion or one observation, all else being taken; weighed by what it leaves over."""
        end, until = len(drive.poses) - 1, len(drive.keyframe)
        points = self.point[None]
        if end > self.keyframe:
            points = np.stack([self.point, self._next_point(drive.motions(self.keyframe, end))])
        sights = drive.sights(self.n_observations, until, self.keyframe)
        self._take(drive, points, sights, np.array([self._weight(sights)] if until > self.n_observations else []))

    def _next_point(self, motion: Motions) -> FloatArray:
        """(3,) the point of the next pose: among its points as the estimate lies among its own."""
        pose = propagate(self.pose, motion, 0, self.calibration)
        return pose_among(self.prior.places_m, self.places_m, pose)

    def normalised_innovation_squared(self, sights: PresentObservations, unmodelled_m: float) -> float:
        """Squared sigmas of the first observation from what is foretold, its tag being off by as much besides."""
        residual, rows, by_tag = self._predict(sights)
        spread = self.variance_of(rows) + np.eye(2) + unmodelled_m**2 * by_tag @ by_tag.T
        return float(residual @ np.linalg.solve(spread, residual))

    def _weight(self, sights: PresentObservations) -> float:
        at = self.prior.first_tag + 2 * int(sights.tag[0])
        if not (self.is_determined and self._root[at, at] > 0.0 and self._root[at + 1, at + 1] > 0.0):
            return 1.0  # nothing tells of its tag yet
        residual, rows, _ = self._predict(sights)
        return huber_weight(residual, self.variance_of(rows), HUBER_THRESHOLD)

    def _predict(self, sights: PresentObservations) -> tuple[FloatArray, FloatArray, FloatArray]:
        return predict(self._border, self.prior.n, sights, self._values(self.point[None]), self.step)

    def _values(self, poses: FloatArray) -> Values:
        return Values(poses, self.prior.places_m, self.prior.calibration)

    def _take(self, drive: DriveHistory, points: FloatArray, sights: PresentObservations, weights: FloatArray) -> None:
        n, end = self.prior.n, self.keyframe + len(points) - 1
        left = np.empty((end - self.keyframe, 3, 7 + n))
        motions, values = drive.motions(self.keyframe, end), self._values(points)
        sweep(self._border, self._pose, n, motions, sights, weights, values, HUBER_THRESHOLD, left)
        if len(left):
            self._left.append((left, points[:-1]))
        self.point = points[-1].copy()
        self.keyframe, self.n_observations, self._step = end, self.n_observations + len(weights), None

    def eliminated_slices(self) -> list[tuple[int, FloatArray, FloatArray]]:
        """Poses that were left, in slices from the last to the first: first index, rows and points of `substituted`."""
        found, first = [], self.keyframe
        for rows, points in reversed(self._left):
            first -= len(rows)
            found.append((first, rows, points))
        return found
