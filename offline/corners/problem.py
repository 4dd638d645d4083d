"""All factors of an estimate on tag corners: wheels, corners in pixels, positions that came without corners, priors."""

from dataclasses import dataclass
from functools import cached_property
from typing import Final, NamedTuple

import numpy as np
from scipy.stats import chi2

from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray
from groundsbot.offline.corners.elimination_order import corner_order
from groundsbot.offline.corners.factors import CornerFactors, SpatialColumns, SpatialState, spatial_values
from groundsbot.offline.corners.kernels.linearisation import N_LOOK, add_corners, add_motions
from groundsbot.offline.corners.kernels.step import move
from groundsbot.offline.corners.multifrontal.fronts import EliminationFronts, FrontFactor, Normal
from groundsbot.offline.corners.multifrontal.kernels import FrontalSystem
from groundsbot.offline.corners.upright_prior import NOTHING_UPRIGHT, UprightFactors
from groundsbot.offline.sam import (
    DEFAULT_LOSSES,
    HUBER_THRESHOLD,
    CalibrationPrior,
    Linearised,
    Loss,
    ObservationFactors,
    OdometryArrays,
    OdometryFactors,
    Priors,
    Values,
    compiled_motions,
    huber,
    losses_and_weights,
)

# Beyond it lie as many of good looks, with their eight numbers, as of good observations with two.
CORNER_LOSS: Final = huber(float(np.sqrt(chi2.isf(chi2.sf(HUBER_THRESHOLD**2, 2), 8))))
# How a picture stands and which of its looks count settle together in a few rounds; most of them in one.
_WEIGHT_ROUNDS: Final = 3
LOOKS: Final = -2  # among `kinds`; the last are pairs


class WeightedCorners(NamedTuple):
    """Looks weighed by how well they fit, each picture standing as it fits best.

    Attributes:
        weight: (M,) of each look.
        residual: (M, 8) with the picture as it stands.
        standing: (P, 3) how, in WOBBLE.
        cost: sum of the looks' losses and of the squares of what the pictures stand off.
    """

    weight: FloatArray
    residual: FloatArray
    standing: FloatArray
    cost: float


@dataclass(frozen=True)
class CornerProblem:
    """All factors of one estimate, and where the variables sit.

    Attributes:
        observations: of tags whose corners nobody kept.
        anchor: (T,) a pose from which each tag was seen.
        attitude_sigmas: (3,) of roll, pitch and height of pictures, by which they are off level; zeros on a hall floor.
        upright: tags that somebody knows to hang so.
    """

    odometry: OdometryFactors
    corners: CornerFactors
    observations: ObservationFactors
    prior: CalibrationPrior
    measured: Priors
    columns: SpatialColumns
    anchor: IntArray
    attitude_sigmas: FloatArray
    upright: UprightFactors = NOTHING_UPRIGHT

    @property
    def n_residuals(self) -> int:
        """How many measured numbers there are, priors apart."""
        measured = self.observations.value.size + self.measured.n_residuals
        return self.odometry.motion.size + 8 * len(self.corners.observations) + measured

    @cached_property
    def order(self) -> EliminationFronts:
        """The order of elimination, settled once."""
        looks, observations = self.corners.observations, self.observations
        pose, tag = np.concatenate([looks.pose, observations.pose]), np.concatenate([looks.tag, observations.tag])
        return corner_order(self.columns, self.kinds(), self.odometry, self.measured, pose, tag)

    @cached_property
    def observation_order(self) -> IntArray:
        """(M,) of looks by front, and by tag."""
        return np.lexsort((self.corners.observations.tag, self.order.kinds[LOOKS].node))

    @cached_property
    def motions(self) -> OdometryArrays:
        """The odometry for compiled functions."""
        return compiled_motions(self.odometry, np.arange(len(self.odometry.first)))

    @cached_property
    def pictures(self) -> tuple[IntArray, int]:
        """(M,) picture of each look, and how many there are."""
        poses, picture = np.unique(self.corners.observations.pose, return_inverse=True)
        return picture, len(poses)

    @property
    def n_pairs_in_pictures(self) -> int:
        """How many pairs of looks share a picture."""
        seen = np.bincount(self.pictures[0])
        return int((seen * (seen - 1) // 2).sum())

    @cached_property
    def pairs(self) -> IntArray:
        """(N, 2) looks that share a picture, which couples them where pictures wobble."""
        if not self.attitude_sigmas.any():
            return np.zeros((0, 2), dtype=np.int64)
        picture, n = self.pictures
        order = np.argsort(picture, kind="stable")
        groups = np.split(order, np.searchsorted(picture[order], np.arange(1, n)))
        found = [(a, b) for group in groups for i, a in enumerate(group) for b in group[i + 1 :]]
        return np.array(found, dtype=np.int64).reshape(-1, 2)

    def kinds(self) -> list[IntArray]:
        """The columns (M, k) of each kind of factor, in the order in which `linearise` gives them."""
        look, columns = self.corners.columns(self.columns), self.columns
        starts, distances = self.measured.starts, self.measured.distances

        def ends(index: IntArray, of: IntArray) -> IntArray:
            return np.where(index[:, None] >= 0, of[index], -1)

        return [
            np.concatenate(
                [
                    columns.poses[self.odometry.first],
                    columns.poses[self.odometry.first + 1],
                    columns.calibration[self.odometry.parameters],
                ],
                axis=1,
            ),
            np.concatenate(
                [
                    columns.poses[self.observations.pose],
                    columns.tags[self.observations.tag],
                    columns.calibration[self.observations.mount_parameters],
                    columns.calibration[self.observations.scale_parameter][:, None],
                    columns.calibration[self.observations.camera_parameters],
                ],
                axis=1,
            ),
            columns.calibration[:, None],
            columns.poses[starts.pose],
            np.concatenate(
                [
                    ends(distances.pose_a, columns.poses),
                    ends(distances.tag_a, columns.tags),
                    ends(distances.pose_b, columns.poses),
                    ends(distances.tag_b, columns.tags),
                ],
                axis=1,
            ),
            columns.turns[self.upright.tag],
            columns.calibration[None, :] if len(self.prior.rows) else np.zeros((0, 1), dtype=np.int64),
            look,
            look[self.pairs].reshape(len(self.pairs), 2 * N_LOOK),
        ]

    def linearise(self, state: SpatialState) -> tuple[list[Normal], float]:
        """Normal equations of each kind, in the order of `kinds`, and the cost: half the sum of all losses."""
        odometry = _normal(self.odometry.linearise(state, self.columns), DEFAULT_LOSSES.odometry)
        plain = [odometry, *self._few(state)]
        look, pair, cost = self._corners(state)
        return [*(normal for normal, _ in plain), look, pair], 0.5 * (sum(each for _, each in plain) + cost)

    def system(self, state: SpatialState, *, is_whole: bool = True) -> tuple[FrontalSystem, float]:
        """The same added up, compiled where all is level; and the cost. Without matrices it takes half of the time."""
        system = self.order.empty(is_whole=is_whole)
        if self.attitude_sigmas.any():
            normals, cost = self.linearise(state)
            self.order.add(system, 0, normals)
            return system, cost
        odometry, values = self.order.kinds[0], Values(state.poses, state.tags, state.calibration)
        total = add_motions(self.motions, DEFAULT_LOSSES.odometry, values, odometry, system)
        few = self._few(state)
        self.order.add(system, 1, [normal for normal, _ in few])
        total += sum(each for _, each in few) + self._level_observations(state, system)
        return system, 0.5 * total

    def factor(self, state: SpatialState) -> FrontFactor:
        """Of H there.

        Raises:
            NotPositiveError: it has no square root.
        """
        return self.order.factorise(self.system(state)[0])

    def _few(self, state: SpatialState) -> list[tuple[Normal, float]]:
        """Of all kinds between odometry and looks, with the sum of their losses; most floors have but the prior."""
        columns, starts, distances = self.columns, self.measured.starts, self.measured.distances
        return [
            _normal(self.observations.linearise(state, columns), DEFAULT_LOSSES.observations)
            if len(self.observations.pose)
            else _NONE,
            prior_normal(self.prior, state),
            _normal(starts.linearise(state, columns), None) if len(starts.pose) else _NONE,
            _normal(distances.linearise(state, columns), None) if len(distances.distance_m) else _NONE,
            _normal(self.upright.linearise(state, columns), None) if len(self.upright.tag) else _NONE,
            joint_prior_normal(self.prior, state) if len(self.prior.rows) else _NONE,
        ]

    def _level_observations(self, state: SpatialState, system: FrontalSystem) -> float:
        """Adds looks at level pictures; twice their cost."""
        corners, values = self.corners, spatial_values(state)
        kind = self.order.kinds[LOOKS]
        cost = add_corners(corners.arrays, corners.lenses, CORNER_LOSS, values, kind, self.observation_order, system)
        return cost if np.isfinite(cost) else np.inf

    def weigh(self, residual: FloatArray, wobble: FloatArray) -> WeightedCorners:
        """Weighs looks whose pictures may stand off level.

        Args:
            residual: (M, 8) of level pictures.
            wobble: (M, 8, 3) derivative by how a picture stands.
        """
        picture, n = self.pictures
        losses, weight = losses_and_weights(CORNER_LOSS, residual)
        standing: FloatArray = np.zeros((n, 3))
        if not self.attitude_sigmas.any():
            return WeightedCorners(weight, residual, standing, float(losses.sum()))
        inverse = 1.0 / np.maximum(self.attitude_sigmas, _LEVEL) ** 2
        level: FloatArray = residual
        for _ in range(_WEIGHT_ROUNDS):
            heavy = (weight[:, None, None] * wobble).swapaxes(-1, -2)
            information = self._by_picture(heavy @ wobble) + np.diag(inverse)
            standing = np.asarray(-np.linalg.solve(information, self._by_picture(heavy @ level[..., None]))[..., 0])
            residual = np.asarray(level + (wobble @ standing[picture][..., None])[..., 0], dtype=np.float64)
            losses, weight = losses_and_weights(CORNER_LOSS, residual)
        return WeightedCorners(weight, residual, standing, float(losses.sum() + (standing**2 * inverse).sum()))

    def corners_cost(self, state: SpatialState) -> float:
        """Twice the cost of the looks alone; infinite where a lens has no image of a corner."""
        linearised, wobble = self.corners.linearise(state, self.columns)
        cost = self.weigh(linearised.residual, wobble).cost
        return cost if np.isfinite(cost) else np.inf

    def log_determinant(self, state: SpatialState) -> float:
        """Logarithm of the determinant of the whitened corners' covariance I + J S J^T; 0 where all is level."""
        linearised, wobble = self.corners.linearise(state, self.columns)
        weight = self.weigh(linearised.residual, wobble).weight
        own = self._by_picture(wobble.swapaxes(-1, -2) @ (weight[:, None, None] * wobble))
        _, logarithms = np.linalg.slogdet(np.eye(3) + self.attitude_sigmas**2 * own)
        return float(np.sum(logarithms))

    def retract(self, state: SpatialState, step: FloatArray) -> SpatialState:
        """The state after a step (n,): tags move along with their anchors as on a rigid body, see `solver.Problem`."""
        columns = self.columns
        padded = np.append(step, 0.0)
        after = SpatialState(
            poses=np.empty_like(state.poses),
            tags=np.empty_like(state.tags),
            calibration=state.calibration + padded[columns.calibration],
            heights_m=np.empty_like(state.heights_m),
            turns=np.empty_like(state.turns),
        )
        move(
            spatial_values(state), padded, columns.poses, columns.tags, columns.heights, columns.turns, self.anchor,
            spatial_values(after),
        )  # fmt: skip
        return after

    def _corners(self, state: SpatialState) -> tuple[Normal, Normal, float]:
        """Of looks and of pairs that share a picture, how the pictures stand eliminated; and twice their cost."""
        linearised, wobble = self.corners.linearise(state, self.columns)
        weighed = self.weigh(linearised.residual, wobble)
        if not np.isfinite(weighed.cost):
            weighed = weighed._replace(cost=float("inf"))
        ((_, jacobian),) = linearised.blocks
        transposed = jacobian.swapaxes(-1, -2)
        matrix = transposed @ (weighed.weight[:, None, None] * jacobian)
        gradient = (transposed @ (weighed.weight[:, None] * weighed.residual)[..., None])[..., 0]
        if not self.attitude_sigmas.any():
            none = Normal(np.zeros((0, 2 * N_LOOK, 2 * N_LOOK)), np.zeros((0, 2 * N_LOOK)))
            return Normal(matrix, gradient), none, weighed.cost
        picture, _ = self.pictures
        heavy = weighed.weight[:, None, None] * wobble
        own = self._by_picture(wobble.swapaxes(-1, -2) @ heavy)
        own += np.diag(1.0 / np.maximum(self.attitude_sigmas, _LEVEL) ** 2)
        coupled = heavy.swapaxes(-1, -2) @ jacobian  # (M, 3, 19)
        taken = np.linalg.solve(own[picture], coupled)
        matrix = matrix - coupled.swapaxes(-1, -2) @ taken
        a, b = self.pairs.T
        across = -coupled[a].swapaxes(-1, -2) @ taken[b]
        pair = np.zeros((len(a), 2 * N_LOOK, 2 * N_LOOK))
        pair[:, :N_LOOK, N_LOOK:] = across
        pair[:, N_LOOK:, :N_LOOK] = across.swapaxes(-1, -2)
        return Normal(matrix, gradient), Normal(pair, np.zeros((len(a), 2 * N_LOOK))), weighed.cost

    def _by_picture(self, values: FloatArray) -> FloatArray:
        """Sums (P, ...) of values (M, ...) of looks."""
        picture, n = self.pictures
        summed = np.zeros((n, *values.shape[1:]))
        np.add.at(summed, picture, values)
        return summed


# rad and m: a floor that is as good as level keeps its information finite.
_LEVEL: Final = 1e-7
_NONE: Final = (Normal(np.zeros((0, 1, 1)), np.zeros((0, 1))), 0.0)


def _normal(kind: Linearised, loss: Loss | None) -> tuple[Normal, float]:
    """Normal equations, and the sum of losses."""
    jacobian = np.concatenate([derivative for _, derivative in kind.blocks], axis=-1)
    heavy, cost = jacobian, 0.0
    if loss is None:
        cost = float((kind.residual**2).sum())
    else:
        losses, weight = losses_and_weights(loss, kind.residual)
        heavy, cost = weight[:, None, None] * jacobian, float(losses.sum())
    transposed = heavy.swapaxes(-1, -2)
    return Normal(transposed @ jacobian, (transposed @ kind.residual[..., None])[..., 0]), cost


def prior_normal(prior: CalibrationPrior, state: SpatialState) -> tuple[Normal, float]:
    """Normal equations of what is known of the calibration, each number for itself, and the sum of its squares."""
    residual = prior.residual(state)
    weight = 1.0 / np.where(prior.sigma > 0.0, prior.sigma, 1.0)
    return Normal((weight**2)[:, None, None], weight[:, None] * residual), float((residual**2).sum())


def joint_prior_normal(prior: CalibrationPrior, state: SpatialState) -> tuple[Normal, float]:
    """Normal equations of what is known of several calibration numbers together, and the sum of its squares."""
    residual = prior.rows @ state.calibration + prior.values
    return Normal((prior.rows.T @ prior.rows)[None], (prior.rows.T @ residual)[None]), float(residual @ residual)


def columns_of(n_poses: int, free: BoolArray, sigmas: FloatArray) -> SpatialColumns:
    """Poses, tags' places, heights, turns, calibration; held: the first pose, exact calibration, turns nobody saw."""
    n_tags = len(free)
    poses = np.arange(-3, 3 * n_poses - 3).reshape(n_poses, 3)
    poses[0] = -1
    n = 3 * n_poses - 3
    tags = n + np.arange(2 * n_tags).reshape(n_tags, 2)
    n += 2 * n_tags
    hung = np.where(free, np.cumsum(free) - 1, -1)
    heights = np.where(free, n + hung, -1)
    n += int(free.sum())
    turns = np.where(free[:, None], n + 3 * hung[:, None] + np.arange(3), -1)
    n += 3 * int(free.sum())
    known = sigmas > 0.0
    calibration = np.where(known, n + np.cumsum(known) - 1, -1)
    return SpatialColumns(poses, tags, calibration, n + int(known.sum()), heights, turns)
