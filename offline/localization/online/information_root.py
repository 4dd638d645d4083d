"""A Gaussian of the robot's pose, its calibration and the observed tags in square-root information form.

All factors are linearised about fixed points, with poses perturbed on the right. Motions and observations can be added
in slices of any length, and the result is exactly the step that a solver would take from these points (Bierman,
"Factorization Methods for Discrete Sequential Estimation", 1977; Kaess, Ranganathan and Dellaert, "iSAM: Incremental
smoothing and mapping", 2008). The cost of a motion is linear in the length of the border (calibration and tags), that
of an observation quadratic.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.localization.online.drive import DriveHistory
from groundsbot.offline.localization.online.kernels import (
    BY_POINTS,
    Border,
    Motions,
    PresentObservations,
    add_rows,
    sweep,
)
from groundsbot.offline.localization.online.marginal import Marginal
from groundsbot.offline.localization.online.moving_frame import (
    BorderPrior,
    minimise_on_arcs,
    pose_among,
    rotate_step,
    twist_of,
)
from groundsbot.offline.localization.online.prior import OnlinePrior, pad
from groundsbot.offline.localization.online.queries import (
    LeaveOneOut,
    huber_weight,
    leave_one_out_test,
    move,
    predict,
    propagate,
    solve_root,
    whiten_rows,
)
from groundsbot.offline.measurements import UNMODELLED_SIGMA_M, TagKey
from groundsbot.offline.sam import HUBER_THRESHOLD, Values

_DIAGONAL: Final = np.arange(3), np.arange(3)
# Sigma of a start pose that defines the frame: far below that of anything estimated, and far above rounding.
_HELD_SIGMA: Final = 1e-6
_MOST_MOTIONS: Final = 128  # in one slice
# Multiplications in one slice, which take about 0.4 ms.
SLICE: Final = 600_000
# Limits on evaluations of the cost for one step; from a warm start, most steps take one or two.
_LEAST_COSTS: Final = 2
_MOST_COSTS: Final = 24


class OnlineRoot:
    """The square-root information of a drive up to some keyframe.

    Attributes:
        prior: prior of the border, with its linearisation points.
        point: (3,) linearisation point of the present pose.
        keyframe: index of the keyframe of the present pose.
        n_observations: number of observations that were added.
    """

    def __init__(self, prior: OnlinePrior, start: FloatArray, *, held: bool, before: FloatArray | None = None) -> None:
        """Begin with the prior alone.

        Args:
            prior: prior of the border; tags are added to it.
            start: (3,) linearisation point of the first pose.
            held: whether the first pose is fixed there.
            before: rows of the measurements before the first pose, from `Marginal.about` for the linearisation points
                of `start` and `prior`; `advance` adds them first.
        """
        self.prior, self.point = prior, start.copy()
        self._before = np.zeros((0, 4)) if before is None else before
        self.keyframe, self.n_observations = 0, 0
        n, room = prior.n, prior.room
        self._pose, self._root, self._right = np.zeros((3, 4 + room)), np.zeros((room, room)), np.zeros(room)
        self._root[:n, :n], self._right[:n] = prior.root, prior.root @ prior.off
        if held:
            self._pose[:, :3] = np.eye(3) / _HELD_SIGMA
            self._pose[:, 3] = -se2.log(start) / _HELD_SIGMA
        self._at_tags = np.array([prior.first_tag])
        self._eliminated: list[tuple[FloatArray, FloatArray]] = []
        self._keeps_rows = True
        self._warm_start = np.zeros(n)  # z of the last step, see `minimise_on_arcs`
        self._step: FloatArray | None = None

    @property
    def step(self) -> FloatArray:
        """(3 + n,) step of pose and border from the linearisation points, in the frame of `online.moving_frame`."""
        if self._step is None:
            n = self.prior.n
            z = np.zeros(n)
            if self.prior.held:
                z[: len(self._warm_start)] = self._warm_start
                most = min(max(SLICE // (6 * n**2 + 1), _LEAST_COSTS), _MOST_COSTS)
                self._warm_start = z = minimise_on_arcs(self._border, self._prior, z, most)
            self._step = self.solve_root(np.concatenate([self._pose[:, 3], self._right[:n] + z]))
        return self._step

    @property
    def offsets(self) -> FloatArray:
        """(n,) offset of calibration and tags (m, map axes) from their linearisation points."""
        return rotate_step(self._prior, self.step[3:], self.prior.first_tag)

    @property
    def twist(self) -> FloatArray:
        """(5,) common twist of the tags in the step (rotation, translation), and their centre."""
        return twist_of(self._prior, self.step[3:], self.prior.first_tag)

    @property
    def is_determined(self) -> bool:
        """Whether the information determines the pose."""
        return bool((self._pose[_DIAGONAL] != 0.0).all())

    @property
    def pose(self) -> FloatArray:
        """(3,) x_m, y_m, theta_rad."""
        pose = np.empty(3)
        move(self.point, self.step, self.twist, pose)
        return pose

    @property
    def calibration(self) -> FloatArray:
        """(C,) estimated calibration."""
        calibration, columns = self.prior.calibration.copy(), self.prior.columns
        calibration[columns >= 0] += self.step[3 + columns[columns >= 0]]
        return calibration

    @property
    def places_m(self) -> FloatArray:
        """(T, 2) estimated positions of the tags."""
        return self.prior.places_m + self.offsets[self.prior.first_tag :].reshape(-1, 2)

    def pose_covariance(self) -> FloatArray:
        """Return (3, 3) the covariance of the pose's right tangent."""
        return self.variance_of(np.eye(3, 3 + self.prior.n))

    def calibration_covariance(self, parameters: IntArray) -> FloatArray:
        """Return (m, m) the covariance of calibration parameters given by index; zero where fixed."""
        columns = self.prior.columns[parameters]
        rows = np.zeros((len(parameters), 3 + self.prior.n))
        free = np.flatnonzero(columns >= 0)
        rows[free, 3 + columns[free]] = 1.0
        return self.variance_of(rows)

    def tags_covariance(self) -> FloatArray:
        """Return (2 T, 2 T) the joint covariance of the tags."""
        return self.variance_of(np.eye(2 * self.prior.n_tags, 3 + self.prior.n, 3 + self.prior.first_tag))

    def variance_of(self, rows: FloatArray) -> FloatArray:
        """Return (m, m) the covariance of rows (m, 3 + n) times pose and border."""
        root = self.whiten(rows)
        return root @ root.T

    def whiten(self, rows: FloatArray) -> FloatArray:
        """Return Y (m, 3 + n) such that Y Y^T is the covariance of rows times pose and border."""
        return whiten_rows(self._border, self._pose, rows, self.prior.n)

    def solve_root(self, right: FloatArray) -> FloatArray:
        """Return (3 + n,) the solution of the triangular system for a right-hand side (3 + n,)."""
        return solve_root(self._border, self._pose, right, self.prior.n)

    @property
    def _border(self) -> Border:
        return Border(self._root, self._right, self.prior.columns, self._at_tags)

    @property
    def _prior(self) -> BorderPrior:
        return BorderPrior(*self.prior.whole)

    def add_tag(self, place_m: FloatArray, of_map: TagKey | None) -> None:
        """Add a tag.

        Args:
            place_m: (2,) its linearisation point.
            of_map: the map's tag; None where it has no prior.
        """
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
        """Remove the tag that was added last, before any observation of it is added."""
        self.prior.drop_last()
        self._warm_start = self._warm_start[: self.prior.n]
        self._step = None

    def squared_distance(self, tag: int) -> float:
        """Return the squared sigmas of a held tag's shift against all other measurements.

        The variance of the shift includes `UNMODELLED_SIGMA_M` in each coordinate.
        """
        prior, at = self.prior, self.prior.first_tag + 2 * tag
        off = self.offsets - prior.off
        return leave_one_out_test(self._border, self._pose, self._prior.root, off, prior.n, at, UNMODELLED_SIGMA_M**2)

    def leave_one_out(self, tag: int) -> LeaveOneOut:
        """Return the effect of removing the map's prior from one held tag, whose shift becomes an unknown."""
        prior, at = self.prior, self.prior.first_tag + 2 * tag
        rows = prior.root[:, at : at + 2].T @ prior.root  # the tag's rows of the prior's information
        whitened = self.whiten(np.concatenate([np.zeros((2, 3)), rows], axis=1))
        residual_information = rows[:, at : at + 2] - whitened @ whitened.T
        covariance = np.asarray(np.linalg.pinv(residual_information, rcond=1e-9, hermitian=True), dtype=np.float64)
        by_shift = np.column_stack([self.solve_root(each.copy()) for each in whitened])
        return LeaveOneOut(at, by_shift, covariance @ rows @ (self.offsets - prior.off), covariance)

    def loose_squared_distance(self, loose: Sequence[tuple[int, TagKey]], without: LeaveOneOut | None = None) -> float:
        """Return the squared Mahalanobis distance of all loose tags together from their predictions by the map.

        Args:
            loose: index of each tag that has no prior from the map, with the map's tag to compare it with.
            without: one tag whose prior from the map is left out, as in a leave-one-out test; None to use all priors.
        """
        prior = self.prior
        tags, of_map = [tag for tag, _ in loose], [each for _, each in loose]
        by, covariance = prior.by_others(*of_map)
        rows = np.concatenate([np.zeros((len(by), 3)), -by], axis=1)
        at = 3 + prior.first_tag + (2 * np.array(tags)[:, None] + np.arange(2)).reshape(-1)
        rows[np.arange(len(by)), at] += 1.0
        covariance = self.variance_of(rows) + covariance + UNMODELLED_SIGMA_M**2 * np.eye(len(by))
        moved = self.offsets
        offset_m = (prior.places_m.reshape(-1) + moved[prior.first_tag :])[at - 3 - prior.first_tag]
        offset_m -= prior.predict_m(by, moved, *of_map)
        if without is not None:
            by_shift = rows @ without.by_shift + by[:, without.at : without.at + 2]
            offset_m = offset_m + by_shift @ without.shift_m
            covariance += by_shift @ without.covariance @ by_shift.T
        return float(offset_m @ np.linalg.solve(covariance, offset_m))

    def is_at_end_of(self, drive: DriveHistory) -> bool:
        """Whether all motions and observations were added."""
        is_begun = not len(self._before)
        return is_begun and self.keyframe == len(drive.poses) - 1 and self.n_observations == len(drive.keyframe)

    def advance(self, drive: DriveHistory, last: int | None = None) -> None:
        """Add a slice of the drive's motions and observations, weighted by their residuals at its poses.

        Args:
            drive: to be added.
            last: keyframe to end at, with its observations; the last one where None.
        """
        if len(self._before):
            most = max(1, SLICE // (3 * self.prior.n**2 + 1))
            add_rows(self._border, self._pose, self.prior.n, self._before[:most])
            self._before, self._step = self._before[most:], None
            return
        keyframes, last = drive.keyframe, len(drive.poses) - 1 if last is None else last
        until = min(len(keyframes), self.n_observations + max(1, SLICE // (4 * self.prior.n**2 + 1)))
        end = int(keyframes[until]) if until < len(keyframes) else last
        end = min(end, self.keyframe + _MOST_MOTIONS, last)
        until = min(until, int(np.searchsorted(keyframes, end, side="right")))
        observations = drive.observations(self.n_observations, until, self.keyframe)
        points = np.concatenate([self.point[None], drive.poses[self.keyframe + 1 : end + 1]])
        self._add(drive, points, observations, np.full(until - self.n_observations, BY_POINTS))

    def add_last(self, drive: DriveHistory) -> None:
        """Add the last motion or observation, after all others; the weight is by the residual after the update."""
        end, until = len(drive.poses) - 1, len(drive.keyframe)
        points = self.point[None]
        if end > self.keyframe:
            points = np.stack([self.point, self._next_point(drive.motions(self.keyframe, end))])
        observations = drive.observations(self.n_observations, until, self.keyframe)
        self._add(
            drive, points, observations, np.array([self._weight(observations)] if until > self.n_observations else [])
        )

    def _next_point(self, motion: Motions) -> FloatArray:
        """Return (3,) the linearisation point of the next pose: its estimate, moved back with the tags near it."""
        pose = propagate(self.pose, motion, 0, self.calibration)
        point = propagate(self.point, motion, 0, self.prior.calibration)
        return pose_among(self.prior.places_m, self.places_m, pose, point)

    def normalised_innovation_squared(self, observations: PresentObservations, unmodelled_m: float) -> float:
        """Return the normalised innovation squared of the first observation.

        Args:
            observations: of which the first is tested.
            unmodelled_m: additional sigma of each coordinate of its tag.
        """
        innovation, rows, by_tag = self._predict(observations)
        covariance = self.variance_of(rows) + np.eye(2) + unmodelled_m**2 * by_tag @ by_tag.T
        return float(innovation @ np.linalg.solve(covariance, innovation))

    def _weight(self, observations: PresentObservations) -> float:
        at = self.prior.first_tag + 2 * int(observations.tag[0])
        if not (self.is_determined and self._root[at, at] > 0.0 and self._root[at + 1, at + 1] > 0.0):
            return 1.0  # without information on its tag or the pose there is no prediction
        innovation, rows, _ = self._predict(observations)
        return huber_weight(innovation, self.variance_of(rows), HUBER_THRESHOLD)

    def _predict(self, observations: PresentObservations) -> tuple[FloatArray, FloatArray, FloatArray]:
        return predict(self._border, self.prior.n, observations, self._values(self.point[None]), self.step)

    def _values(self, poses: FloatArray) -> Values:
        return Values(poses, self.prior.places_m, self.prior.calibration)

    def _add(
        self, drive: DriveHistory, points: FloatArray, observations: PresentObservations, weights: FloatArray
    ) -> None:
        n, end = self.prior.n, self.keyframe + len(points) - 1
        eliminated = np.empty((end - self.keyframe, 3, 7 + n))
        motions, values = drive.motions(self.keyframe, end), self._values(points)
        sweep(self._border, self._pose, n, motions, observations, weights, values, HUBER_THRESHOLD, eliminated)
        if len(eliminated) and self._keeps_rows:
            self._eliminated.append((eliminated, points[:-1]))
        self.point = points[-1].copy()
        self.keyframe, self.n_observations, self._step = end, self.n_observations + len(weights), None

    def eliminated_slices(self) -> list[tuple[int, FloatArray, FloatArray]]:
        """Return slices of eliminated poses, from the last to the first.

        Each has the index of its first pose, and the rows and linearisation points for `back_substitute`.
        """
        slices, first = [], self.keyframe
        for rows, points in reversed(self._eliminated):
            first -= len(rows)
            slices.append((first, rows, points))
        return slices

    def discard_rows(self) -> None:
        """Forget the rows of eliminated poses, and store none from now on."""
        self._eliminated, self._keeps_rows = [], False

    def marginal(self) -> Marginal:
        """Return the measurements that were added, without the eliminated poses; the prior must be flat."""
        n = self.prior.n
        rows = np.zeros((3 + n, 4 + n))
        rows[:3] = self._pose[:, : 4 + n]
        rows[3:, 3], rows[3:, 4:] = self._right[:n], self._root[:n, :n]
        return Marginal(rows, self.point, self.prior.calibration, self.prior.places_m)

    def renumber(self, n_keyframes: int, n_observations: int) -> None:
        """Count keyframes and observations from others, after a drive forgot its first ones."""
        self.keyframe -= n_keyframes
        self.n_observations -= n_observations
