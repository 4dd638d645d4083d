"""Transform between two solved components from tags in both: position, height and orientation of each.

A tag in space has six parameters, a transform of the floor three. So one shared tag determines the transform, and three
degrees of freedom remain for a test: the tag must have one height and one tilt in both. The fit is generalised least
squares of the six differences under their joint covariance (Gauss-Newton).

Each component is expressed relative to a pose that observed the tags and that has no error there. The error between its
start and this pose does not matter for the tags, and after a long drive it would not be small.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.alignment import FALSE_ALARM, rotate_quarter
from groundsbot.offline.corners import CornerSolution, SpatialState
from groundsbot.offline.measurements import REACH_M, UNMODELLED_SIGMA_M

_STEPS: Final = 6
_LINEARITY_SIGMAS: Final = 2.0
# Squared sigmas between two equally likely hypotheses: together their variance is an eighth larger.
_COVERED: Final = 0.5


@dataclass(frozen=True)
class PlacedTags:
    """K tags of a component relative to one of its poses.

    Attributes:
        T_map_anchor: (3,) the pose.
        place_m: (K, 3) in its frame, height above the floor.
        turn: (K, 3, 3) R_anchor_tag.
        covariance: (6 K, 6 K) of position and of a small rotation about the anchor's axes, tag by tag.
        negative_log_likelihood: of the corners with the tags in this pose, relative to their best pose.
        linearity: true cost increase for a rotation of the first tag by two sigmas, to the side of the smaller one,
            over the quadratic prediction.
    """

    T_map_anchor: FloatArray
    place_m: FloatArray
    turn: FloatArray
    covariance: FloatArray
    negative_log_likelihood: float = 0.0
    linearity: float = 1.0

    @property
    def is_within_reach(self) -> bool:
        """Whether the tags are within reach at all, rather than far off where corners contain no information."""
        return float(np.trace(self.covariance)) < REACH_M**2


@dataclass(frozen=True)
class TagFit:
    """Transform of one component in another.

    Attributes:
        a: the tags in one, b: in the other.
        T_a_b: (3,) pose of b's map in a's.
        T_anchors: (3,) of b's anchor in a's.
        covariance: (3, 3) of T_anchors as x, y, theta; includes unmodelled errors.
        cost_increase: squared sigmas, chi-square with `freedom` where the tags have the same pose in both.
        negative_log_likelihood: up to a constant common to all hypotheses about the same tags.
    """

    a: PlacedTags
    b: PlacedTags
    T_anchors: FloatArray
    covariance: FloatArray
    cost_increase: float
    degrees_of_freedom: int
    negative_log_likelihood: float

    @property
    def T_a_b(self) -> FloatArray:
        """Pose (3,) of map b in map a."""
        return se2.compose(se2.compose(self.a.T_map_anchor, self.T_anchors), se2.inverse(self.b.T_map_anchor))

    @property
    def heading_sigma_rad(self) -> float:
        """Sigma of the heading of one relative to the other."""
        return float(self.covariance[2, 2] ** 0.5)

    @property
    def is_consistent(self) -> bool:
        """Whether the differences of the tags pass the chi-square test."""
        return self.cost_increase < float(chdtri(self.degrees_of_freedom, FALSE_ALARM))

    def covers(self, other: "TagFit") -> bool:
        """Return whether this covariance suffices for both hypotheses, whichever is true."""
        off = self.T_anchors - other.T_anchors
        off[2] = se2.wrap_angle(off[2])
        return float(off @ np.linalg.solve(self.covariance, off)) < _COVERED


def placed_tags(
    solution: CornerSolution, tags: IntArray, anchor: int, variance_factor: float, nats: float
) -> PlacedTags:
    """Return some tags of a converged solution relative to a pose.

    Args:
        solution: solution on corners.
        tags: (K,) indices.
        anchor: index of the pose.
        variance_factor: variance factor of the covariance.
        nats: see `PlacedTags`.
    """
    state, columns = solution.state, solution.problem.columns
    pose = state.poses[anchor]
    back = Rotation.from_euler("z", -pose[2]).as_matrix()
    place = (np.column_stack([state.tags, state.heights_m])[tags] - [pose[0], pose[1], 0.0]) @ back.T
    turn = back @ state.turns[tags]
    six = np.column_stack([columns.tags, columns.heights, columns.turns])[tags]
    joint = solution.covariance(np.concatenate([columns.poses[anchor], six.ravel()]))
    by = np.zeros((len(tags), 6, 3 + six.size))
    for k, own in enumerate(by):
        own[:3, 6 * k + 3 : 6 * k + 6] = back
        own[3:, 6 * k + 6 : 6 * k + 9] = turn[k]
        by[k, :2, :2] = -np.eye(2)
        by[k, :2, 2] = -rotate_quarter(place[k, :2])
        by[k, 5, 2] = -1.0
    rows = by.reshape(-1, 3 + six.size)
    straight = _linearity(solution, int(tags[0]), anchor)
    return PlacedTags(pose, place, turn, variance_factor * rows @ joint @ rows.T, nats, straight)


def _linearity(solution: CornerSolution, tag: int, anchor: int) -> float:
    """Return the cost increase for a two-sigma rotation of the tag over its prediction (see `PlacedTags`)."""
    if solution.factor is None:
        return 0.0
    state, columns = solution.state, solution.problem.columns
    heading = np.zeros(columns.n + 1)
    heading[columns.turns[tag]] = state.turns[tag, 2]
    heading[columns.poses[anchor, 2]] -= 1.0
    way = solution.factor.solve(heading[:-1])
    way *= _LINEARITY_SIGMAS / np.sqrt(heading[:-1] @ way)

    def cost_at(state: SpatialState) -> float:
        return solution.problem.system(state, is_whole=False)[1]

    rises = [cost_at(solution.problem.retract(state, step)) - cost_at(state) for step in (way, -way)]
    return min(rises) / (0.5 * _LINEARITY_SIGMAS**2)


def fit_transform_of_tags(a: PlacedTags, b: PlacedTags) -> TagFit:
    """Return the transform that aligns the tags of b with those of a."""
    k = len(a.place_m)
    relative = a.turn @ b.turn.swapaxes(-1, -2)
    theta = float(
        np.arctan2((relative[:, 1, 0] - relative[:, 0, 1]).sum(), (relative[:, 0, 0] + relative[:, 1, 1]).sum())
    )
    T = np.array([0.0, 0.0, theta])
    T[:2] = (a.place_m[:, :2] - se2.apply(T, b.place_m[:, :2])).mean(axis=0)
    for _ in range(_STEPS):
        residual, by_transform, S = _linearise(a, b, T)
        pulled = np.linalg.solve(S, by_transform).T
        T = T - np.linalg.solve(pulled @ by_transform, pulled @ residual)
        T[2] = se2.wrap_angle(T[2])
    residual, by_transform, S = _linearise(a, b, T)
    information = by_transform.T @ np.linalg.solve(S, by_transform)
    rise = float(residual @ np.linalg.solve(S, residual))
    # The likelihood integrated over all poses of the tags and over all transforms, with uniform priors (Laplace).
    logarithms = [float(np.linalg.slogdet(each)[1]) for each in (S, information, a.covariance, b.covariance)]
    nats = (
        0.5 * (rise + logarithms[0] + logarithms[1] - logarithms[2] - logarithms[3])
        + a.negative_log_likelihood
        + b.negative_log_likelihood
    )
    return TagFit(a, b, T, np.linalg.inv(information), rise, 6 * k - 3, nats)


def _linearise(a: PlacedTags, b: PlacedTags, T: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return differences (6 K,) a less b, their Jacobian (6 K, 3) with respect to T, and covariance (6 K, 6 K)."""
    k = len(a.place_m)
    turned = Rotation.from_euler("z", T[2]).as_matrix()
    in_a = b.place_m @ turned.T
    apart = a.place_m - in_a - [T[0], T[1], 0.0]
    tilted = Rotation.from_matrix(a.turn @ (turned @ b.turn).swapaxes(-1, -2)).as_rotvec()
    by_transform = np.zeros((k, 6, 3))
    by_transform[:, :2, :2] = -np.eye(2)
    by_transform[:, :2, 2] = -rotate_quarter(in_a[:, :2])
    by_transform[:, 5, 2] = -1.0
    both = np.kron(np.eye(2 * k), turned)
    S = a.covariance + both @ b.covariance @ both.T + np.diag(_unmodelled_covariance(a, b) ** 2)
    return np.concatenate([apart, tilted], axis=1).ravel(), by_transform.reshape(-1, 3), S


def _unmodelled_covariance(a: PlacedTags, b: PlacedTags) -> FloatArray:
    """Return (6 K,) unmodelled sigmas of the differences: a centimetre, and the rotation of a tag that goes with it.

    A mount's pitch or residual lens distortion that shifts a tag by a centimetre rotates it by that over its range.
    """
    range_m = np.minimum(*(np.linalg.norm(each.place_m[:, :2], axis=1) for each in (a, b)))
    turned = UNMODELLED_SIGMA_M / np.maximum(range_m, UNMODELLED_SIGMA_M)
    return np.concatenate([np.full((len(range_m), 3), UNMODELLED_SIGMA_M), np.tile(turned[:, None], (1, 3))], 1).ravel()


def radial_sigmas(solution: CornerSolution, anchor: int, starts: Sequence[int]) -> tuple[FloatArray, FloatArray]:
    """Return (N,) distances of tags and some poses from a pose, and (N,) their sigmas."""
    state, columns = solution.state, solution.problem.columns
    pose = state.poses[anchor]
    points = np.concatenate([state.tags, state.poses[list(starts), :2]]) - pose[:2]
    far_m = np.linalg.norm(points, axis=1)
    way = points / np.maximum(far_m, 1e-9)[:, None]
    which = np.concatenate([columns.poses[anchor, :2], columns.tags.ravel(), columns.poses[list(starts), :2].ravel()])
    joint = solution.covariance(which)
    # A pose's columns are along its own axes, a tag's along those of the map.
    axes = [pose[2], *np.zeros(len(state.tags)), *state.poses[list(starts), 2]]
    turn = Rotation.from_euler("z", np.array(axes)[:, None]).as_matrix()[:, :2, :2]
    by = np.zeros((len(points), len(which)))
    for n in range(len(points)):
        by[n, 2 * n + 2 : 2 * n + 4] = way[n] @ turn[n + 1]
        by[n, :2] = -way[n] @ turn[0]
    return far_m, np.sqrt(np.maximum(np.einsum("ni,ij,nj->n", by, joint, by), 0.0))
