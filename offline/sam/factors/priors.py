"""What is known from elsewhere, as factors like those of measurements: what a person measured, what a map holds."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.sam.factors.odometry_and_observations import Columns, Linearised, State


@dataclass(frozen=True)
class StartFactors:
    """Measured starts: r = W log(T_measured^-1 o T_map_start), the map's frame being that of the measurement.

    Attributes:
        pose: (M,) index of each start.
        T_map_start: (M, 3) as measured.
        whitening: (M, 3, 3) W with W^T W the information of the right tangent.
    """

    pose: IntArray
    T_map_start: FloatArray
    whitening: FloatArray

    def residual(self, state: State) -> FloatArray:
        """(M, 3), whitened."""
        error = se2.log(se2.between(self.T_map_start, state.poses[self.pose]))
        whitened: FloatArray = np.einsum("mij,mj->mi", self.whitening, error)
        return whitened

    def linearise(self, state: State, columns: Columns) -> Linearised:
        """Residuals (M, 3) and one block for the pose."""
        error = se2.log(se2.between(self.T_map_start, state.poses[self.pose]))
        by_pose = self.whitening @ se2.right_jacobian_inverse(error)
        return Linearised(self.residual(state), ((columns.poses[self.pose], by_pose),))


@dataclass(frozen=True)
class DistanceFactors:
    """Measured distances between places, each a pose's or a tag's: r = (|a - b| - distance) / sigma.

    Attributes:
        pose_a: (M,) index of the pose, -1 where the end is a tag; tag_a: (M,) index of the tag, -1 where it is a pose.
        pose_b: (M,) and tag_b: (M,) likewise of the other end.
        distance_m: (M,)
        sigma_m: (M,)
    """

    pose_a: IntArray
    tag_a: IntArray
    pose_b: IntArray
    tag_b: IntArray
    distance_m: FloatArray
    sigma_m: FloatArray

    def residual(self, state: State) -> FloatArray:
        """(M, 1), whitened."""
        place_a, place_b = ends_of(self, state)
        apart = place_b - place_a
        off_m: FloatArray = np.linalg.norm(apart, axis=1) - self.distance_m
        return (off_m / self.sigma_m)[:, None]

    def linearise(self, state: State, columns: Columns) -> Linearised:
        """Residuals (M, 1) and a block for each end's pose and each end's tag, held where it is the other kind."""
        place_a, place_b = ends_of(self, state)
        apart = place_b - place_a
        # Two ends on one spot have no direction between them; the floor keeps the step finite.
        length = np.maximum(np.linalg.norm(apart, axis=1), 1e-6)
        by_b = (apart / (length * self.sigma_m)[:, None])[:, None, :]
        ends = ((self.pose_a, self.tag_a, -by_b), (self.pose_b, self.tag_b, by_b))
        blocks = [block for pose, tag, by_place in ends for block in _blocks(state, columns, pose, tag, by_place)]
        return Linearised(self.residual(state), tuple(blocks))


@dataclass(frozen=True)
class JointPrior:
    """Tags and calibration as a finished map has them, jointly: r = W (x - mean).

    Attributes:
        tags: (K,) index of each tag, none twice; calibration: (C,) index of each number, none twice and none held.
        mean: (2 K + C,)
        whitening: (2 K + C, 2 K + C) W with W^T W the inverse of the joint covariance.
    """

    tags: IntArray
    calibration: IntArray
    mean: FloatArray
    whitening: FloatArray

    def off(self, state: State) -> FloatArray:
        """(2 K + C,) from the mean."""
        values = np.concatenate([state.tags[self.tags].reshape(-1), state.calibration[self.calibration]])
        return values - self.mean

    def residual(self, state: State) -> FloatArray:
        """(2 K + C,), whitened."""
        whitened: FloatArray = self.whitening @ self.off(state)
        return whitened

    def columns(self, columns: Columns) -> IntArray:
        """(2 K + C,) of the tangent vector."""
        return np.concatenate([columns.tags[self.tags].reshape(-1), columns.calibration[self.calibration]])


_NONE: Final = np.zeros(0, dtype=np.int64)
NO_JOINT_PRIOR: Final = JointPrior(_NONE, _NONE, np.zeros(0), np.zeros((0, 0)))


@dataclass(frozen=True)
class Priors:
    """All that somebody measured, or that a map holds."""

    starts: StartFactors
    distances: DistanceFactors
    known: JointPrior = NO_JOINT_PRIOR

    def __len__(self) -> int:
        """How many measurements there are, a map being one."""
        return len(self.starts.pose) + len(self.distances.distance_m) + int(len(self.known.mean) > 0)

    @property
    def n_residuals(self) -> int:
        """How many measured numbers there are."""
        return 3 * len(self.starts.pose) + len(self.distances.distance_m) + len(self.known.mean)

    def sum_of_squares(self, state: State) -> float:
        """Of all residuals."""
        kinds = (self.starts, self.distances, self.known)
        return sum(float((kind.residual(state) ** 2).sum()) for kind in kinds)

    def linearise(self, state: State, columns: Columns) -> tuple[Linearised, Linearised]:
        """Of starts and of distances."""
        return self.starts.linearise(state, columns), self.distances.linearise(state, columns)

    @property
    def tags(self) -> IntArray:
        """Tags at which a distance ends, or that a map holds."""
        ends = np.concatenate([self.distances.tag_a, self.distances.tag_b, self.known.tags])
        return np.unique(ends[ends >= 0])


NO_PRIORS: Final = Priors(
    StartFactors(_NONE, np.zeros((0, 3)), np.zeros((0, 3, 3))),
    DistanceFactors(_NONE, _NONE, _NONE, _NONE, np.zeros(0), np.zeros(0)),
)


def ends_of(distances: DistanceFactors, state: State) -> tuple[FloatArray, FloatArray]:
    """Places (M, 2) of both ends."""
    ends = (distances.pose_a, distances.tag_a), (distances.pose_b, distances.tag_b)
    place_a, place_b = (_places(state, pose, tag) for pose, tag in ends)
    return place_a, place_b


def _places(state: State, pose: IntArray, tag: IntArray) -> FloatArray:
    """(M, 2) of the ends."""
    places = np.empty((len(pose), 2))
    is_pose = pose >= 0
    places[is_pose] = state.poses[pose[is_pose], :2]
    places[~is_pose] = state.tags[tag[~is_pose]]
    return places


def _blocks(
    state: State, columns: Columns, pose: IntArray, tag: IntArray, by_place: FloatArray
) -> tuple[tuple[IntArray, FloatArray], tuple[IntArray, FloatArray]]:
    """Of one end: the poses' (M, 1, 3), whose places move by R d_xy, and the tags' (M, 1, 2)."""
    is_pose = pose >= 0
    pose_columns, tag_columns = np.full((len(pose), 3), -1), np.full((len(pose), 2), -1)
    pose_columns[is_pose] = columns.poses[pose[is_pose]]
    tag_columns[~is_pose] = columns.tags[tag[~is_pose]]
    theta = np.where(is_pose, state.poses[pose, 2], 0.0)
    cos, sin = np.cos(theta), np.sin(theta)
    by_pose = np.zeros((len(pose), 1, 3))
    by_pose[:, 0, 0] = by_place[:, 0, 0] * cos + by_place[:, 0, 1] * sin
    by_pose[:, 0, 1] = by_place[:, 0, 1] * cos - by_place[:, 0, 0] * sin
    return (pose_columns, by_pose), (tag_columns, by_place)
