"""Tape measurements and the joint prior of a finished map in the blocks of the arrowhead system.

A measured start adds to the 3 x 3 block of a pose. A measured distance couples its two ends, which are both eliminated
in the top, where elimination fills the matrix anyway. The joint prior couples all tags and calibration of a finished
map there. These factors are few, so numpy suffices.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.sam.arrowhead.tree import Tree
from groundsbot.offline.sam.factors.odometry_and_observations import Columns, State
from groundsbot.offline.sam.factors.priors import DistanceFactors, Priors
from groundsbot.offline.sam.linearisation.blocks import NormalEquations
from groundsbot.offline.sam.linearisation.kernels import Free

_NONE: Final = np.zeros(0, dtype=np.int64)


@dataclass(frozen=True)
class PriorBlocks:
    """The priors of a problem, and their positions in the arrowhead system.

    Attributes:
        factors: starts, distances and joint prior.
        columns: columns in the arrowhead's order; -1 where fixed.
        ends: (D, 2, 5) columns of pose (3) and tag (2) at each end of each distance; -1 for the other kind or if fixed.
        at: (D, 2, 5) positions of these columns in the top's front.
        known: (2 K + C,) columns of the joint prior's tags and calibration.
        known_at: (2 K + C,) positions of these columns in the top's front.
    """

    factors: Priors
    columns: Columns
    ends: IntArray
    at: IntArray
    known: IntArray
    known_at: IntArray

    @cached_property
    def map_information(self) -> FloatArray:
        """Information (2 K + C, 2 K + C) of the joint prior."""
        whitening = self.factors.known.whitening
        return whitening.T @ whitening

    @cached_property
    def coupling(self) -> FloatArray:
        """Part of `map_information` between different tags, and tags and calibration; zero in the diagonal blocks."""
        n = 2 * len(self.factors.known.tags)
        across = self.map_information.copy()
        each = np.arange(n // 2)
        across[:n, :n].reshape(n // 2, 2, n // 2, 2)[each, :, each, :] = 0.0
        across[n:, n:] = 0.0
        return across

    def add(self, state: State, system: NormalEquations) -> float:
        """Add all priors to the blocks; return the sum of their squares."""
        starts = self.factors.starts.linearise(state, self.columns)
        ((columns, derivative),) = starts.blocks
        _add_squares(system.pose, self.factors.starts.pose, _where_free(derivative, columns))
        _add_gradient(system, columns, derivative, starts.residual)
        distances = self.factors.distances.linearise(state, self.columns)
        blocks = [_where_free(by_end, columns) for columns, by_end in distances.blocks]
        ends = self.factors.distances
        _add_squares(system.pose, ends.pose_a, blocks[0])
        _add_squares(system.tag, ends.tag_a, blocks[1])
        _add_squares(system.pose, ends.pose_b, blocks[2])
        _add_squares(system.tag, ends.tag_b, blocks[3])
        system.distance[:] = np.concatenate(blocks, axis=-1).reshape(-1, 2, 5)
        _add_gradient(system, self.ends.reshape(-1, 10), system.distance.reshape(-1, 1, 10), distances.residual)
        return float((starts.residual**2).sum() + (distances.residual**2).sum()) + self._add_map_prior(state, system)

    def _add_map_prior(self, state: State, system: NormalEquations) -> float:
        """Add the joint prior without its `coupling`; return the sum of squares."""
        known, information = self.factors.known, self.map_information
        n, each = 2 * len(known.tags), np.arange(len(known.tags))
        numbers = self.columns.calibration[known.calibration]
        system.tag[known.tags] += information[:n, :n].reshape(len(each), 2, len(each), 2)[each, :, each, :]
        system.calibration[np.ix_(numbers, numbers)] += information[n:, n:]
        system.gradient[self.known] += information @ known.off(state)
        return float((known.residual(state) ** 2).sum())

    def add_to_top(self, system: NormalEquations, front: FloatArray) -> None:
        """Add the coupling by distances and by the joint prior to the upper triangle of the top's front."""
        first, second = self.at[:, 0, :, None], self.at[:, 1, None, :]
        products = system.distance[:, 0, :, None] * system.distance[:, 1, None, :]
        np.add.at(front, (np.minimum(first, second), np.maximum(first, second)), products)
        row, column = np.nonzero(self.known_at[:, None] < self.known_at)
        front[self.known_at[row], self.known_at[column]] += self.coupling[row, column]

    def add_product(self, system: NormalEquations, x: FloatArray, y: FloatArray) -> None:
        """Add to y the product of the coupling in `add_to_top` with x."""
        along = (system.distance * x[self.ends]).sum(axis=-1)
        np.add.at(y, self.ends, system.distance * along[:, ::-1, None])
        y[self.known] += self.coupling @ x[self.known]


def prior_blocks(factors: Priors, tree: Tree, free: Free) -> PriorBlocks | None:
    """Return the layout of priors, or None if there are none."""
    if not len(factors):
        return None
    n_poses, n_tags = tree.n_poses, tree.n_tags
    poses, tags = np.split(np.arange(3 * n_poses + 2 * n_tags), [3 * n_poses])
    columns = Columns(
        np.where(free.poses > 0.0, poses.reshape(-1, 3), -1),
        np.where(free.tags > 0.0, tags.reshape(-1, 2), -1),
        free.calibration,
        len(poses) + len(tags) + tree.n_calibration,
    )
    ends = _ends(factors.distances, columns)
    place = np.full(columns.n + 1, -1)
    top = tree.front[tree.front_start[-2] :]
    place[top] = np.arange(len(top))
    numbers = columns.calibration[factors.known.calibration]
    known = np.concatenate([columns.tags[factors.known.tags].reshape(-1), len(poses) + len(tags) + numbers])
    return PriorBlocks(factors, columns, ends, place[ends], known, place[known])


def ends_in_top(factors: Priors, segment_start: IntArray) -> tuple[IntArray, IntArray]:
    """Return the segments whose first pose, and the tags that, must be eliminated in the top.

    Raises:
        ValueError: a distance ends at a pose that is not the first one of a segment.
    """
    if not len(factors.distances.distance_m):
        return _NONE, factors.tags
    ends = np.concatenate([factors.distances.pose_a, factors.distances.pose_b])
    poses = np.unique(ends[ends >= 0])
    if not np.isin(poses, segment_start[:-1]).all():
        raise ValueError("a measured distance must end at the first pose of a segment or at a tag")
    return np.searchsorted(segment_start, poses), factors.tags


def _ends(distances: DistanceFactors, columns: Columns) -> IntArray:
    of_poses, of_tags = np.vstack([columns.poses, [-1] * 3]), np.vstack([columns.tags, [-1] * 2])
    ends = ((distances.pose_a, distances.tag_a), (distances.pose_b, distances.tag_b))
    return np.stack([np.concatenate([of_poses[pose], of_tags[tag]], axis=-1) for pose, tag in ends], axis=1)


def _where_free(derivative: FloatArray, columns: IntArray) -> FloatArray:
    """Return derivatives (M, n, k) with zeros in fixed columns."""
    return np.where(columns[:, None, :] >= 0, derivative, 0.0)


def _add_squares(diagonal: FloatArray, index: IntArray, derivative: FloatArray) -> None:
    """Add J^T J to the diagonal blocks of variables (M,); -1 where there is none."""
    there = index >= 0
    J = derivative[there]
    np.add.at(diagonal, index[there], J.swapaxes(-1, -2) @ J)


def _add_gradient(system: NormalEquations, columns: IntArray, derivative: FloatArray, residual: FloatArray) -> None:
    """Add J^T r of derivatives (M, n, k) and residuals (M, n) to the gradient."""
    by_column = np.einsum("mnk,mn->mk", derivative, residual)
    free = columns >= 0
    np.add.at(system.gradient, columns[free], by_column[free])
