"""A Gaussian over the robot's pose, its calibration and the tags seen so far, taken on reading by reading.

An extended Kalman filter in the coordinates of the solver (pose perturbed on the right, T o exp(delta)), which takes
its `ReadingFactors`. All tags seen stay in the state with their covariances, so a tag that comes again is known to
be the same. Bar-Shalom, Li, Kirubarajan, "Estimation with Applications to Tracking and Navigation" (2001), chapter 5;
Smith, Self and Cheeseman, "Estimating uncertain spatial relationships in robotics" (1990).
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from scipy import linalg

from calib import se2
from calib.arrays import BoolArray, FloatArray, IntArray
from offline.condensed import quarter_turned
from offline.factors import Columns, ReadingFactors, State
from offline.solver import HUBER_THRESHOLD

_POSE: Final = np.arange(3)
# Huber's weight depends on what the reading leaves over, which depends on its weight.
_WEIGHINGS: Final = 4
_STEPS: Final = 2
_CONVERGED_SIGMAS: Final = 1e-3

Known = Callable[[], tuple[FloatArray, FloatArray]]  # what something is off (m,), and its covariance (m, m)


class OnlineFilter:
    """Mean and covariance; the pose has columns 0 to 2, calibration and tags what they were given."""

    def __init__(self, calibration: FloatArray, covariance: FloatArray) -> None:
        """Starts at the origin, which is the frame.

        Args:
            calibration: (C,) what is known of it.
            covariance: (C, C); numbers without variance are held.
        """
        free = np.diag(covariance) > 0.0
        n = 3 + int(free.sum())
        self.pose = np.zeros(3)
        self.tags = np.zeros((0, 2))
        self.calibration = calibration.copy()
        self.calibration_columns: IntArray = np.where(free, 2 + np.cumsum(free), -1)
        self.covariance = np.zeros((n, n), order="F")
        self.covariance[3:, 3:] = covariance[np.ix_(free, free)]
        self._first_tag = n

    @property
    def state(self) -> State:
        """As the factors take it."""
        return State(self.pose[None], self.tags, self.calibration)

    @property
    def columns(self) -> Columns:
        """Of it."""
        n = len(self.covariance)
        tags = self._first_tag + np.arange(2 * len(self.tags)).reshape(-1, 2)
        return Columns(_POSE[None], tags, self.calibration_columns, n)

    def columns_of(self, tags: Sequence[int], numbers: Sequence[int] = ()) -> IntArray:
        """Of tags, then of calibration numbers."""
        at = self._first_tag + 2 * np.array(tags, dtype=np.int64)[:, None] + np.arange(2)
        return np.concatenate([at.reshape(-1), self.calibration_columns[list(numbers)]])

    def values_of(self, tags: Sequence[int], numbers: Sequence[int] = ()) -> FloatArray:
        """Likewise."""
        return np.concatenate([self.tags[list(tags)].reshape(-1), self.calibration[list(numbers)]])

    def move(self, motion: FloatArray, covariance: FloatArray, jacobian: FloatArray, wheels: IntArray) -> None:
        """One motion by the wheels.

        Args:
            motion: (3,) by nominal calibration.
            covariance: (3, 3) of its right tangent, in metres as wheels count.
            jacobian: (3, 3) of that tangent by the wheel parameters.
            wheels: (3,) their indices, wheel_scale first.
        """
        twist = jacobian @ self.calibration[wheels]
        moved = se2.compose(motion, se2.exp(twist))
        by_pose = se2.adjoint(se2.inverse(moved))
        columns = self.calibration_columns[wheels]
        by_wheels = (se2.right_jacobian(twist) @ jacobian)[:, columns >= 0]
        P = self.covariance
        rows = by_pose @ P[:3] + by_wheels @ P[columns[columns >= 0]]
        own = rows[:, :3] @ by_pose.T + rows[:, columns[columns >= 0]] @ by_wheels.T
        scale = np.array([1.0 + self.calibration[wheels[0]]] * 2 + [1.0])
        P[:3], P[:, :3] = rows, rows.T
        P[:3, :3] = 0.5 * (own + own.T) + scale[:, None] * covariance * scale
        self.pose = se2.compose(self.pose, moved)

    def read(self, reading: ReadingFactors) -> None:
        """One reading (M = 1) of a tag of the state, with Huber's loss, linearised where it leads (Gauss-Newton)."""
        before = self.pose, self.tags, self.calibration.copy()
        tag = int(reading.tag[0])
        step, left = np.zeros(len(self.covariance)), _STEPS
        while True:
            residual, columns, jacobian = self._linearised(reading)
            jacobian = self._as_before(jacobian, before[0], before[1][tag], tag)
            rows = jacobian @ self.covariance[columns]
            foretold = rows[:, columns] @ jacobian.T
            aimed = jacobian @ step[columns] - residual
            spread = foretold + np.eye(2) / _huber_weight(foretold, aimed)
            last, step, left = step, rows.T @ np.linalg.solve(spread, aimed), left - 1
            self.pose, self.tags, self.calibration = before[0], before[1], before[2].copy()
            if not left or np.abs(jacobian @ (step - last)[columns]).max() < _CONVERGED_SIGMAS:
                break
            self._move_mean(step)
        self._corrected(rows, spread, aimed)

    def _as_before(self, jacobian: FloatArray, pose: FloatArray, place_m: FloatArray, tag: int) -> FloatArray:
        """A reading's derivative (2, k), by pose first and then tag, by errors about an earlier mean, see `_step`."""
        turned = jacobian.copy()
        turned[:, :3] = jacobian[:, :3] @ se2.adjoint(se2.between(self.pose, pose))
        turned[:, 2] += jacobian[:, 3:5] @ quarter_turned(self.tags[tag] - place_m)
        return turned

    def surprise(self, reading: ReadingFactors, unmodelled_m: float = 0.0) -> float:
        """Squared sigmas of a reading (M = 1) from what the state foretells, its tag being off by as much besides."""
        residual, columns, jacobian = self._linearised(reading)
        spread = jacobian @ self.covariance[np.ix_(columns, columns)] @ jacobian.T + np.eye(2)
        spread += unmodelled_m**2 * jacobian[:, 3:5] @ jacobian[:, 3:5].T
        return float(residual @ np.linalg.solve(spread, residual))

    def add_tag(self, place_m: FloatArray, by_state: FloatArray, covariance: FloatArray) -> int:
        """One more tag, at a place whose error is by_state (2, n) times that of the state, plus its own; its index."""
        P, n = self.covariance, len(self.covariance)
        across = by_state @ P
        grown = np.empty((n + 2, n + 2), order="F")
        grown[:n, :n] = P
        grown[n:, :n], grown[:n, n:] = across, across.T
        grown[n:, n:] = across @ by_state.T + covariance
        self.covariance = grown
        self.tags = np.concatenate([self.tags, place_m[None]])
        return len(self.tags) - 1

    def drop_last_tag(self) -> None:
        """Forgets the tag that was added last."""
        self.tags = self.tags[:-1]
        self.covariance = np.asfortranarray(self.covariance[:-2, :-2])

    def add_seen_tag(self, reading: ReadingFactors) -> int:
        """One more tag, where a reading (M = 1) of it puts it; its index. The reading is used up by that."""
        reading = replace(reading, tag=np.array([len(self.tags)]))
        places = reading.places_in_map(State(self.pose[None], np.zeros((len(self.tags) + 1, 2)), self.calibration))
        self.tags = np.concatenate([self.tags, places])
        _, blocks = reading.linearise(self.state, self.columns)
        self.tags = self.tags[:-1]  # `add_tag` counts it
        by_tag = np.linalg.inv(blocks[1][1][0])
        by_state = np.zeros((2, len(self.covariance)))
        for columns, derivative in (blocks[0], *blocks[2:]):
            free = columns[0] >= 0
            by_state[:, columns[0][free]] -= by_tag @ derivative[0][:, free]
        return self.add_tag(places[0], by_state, by_tag @ by_tag.T)

    def set_to(
        self, pose: FloatArray, calibration: FloatArray, tags: FloatArray, covariance: FloatArray, known: BoolArray
    ) -> None:
        """Another mean and covariance of the same variables.

        Args:
            pose: (3,)
            calibration: (C,)
            tags: (T, 2)
            covariance: (3 + C + 2 T, 3 + C + 2 T) of them in this order.
            known: (C,) which calibration numbers it is about; the others stay, and are as good as independent.
        """
        stays = self.calibration_columns[(self.calibration_columns >= 0) & ~known]
        own = self.covariance[np.ix_(stays, stays)]
        rows = np.concatenate(
            [_POSE, 3 + np.flatnonzero(self.calibration_columns >= 0), 3 + len(calibration) + np.arange(tags.size)]
        )
        self.pose, self.calibration, self.tags = pose, calibration, tags
        self.covariance = np.asfortranarray(covariance[np.ix_(rows, rows)])
        self.covariance[np.ix_(stays, stays)] = own

    def correct(self, columns: IntArray, jacobian: FloatArray, off: FloatArray, covariance: FloatArray) -> None:
        """What is `off` (m,) = jacobian (m, k) times the error of k columns, plus noise of a covariance (m, m)."""
        rows = jacobian @ self.covariance[columns]
        self._corrected(rows, rows[:, columns] @ jacobian.T + covariance, off)

    def loosen(self, tag: int, sigma_m: float) -> None:
        """Lets a tag be elsewhere, by as much."""
        columns = self.columns_of([tag])
        self.covariance[columns, columns] += sigma_m**2

    def place(self, T_map_start: FloatArray, columns: IntArray, jacobian: FloatArray, known: "Known") -> None:
        """Moves the frame, of which nothing was known, to where what is known of some columns puts it.

        The motion is the generalised least squares of what is known, and its uncertainty comes on top of that of the
        state which is corrected by it.

        Args:
            T_map_start: (3,) about where the old frame lies in the new.
            columns: (k,) as of `correct`.
            jacobian: (m, k) likewise.
            known: what it is off, and the noise of that, once the frame is moved.
        """
        turn = T_map_start[2]
        rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        n, first, P = len(self.covariance), self._first_tag, self.covariance
        P[first:] = (rotation @ P[first:].reshape(-1, 2, n)).reshape(-1, n)
        P[:, first:] = (P[:, first:].reshape(n, -1, 2) @ rotation.T).reshape(n, -1)
        self.pose = se2.compose(T_map_start, self.pose)
        self.tags = se2.apply(T_map_start, self.tags)
        off, covariance = known()
        motion = self._by_motion()
        rows = jacobian @ P[columns]
        root = linalg.cholesky(rows[:, columns] @ jacobian.T + covariance, lower=True)
        right = np.column_stack([jacobian @ motion[columns], off, rows])
        whitened = linalg.solve_triangular(root, right, lower=True)
        by_motion, left, taken = whitened[:, :3], whitened[:, 3], whitened[:, 4:]
        spread = np.linalg.inv(by_motion.T @ by_motion)
        moved = spread @ (by_motion.T @ left)
        lever = motion - taken.T @ by_motion
        self.covariance = np.asfortranarray(P - taken.T @ taken + lever @ spread @ lever.T)
        self._step(motion @ moved + taken.T @ (left - by_motion @ moved))

    def _by_motion(self) -> FloatArray:
        """(n, 3) what a motion (x, y, turn) of everything about the pose does to the state."""
        by_motion = np.zeros((len(self.covariance), 3))
        cos, sin = np.cos(self.pose[2]), np.sin(self.pose[2])
        by_motion[:3] = [[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]]
        from_pose = self.tags - self.pose[:2]
        by_motion[self._first_tag :: 2, 0] = by_motion[self._first_tag + 1 :: 2, 1] = 1.0
        by_motion[self._first_tag :, 2] = quarter_turned(from_pose).reshape(-1)
        return by_motion

    def _corrected(self, rows: FloatArray, spread: FloatArray, off: FloatArray) -> None:
        """Takes `off` (m,) with rows (m, n) = H P and spread (m, m) = H P H^T + R."""
        root = linalg.cholesky(spread, lower=True)
        whitened = linalg.solve_triangular(root, np.column_stack([rows, off]), lower=True)
        self.covariance = linalg.blas.dgemm(
            -1.0, whitened[:, :-1], whitened[:, :-1], 1.0, self.covariance, trans_a=1, overwrite_c=1
        )
        self._step(whitened[:, :-1].T @ whitened[:, -1])

    def _step(self, step: FloatArray) -> None:
        """Moves the mean on arcs, tags along with the pose, and the covariance with it.

        A motion of everything changes no reading. In the coordinates of the mean it turns places about the origin, so
        were the covariance left as it is while the mean moves, readings would seem to tell of that motion, and the
        filter would end two times too sure. So errors are those of the invariant filter (Barrau and Bonnabel, "An EKF-
        SLAM algorithm with consistency properties", 2015), a twist e of everything and what tags err besides, which
        stay what they are when the mean moves: a tag's error in map axes is J l e_theta of that.
        """
        before, tags = self.pose, self.tags
        self._move_mean(step)
        carried = se2.adjoint(se2.between(self.pose, before))
        turned = quarter_turned(self.tags - tags).reshape(-1)
        P, first = self.covariance, self._first_tag
        P[first:] += np.outer(turned, P[2])
        P[:, first:] += np.outer(P[:, 2], turned)
        P[:3] = carried @ P[:3]
        P[:, :3] = P[:, :3] @ carried.T

    def _move_mean(self, step: FloatArray) -> None:
        free = self.calibration_columns >= 0
        self.calibration[free] += step[self.calibration_columns[free]]
        twist = se2.adjoint(self.pose) @ step[:3]
        own = step[self._first_tag :].reshape(-1, 2) - twist[:2] - twist[2] * quarter_turned(self.tags)
        self.pose = se2.compose(self.pose, se2.exp(step[:3]))
        self.tags = se2.apply(se2.exp(twist), self.tags) + own

    def _linearised(self, reading: ReadingFactors) -> tuple[FloatArray, IntArray, FloatArray]:
        """Residual (2,), the columns (k,) that it depends on, and the derivative (2, k)."""
        residual, blocks = reading.linearise(self.state, self.columns)
        columns = np.concatenate([block[0][0] for block in blocks])
        jacobian = np.concatenate([block[1][0] for block in blocks], axis=1)
        return residual[0], columns[columns >= 0], jacobian[:, columns >= 0]


def _huber_weight(foretold: FloatArray, residual: FloatArray) -> float:
    """Of a reading by what it leaves over, which depends on its weight."""
    weight = 1.0
    for _ in range(_WEIGHINGS):
        left = np.linalg.solve(np.eye(2) + weight * foretold, residual)
        weight = min(1.0, HUBER_THRESHOLD / max(float(np.linalg.norm(left)), 1e-12))
        if weight == 1.0:
            break
    return weight
