"""The bundle adjustment problem: factors of odometry, tag corners, tag observations without corners, and priors."""

from dataclasses import dataclass
from functools import cached_property
from typing import Final, NamedTuple

import numpy as np
from scipy.special import chdtrc, chdtri

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.corners.elimination_order import corner_order
from groundsbot.offline.corners.factors import CornerFactors, SpatialColumns, SpatialState, spatial_values
from groundsbot.offline.corners.kernels.linearisation import N_DETECTION, add_corners, add_motions
from groundsbot.offline.corners.kernels.step import retract
from groundsbot.offline.corners.upright_prior import NO_UPRIGHT_PRIOR, UprightFactors
from groundsbot.offline.sam import (
    DEFAULT_LOSSES,
    HUBER_THRESHOLD,
    CalibrationPrior,
    EliminationFronts,
    FrontalSystem,
    FrontFactor,
    Linearised,
    Loss,
    Normal,
    ObservationFactors,
    OdometryArrays,
    OdometryFactors,
    Priors,
    Values,
    compiled_motions,
    huber,
    losses_and_weights,
)

# The threshold has the same tail probability for eight residuals as HUBER_THRESHOLD has for two.
CORNER_LOSS: Final = huber(float(np.sqrt(chdtri(8, chdtrc(2, HUBER_THRESHOLD**2)))))
# Alternations between the attitude of an image and the weights of its detections; most converge in one.
_WEIGHT_ROUNDS: Final = 3
DETECTIONS: Final = -2  # index of detections in `kinds`; pairs are last


class WeightedCorners(NamedTuple):
    """Detections with robust weights, at the best roll, pitch and height of each image.

    Attributes:
        weight: (M,) weight of each detection.
        residual: (M, 8) whitened residuals at the estimated attitudes.
        attitude: (P, 3) estimated roll and pitch (rad) and height (m) of the base in each image.
        cost: sum of the losses and of the whitened squares of the attitudes.
    """

    weight: FloatArray
    residual: FloatArray
    attitude: FloatArray
    cost: float


@dataclass(frozen=True)
class CornerProblem:
    """The factors of one estimate and the columns of its variables.

    Attributes:
        observations: observations of tags without corners.
        anchor: (T,) index of a pose that observed each tag.
        attitude_sigmas: (3,) sigmas of ATTITUDE, in rad, rad and m; zeros for a level floor.
        upright: prior of tags that are known to be mounted upright.
    """

    odometry: OdometryFactors
    corners: CornerFactors
    observations: ObservationFactors
    prior: CalibrationPrior
    measured: Priors
    columns: SpatialColumns
    anchor: IntArray
    attitude_sigmas: FloatArray
    upright: UprightFactors = NO_UPRIGHT_PRIOR

    @property
    def n_residuals(self) -> int:
        """Number of measured scalars, priors excluded."""
        measured = self.observations.value.size + self.measured.n_residuals
        return self.odometry.motion.size + 8 * self.corners.observations.n + measured

    @cached_property
    def order(self) -> EliminationFronts:
        """The order of elimination, computed once."""
        detections, observations = self.corners.observations, self.observations
        pose, tag = (
            np.concatenate([detections.pose, observations.pose]),
            np.concatenate([detections.tag, observations.tag]),
        )
        return corner_order(self.columns, self.kinds(), self.odometry, self.measured, pose, tag)

    @cached_property
    def detection_order(self) -> IntArray:
        """Order (M,) of detections by front, then by tag."""
        return np.lexsort((self.corners.observations.tag, self.order.kinds[DETECTIONS].node))

    @cached_property
    def motions(self) -> OdometryArrays:
        """The odometry for compiled functions."""
        return compiled_motions(self.odometry, slice(None))

    @cached_property
    def pictures(self) -> tuple[IntArray, int]:
        """Index (M,) of the image that contains each detection, and the number of images."""
        poses, picture = np.unique(self.corners.observations.pose, return_inverse=True)
        return picture, len(poses)

    @property
    def n_pairs_in_pictures(self) -> int:
        """Number of pairs of detections that share an image."""
        seen = np.bincount(self.pictures[0])
        return int((seen * (seen - 1) // 2).sum())

    @cached_property
    def pairs(self) -> IntArray:
        """Pairs (N, 2) of detections in the same image, which an uneven floor couples; none on a level floor."""
        if not self.attitude_sigmas.any():
            return np.zeros((0, 2), dtype=np.int64)
        picture, n = self.pictures
        order = np.argsort(picture, kind="stable")
        groups = np.split(order, np.searchsorted(picture[order], np.arange(1, n)))
        found = [(a, b) for group in groups for i, a in enumerate(group) for b in group[i + 1 :]]
        return np.array(found, dtype=np.int64).reshape(-1, 2)

    def kinds(self) -> list[IntArray]:
        """Return the columns (M, k) of each kind of factor, in the order of `linearise`."""
        detection, columns = self.corners.columns(self.columns), self.columns
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
            detection,
            detection[self.pairs].reshape(len(self.pairs), 2 * N_DETECTION),
        ]

    def linearise(self, state: SpatialState) -> tuple[list[Normal], float]:
        """Return normal equations of each kind, in the order of `kinds`, and the cost: half the sum of all losses."""
        odometry = normal_equations(self.odometry.linearise(state, self.columns), DEFAULT_LOSSES.odometry)
        plain = [odometry, *self._small_kinds(state)]
        detection, pair, cost = self._corners(state)
        return [*(normal for normal, _ in plain), detection, pair], 0.5 * (sum(each for _, each in plain) + cost)

    def system(self, state: SpatialState, *, is_whole: bool = True) -> tuple[FrontalSystem, float]:
        """Return the assembled normal equations and the cost; without matrices, in half the time, unless `is_whole`."""
        system = self.order.empty(is_whole=is_whole)
        if self.attitude_sigmas.any():
            normals, cost = self.linearise(state)
            self.order.add(system, 0, normals)
            return system, cost
        odometry, values = self.order.kinds[0], Values(state.poses, state.tags, state.calibration)
        total = add_motions(self.motions, DEFAULT_LOSSES.odometry, values, odometry, system)
        few = self._small_kinds(state)
        self.order.add(system, 1, [normal for normal, _ in few])
        total += sum(each for _, each in few) + self._level_detections(state, system)
        return system, 0.5 * total

    def factor(self, state: SpatialState) -> FrontFactor:
        """Factorise H at a state.

        Raises:
            NotPositiveError: H is not positive definite.
        """
        return self.order.factorise(self.system(state)[0])

    def _small_kinds(self, state: SpatialState) -> list[tuple[Normal, float]]:
        """Return normal equations and sums of losses of the kinds between odometry and detections; most are empty."""
        columns, starts, distances = self.columns, self.measured.starts, self.measured.distances
        return [
            normal_equations(self.observations.linearise(state, columns), DEFAULT_LOSSES.observations)
            if len(self.observations.pose)
            else _NONE,
            normal_equations(self.prior.linearise(state, columns)),
            normal_equations(starts.linearise(state, columns)) if len(starts.pose) else _NONE,
            normal_equations(distances.linearise(state, columns)) if len(distances.distance_m) else _NONE,
            normal_equations(self.upright.linearise(state, columns)) if len(self.upright.tag) else _NONE,
            _joint_prior_normal(self.prior, state) if len(self.prior.rows) else _NONE,
        ]

    def _level_detections(self, state: SpatialState, system: FrontalSystem) -> float:
        """Add detections in level images; return twice their cost."""
        corners, values = self.corners, spatial_values(state)
        kind = self.order.kinds[DETECTIONS]
        cost = add_corners(
            corners.observations, corners.lenses, CORNER_LOSS, values, kind, self.detection_order, system
        )
        return cost if np.isfinite(cost) else np.inf

    def weigh(self, residual: FloatArray, by_attitude: FloatArray) -> WeightedCorners:
        """Estimate the ATTITUDE of each image and the robust weights of its detections.

        Args:
            residual: (M, 8) whitened residuals for level images.
            by_attitude: (M, 8, 3) derivatives with respect to ATTITUDE.
        """
        picture, n = self.pictures
        losses, weight = losses_and_weights(CORNER_LOSS, residual)
        attitude: FloatArray = np.zeros((n, 3))
        if not self.attitude_sigmas.any():
            return WeightedCorners(weight, residual, attitude, float(losses.sum()))
        inverse = 1.0 / np.maximum(self.attitude_sigmas, _LEVEL) ** 2
        level: FloatArray = residual
        for _ in range(_WEIGHT_ROUNDS):
            heavy = (weight[:, None, None] * by_attitude).swapaxes(-1, -2)
            information = self._by_picture(heavy @ by_attitude) + np.diag(inverse)
            attitude = np.asarray(-np.linalg.solve(information, self._by_picture(heavy @ level[..., None]))[..., 0])
            residual = np.asarray(level + (by_attitude @ attitude[picture][..., None])[..., 0], dtype=np.float64)
            losses, weight = losses_and_weights(CORNER_LOSS, residual)
        return WeightedCorners(weight, residual, attitude, float(losses.sum() + (attitude**2 * inverse).sum()))

    def corners_cost(self, state: SpatialState) -> float:
        """Return twice the cost of the detections; infinite if a lens has no image of a corner."""
        linearised, by_attitude = self.corners.linearise(state, self.columns)
        cost = self.weigh(linearised.residual, by_attitude).cost
        return cost if np.isfinite(cost) else np.inf

    def log_determinant(self, state: SpatialState) -> float:
        """Return the log determinant of the whitened corners' covariance I + J S J^T; 0 for a level floor."""
        linearised, by_attitude = self.corners.linearise(state, self.columns)
        weight = self.weigh(linearised.residual, by_attitude).weight
        own = self._by_picture(by_attitude.swapaxes(-1, -2) @ (weight[:, None, None] * by_attitude))
        _, logarithms = np.linalg.slogdet(np.eye(3) + self.attitude_sigmas**2 * own)
        return float(np.sum(logarithms))

    def retract(self, state: SpatialState, step: FloatArray) -> SpatialState:
        """Return the state after a step (n,); tags move rigidly with their anchors, as in `sam.Problem.retract`."""
        columns = self.columns
        padded = np.append(step, 0.0)
        after = SpatialState(
            poses=np.empty_like(state.poses),
            tags=np.empty_like(state.tags),
            calibration=state.calibration + padded[columns.calibration],
            heights_m=np.empty_like(state.heights_m),
            turns=np.empty_like(state.turns),
        )
        retract(
            spatial_values(state), padded, columns.poses, columns.tags, columns.heights, columns.turns, self.anchor,
            spatial_values(after),
        )  # fmt: skip
        return after

    def _corners(self, state: SpatialState) -> tuple[Normal, Normal, float]:
        """Return normal equations of detections and of pairs, with ATTITUDE eliminated, and twice the cost."""
        linearised, by_attitude = self.corners.linearise(state, self.columns)
        weighted = self.weigh(linearised.residual, by_attitude)
        if not np.isfinite(weighted.cost):
            weighted = weighted._replace(cost=float("inf"))
        ((_, jacobian),) = linearised.blocks
        transposed = jacobian.swapaxes(-1, -2)
        matrix = transposed @ (weighted.weight[:, None, None] * jacobian)
        gradient = (transposed @ (weighted.weight[:, None] * weighted.residual)[..., None])[..., 0]
        if not self.attitude_sigmas.any():
            none = Normal(np.zeros((0, 2 * N_DETECTION, 2 * N_DETECTION)), np.zeros((0, 2 * N_DETECTION)))
            return Normal(matrix, gradient), none, weighted.cost
        picture, _ = self.pictures
        heavy = weighted.weight[:, None, None] * by_attitude
        own = self._by_picture(by_attitude.swapaxes(-1, -2) @ heavy)
        own += np.diag(1.0 / np.maximum(self.attitude_sigmas, _LEVEL) ** 2)
        coupled = heavy.swapaxes(-1, -2) @ jacobian  # (M, 3, 19)
        gain = np.linalg.solve(own[picture], coupled)
        matrix = matrix - coupled.swapaxes(-1, -2) @ gain
        a, b = self.pairs.T
        across = -coupled[a].swapaxes(-1, -2) @ gain[b]
        pair = np.zeros((len(a), 2 * N_DETECTION, 2 * N_DETECTION))
        pair[:, :N_DETECTION, N_DETECTION:] = across
        pair[:, N_DETECTION:, :N_DETECTION] = across.swapaxes(-1, -2)
        return Normal(matrix, gradient), Normal(pair, np.zeros((len(a), 2 * N_DETECTION))), weighted.cost

    def _by_picture(self, values: FloatArray) -> FloatArray:
        """Return sums (P, ...) of values (M, ...) of detections by image."""
        picture, n = self.pictures
        summed = np.zeros((n, *values.shape[1:]))
        np.add.at(summed, picture, values)
        return summed


# rad and m: a lower bound of sigmas that keeps the information finite.
_LEVEL: Final = 1e-7
_NONE: Final = (Normal(np.zeros((0, 1, 1)), np.zeros((0, 1))), 0.0)


def normal_equations(kind: Linearised, loss: Loss | None = None) -> tuple[Normal, float]:
    """Return normal equations and the sum of losses; a quadratic loss if `loss` is None."""
    jacobian = np.concatenate([derivative for _, derivative in kind.blocks], axis=-1)
    heavy, cost = jacobian, 0.0
    if loss is None:
        cost = float((kind.residual**2).sum())
    else:
        losses, weight = losses_and_weights(loss, kind.residual)
        heavy, cost = weight[:, None, None] * jacobian, float(losses.sum())
    transposed = heavy.swapaxes(-1, -2)
    return Normal(transposed @ jacobian, (transposed @ kind.residual[..., None])[..., 0]), cost


def _joint_prior_normal(prior: CalibrationPrior, state: SpatialState) -> tuple[Normal, float]:
    """Return normal equations of the joint factor of the calibration prior, and the sum of squares."""
    residual = prior.rows @ state.calibration + prior.values
    return Normal((prior.rows.T @ prior.rows)[None], (prior.rows.T @ residual)[None]), float(residual @ residual)
