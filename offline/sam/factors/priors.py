"""Priors as factors: poses and distances that a person measured, and the joint prior of a finished map."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.sam.factors.odometry_and_observations import Columns, Linearised, State


@dataclass(frozen=True)
class StartFactors:
    """Measured start poses: r = W log(T_measured^-1 o T_map_start), where map is the frame of the measurement.

    Attributes:
        pose: (M,) pose index of each start.
        T_map_start: (M, 3) measured pose.
        whitening: (M, 3, 3) W such that W^T W is the information in the right tangent space.
    """

    pose: IntArray
    T_map_start: FloatArray
    whitening: FloatArray

    def residual(self, state: State) -> FloatArray:
        """Return whitened residuals (M, 3)."""
        error = se2.log(se2.between(self.T_map_start, state.poses[self.pose]))
        whitened: FloatArray = np.einsum("mij,mj->mi", self.whitening, error)
        return whitened

    def linearise(self, state: State, columns: Columns) -> Linearised:
        """Return residuals (M, 3) and one block for the poses."""
        error = se2.log(se2.between(self.T_map_start, state.poses[self.pose]))
        by_pose = self.whitening @ se2.right_jacobian_inverse(error)
        return Linearised(self.residual(state), ((columns.poses[self.pose], by_pose),))


@dataclass(frozen=True)
class DistanceFactors:
    """Measured distances between two positions, each of a pose or a tag: r = (|a - b| - distance) / sigma.

    Attributes:
        pose_a: (M,) index of the pose at the first end; -1 if that end is a tag.
        tag_a: (M,) index of the tag at the first end; -1 if that end is a pose.
        pose_b, tag_b: (M,) the same for the second end.
        distance_m: (M,) measured distance.
        sigma_m: (M,) its sigma.
    """

    pose_a: IntArray
    tag_a: IntArray
    pose_b: IntArray
    tag_b: IntArray
    distance_m: FloatArray
    sigma_m: FloatArray

    def residual(self, state: State) -> FloatArray:
        """Return whitened residuals (M, 1)."""
        place_a, place_b = ends_of(self, state)
        apart = place_b - place_a
        off_m: FloatArray = np.linalg.norm(apart, axis=1) - self.distance_m
        return (off_m / self.sigma_m)[:, None]

    def linearise(self, state: State, columns: Columns) -> Linearised:
        """Return residuals (M, 1) and one block each for pose and tag of both ends; -1 for the other kind."""
        place_a, place_b = ends_of(self, state)
        apart = place_b - place_a
        # The direction between coinciding ends is undefined; the bound keeps the step finite.
        length = np.maximum(np.linalg.norm(apart, axis=1), 1e-6)
        by_b = (apart / (length * self.sigma_m)[:, None])[:, None, :]
        ends = ((self.pose_a, self.tag_a, -by_b), (self.pose_b, self.tag_b, by_b))
        blocks = [block for pose, tag, by_place in ends for block in _blocks(state, columns, pose, tag, by_place)]
        return Linearised(self.residual(state), tuple(blocks))


@dataclass(frozen=True)
class JointPrior:
    """The joint prior of tags and calibration from a finished map: r = W (x - mean).

    Attributes:
        tags: (K,) distinct tag indices.
        calibration: (C,) distinct indices of free parameters.
        mean: (2 K + C,) positions of the tags in m, then corrections.
        whitening: (2 K + C, 2 K + C) W such that W^T W is the inverse of the joint covariance.
    """

    tags: IntArray
    calibration: IntArray
    mean: FloatArray
    whitening: FloatArray

    def off(self, state: State) -> FloatArray:
        """Return the differences (2 K + C,) from the mean."""
        values = np.concatenate([state.tags[self.tags].reshape(-1), state.calibration[self.calibration]])
        return values - self.mean

    def residual(self, state: State) -> FloatArray:
        """Return whitened residuals (2 K + C,)."""
        whitened: FloatArray = self.whitening @ self.off(state)
        return whitened

    def columns(self, columns: Columns) -> IntArray:
        """Return the columns (2 K + C,) in the tangent vector."""
        return np.concatenate([columns.tags[self.tags].reshape(-1), columns.calibration[self.calibration]])


_NONE: Final = np.zeros(0, dtype=np.int64)
NO_JOINT_PRIOR: Final = JointPrior(_NONE, _NONE, np.zeros(0), np.zeros((0, 0)))


@dataclass(frozen=True)
class Priors:
    """The tape measurements and the joint prior of a finished map."""

    starts: StartFactors
    distances: DistanceFactors
    known: JointPrior = NO_JOINT_PRIOR

    def __len__(self) -> int:
        """Return the number of measurements; a finished map counts as one."""
        return len(self.starts.pose) + len(self.distances.distance_m) + int(len(self.known.mean) > 0)

    @property
    def n_residuals(self) -> int:
        """Number of measured scalars."""
        return 3 * len(self.starts.pose) + len(self.distances.distance_m) + len(self.known.mean)

    def sum_of_squares(self, state: State) -> float:
        """Return the sum of squares of all residuals."""
        kinds = (self.starts, self.distances, self.known)
        return sum(float((kind.residual(state) ** 2).sum()) for kind in kinds)

    def linearise(self, state: State, columns: Columns) -> tuple[Linearised, Linearised]:
        """Linearise starts and distances."""
        return self.starts.linearise(state, columns), self.distances.linearise(state, columns)

    @property
    def tags(self) -> IntArray:
        """Indices of the tags at ends of distances and in the joint prior."""
        ends = np.concatenate([self.distances.tag_a, self.distances.tag_b, self.known.tags])
        return np.unique(ends[ends >= 0])


NO_PRIORS: Final = Priors(
    StartFactors(_NONE, np.zeros((0, 3)), np.zeros((0, 3, 3))),
    DistanceFactors(_NONE, _NONE, _NONE, _NONE, np.zeros(0), np.zeros(0)),
)


def ends_of(distances: DistanceFactors, state: State) -> tuple[FloatArray, FloatArray]:
    """Return the positions (M, 2) of the first and of the second ends."""
    ends = (distances.pose_a, distances.tag_a), (distances.pose_b, distances.tag_b)
    place_a, place_b = (_places(state, pose, tag) for pose, tag in ends)
    return place_a, place_b


def _places(state: State, pose: IntArray, tag: IntArray) -> FloatArray:
    """Return the positions (M, 2) of one end of each distance."""
    places = np.empty((len(pose), 2))
    is_pose = pose >= 0
    places[is_pose] = state.poses[pose[is_pose], :2]
    places[~is_pose] = state.tags[tag[~is_pose]]
    return places


def _blocks(
    state: State, columns: Columns, pose: IntArray, tag: IntArray, by_place: FloatArray
) -> tuple[tuple[IntArray, FloatArray], tuple[IntArray, FloatArray]]:
    """Return the blocks (M, 1, 3) for poses, whose positions move by R d_xy, and (M, 1, 2) for tags of one end."""
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
