"""Fuses wheel odometry with a gyro, and estimates the noise of both from the difference of their turns.

The turn by the gyro is a measurement of the heading of each motion. A Kalman update of the motion's right tangent with
gain K has the covariance C' = (I - K h) C (I - K h)^T + K v K^T (Joseph form), which remains linear in the variances of
the noise parameters. Wheels and gyro measure four numbers, and the fused motion has three. The fourth, the difference
of the two turns, depends on the calibration alone. All differences of a segment form one linear factor, which makes the
gyro's bias and scale and the wheels' track observable where the robot stands or drives straight (Bar-Shalom, Li and
Kirubarajan, "Estimation with applications to tracking and navigation", 2001, section 5.2).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np
from scipy.optimize import minimize

from groundsbot.calib.foundation import FloatArray, IntArray, plural
from groundsbot.calib.geometry import se2
from groundsbot.calib.robot import Gyro, NoiseParameters
from groundsbot.offline.measurements.covariance_components import propagate
from groundsbot.offline.measurements.motion_model.gyro import (
    GyroSamples,
    GyroTurns,
    HeadingDifferences,
    bias_nodes,
    noise_density,
)
from groundsbot.offline.measurements.motion_model.motion_model import SegmentOdometry

HEADING_NOISE: Final = ("sigma_heading_rad_per_sqrt_m", "sigma_heading_rad_per_sqrt_rad")
# Duration over which differences are summed for the fit of the noise.
_BLOCK_S: Final = 0.5
# Wheels have slipped where a difference exceeds this many sigmas; by chance it does so in one of 15,000 motions.
_SLIP_SIGMAS: Final = 4.0
_WARNING_SLIP_RAD: Final = np.radians(2.0)
_ROUNDS: Final = 3
# Bound on the logarithm of the ratio of a fitted sigma to its prior.
_MOST_LOG: Final = float(np.log(1e3))
# A ratio of the gyro's turns to the wheels' outside of this comes from a wrong axis, sign or unit. That of tracked
# robots is about one half.
_RATIOS: Final = (0.3, 3.0)
_TURNS_RAD: Final = 1.0  # least root-sum-square turn by the wheels, over half seconds, that determines the ratio
# Prior uncertainty of a sigma, as a factor at one sigma: of the gyro's data sheet, and of the wheels' defaults.
_FACTOR_GYRO: Final = 3.0
_FACTOR_WHEELS: Final = 30.0


@dataclass(frozen=True)
class GyroFit:
    """The noise of a gyro and of the wheels' turns, fitted to the differences of their turns.

    Attributes:
        gyro: with the fitted noise.
        heading_sigmas: (2,) of HEADING_NOISE.
        interval: (4, 2) 99 % bounds of white noise, bias walk and HEADING_NOISE.
        extra_variance: (M,) rad^2 added to motions in which the wheels slipped; 0 elsewhere.
    """

    gyro: Gyro
    heading_sigmas: FloatArray
    interval: FloatArray
    extra_variance: FloatArray

    @property
    def slip_warnings(self) -> list[str]:
        """A warning where wheels slipped by more than `_WARNING_SLIP_RAD`; none elsewhere."""
        slips_rad = np.sqrt(self.extra_variance)
        n = int((slips_rad >= _WARNING_SLIP_RAD).sum())
        if not n:
            return []
        motions, most_deg = plural(n, "motion"), np.degrees(slips_rad.max())
        warning = f"the wheels slipped in {motions}: their turn differs by up to {most_deg:.0f} degrees from the gyro's"
        return [f"{warning}, which is used there"]


class FusedOdometry(NamedTuple):
    """Fused motions, the fit of the noise (None where the gyro is not used), and warnings."""

    odometry: SegmentOdometry
    fit: GyroFit | None
    warnings: list[str]


def with_gyro(
    wheels: SegmentOdometry,
    samples: GyroSamples,
    stamps_ns: IntArray,
    gyro: Gyro,
    sigmas: FloatArray,
    noise: NoiseParameters,
    owner: str,
) -> FusedOdometry:
    """Fuse the motions of a segment with its gyro, under noise that is fitted to the differences of their turns.

    Args:
        wheels: motions by the wheels alone.
        samples: of the gyro.
        stamps_ns: (K,) of the keyframes.
        gyro: prior calibration and noise of the gyro.
        sigmas: (3,) prior sigmas of WHEEL_PARAMETERS.
        noise: other noise parameters.
        owner: the segment that the bias belongs to.

    Returns:
        The fused motions. Where the gyro covers none of the motions, or turns unlike the wheels, the motions by the
        wheels and no fit.
    """
    nodes = bias_nodes(int(stamps_ns[0]), int(stamps_ns[-1]), gyro)
    turns = samples.turns(stamps_ns, nodes)
    if not turns.is_known.any():
        return FusedOdometry(wheels, None, [])
    ratio = turn_ratio(wheels, turns)
    if ratio is not None and not _RATIOS[0] < ratio < _RATIOS[1]:
        warning = (
            f"the gyro turns {ratio:.2f} times as far as the wheels, so it is not used; check the axis, sign and unit "
            "of /gyro"
        )
        return FusedOdometry(wheels, None, [warning])
    fit = _fit(wheels, turns, gyro, nodes, sigmas, noise)
    own = noise.model_copy(update=dict(zip(HEADING_NOISE, fit.heading_sigmas.tolist(), strict=True)))
    nodes = bias_nodes(int(stamps_ns[0]), int(stamps_ns[-1]), fit.gyro)
    fused = fuse(wheels.with_noise(own), samples.turns(stamps_ns, nodes), nodes, fit, own, owner)
    return FusedOdometry(fused, fit, fit.slip_warnings)


def turn_ratio(wheels: SegmentOdometry, turns: GyroTurns) -> float | None:
    """Return the regression of the gyro's turns on those of the wheels; None where the wheels turn too little."""
    known, block = _known_blocks(turns)
    n = int(block.max(initial=-1)) + 1
    duration_s = _sum_by_block(block, turns.duration_s[known], n)
    rates = [_sum_by_block(block, each[known], n) / duration_s for each in (wheels.motion[:, 2], turns.turn_rad)]
    by_wheels, by_gyro = ((rate - np.median(rate)) * duration_s for rate in rates)
    square = float(by_wheels @ by_wheels)
    return float(by_wheels @ by_gyro) / square if square > _TURNS_RAD**2 else None


def _known_blocks(turns: GyroTurns) -> tuple[IntArray, IntArray]:
    """Return (N,) the intervals with a known turn, and (N,) the number from 0 of the block of time each is in."""
    known = np.flatnonzero(turns.is_known)
    _, block = np.unique(np.floor(np.cumsum(turns.duration_s) / _BLOCK_S)[known], return_inverse=True)
    return known, np.asarray(block, dtype=np.int64)


def fuse(
    wheels: SegmentOdometry,
    turns: GyroTurns,
    node_stamps_ns: IntArray,
    fit: GyroFit,
    noise: NoiseParameters,
    owner: str,
) -> SegmentOdometry:
    """Update the heading of each motion by the gyro, and add the differences as a factor on the calibration.

    Args:
        wheels: motions with the covariances of `noise`.
        turns: between the same keyframes.
        node_stamps_ns: (n,) of the bias.
        fit: the gyro's noise and the wheels' slips.
        noise: of the wheels.
        owner: the segment that the bias belongs to.
    """
    slip = np.zeros_like(wheels.covariance)
    slip[:, 2, 2] = fit.extra_variance
    C = wheels.covariance + slip
    variance = noise_density(fit.gyro, node_stamps_ns) * turns.duration_s
    K = np.where(turns.is_known[:, None], C[:, :, 2] / (C[:, 2, 2] + variance)[:, None], 0.0)
    A = np.tile(np.eye(3), (len(K), 1, 1))
    A[:, :, 2] -= K
    difference = se2.wrap_angle(turns.turn_rad - wheels.motion[:, 2])
    # The differences determine the heading noise, so it is moved to the rest, out of reach of later fits to tags.
    is_heading = np.isin(wheels.parts.names, HEADING_NOISE)[:, None, None, None]
    heading = np.tensordot(fit.heading_sigmas**2, wheels.parts.of(HEADING_NOISE), 1)
    parts = replace(
        wheels.parts,
        unit=propagate(A, np.where(is_heading, 0.0, wheels.parts.unit)),
        rest=propagate(A, heading + wheels.parts.rest + slip) + variance[:, None, None] * K[:, :, None] * K[:, None, :],
    )
    by_gyro = np.where(turns.is_known[:, None], turns.jacobian, 0.0)
    known = np.flatnonzero(turns.is_known)
    jacobian = _difference_jacobian(wheels, turns)
    sigma = np.sqrt(C[known, 2, 2] + variance[known])
    walk_sigma = fit.gyro.bias_walk_rad_s_per_sqrt_s * np.sqrt(np.diff(node_stamps_ns) * 1e-9)
    walk = np.zeros((len(walk_sigma), jacobian.shape[1]))
    walk[:, -len(node_stamps_ns) :] = np.diff(np.eye(len(node_stamps_ns)), axis=0) / walk_sigma[:, None]
    differences = HeadingDifferences(known, jacobian[known] / sigma[:, None], difference[known] / sigma, walk, owner)
    return replace(
        wheels,
        motion=se2.compose(wheels.motion, se2.exp(K * difference[:, None])),
        covariance=parts.under(noise),
        parts=parts,
        jacobian=np.concatenate([A @ wheels.jacobian, K[:, :, None] * by_gyro[:, None, :]], axis=2),
        differences=differences,
    )


@dataclass(frozen=True)
class _DifferenceBlocks:
    """Differences of the turns in B blocks of motions, with their Jacobians and the components of their variances.

    Attributes:
        difference_rad: (B,)
        jacobian: (B, P) by the wheels' parameters, GYRO_PARAMETERS and the bias at its nodes.
        unit: (3, B) variances for a sigma of one of white noise and HEADING_NOISE.
        rest: (B,) the part of the variance that does not depend on these.
        prior_sigma: (p,) of the first parameters, up to the first node of the bias.
        spacing_s: (n - 1,) between nodes.
    """

    difference_rad: FloatArray
    jacobian: FloatArray
    unit: FloatArray
    rest: FloatArray
    prior_sigma: FloatArray
    spacing_s: FloatArray

    def solve(self, sigmas: FloatArray, extra: FloatArray) -> tuple[float, FloatArray]:
        """Return minus twice the log likelihood, with the calibration marginalised, and the estimated calibration (P,).

        Args:
            sigmas: (4,) white noise, bias walk, HEADING_NOISE.
            extra: (B,) additional variance.
        """
        white, walk, *heading = sigmas.tolist()
        variance = np.array([white, *heading]) ** 2 @ self.unit + self.rest + extra
        n_nodes = len(self.spacing_s) + 1
        variance += walk**2 * float(self.spacing_s.max()) ** 2 / 12.0 * self.unit[0]
        step = walk * np.sqrt(self.spacing_s)
        walk_rows = np.zeros((n_nodes - 1, self.jacobian.shape[1]))
        walk_rows[:, -n_nodes:] = np.diff(np.eye(n_nodes), axis=0) / step[:, None]
        prior = np.zeros((len(self.prior_sigma), self.jacobian.shape[1]))
        prior[:, : len(self.prior_sigma)] = np.diag(1.0 / self.prior_sigma)
        root = self.jacobian / np.sqrt(variance)[:, None]
        information = walk_rows.T @ walk_rows + prior.T @ prior
        posterior = information + root.T @ root
        weighted = self.difference_rad / variance
        calibration = -np.linalg.solve(posterior, self.jacobian.T @ weighted)
        square = float(self.difference_rad @ weighted + (self.jacobian.T @ weighted) @ calibration)
        log_determinant = np.log(variance).sum() + np.linalg.slogdet(posterior)[1] + 2.0 * np.log(step).sum()
        return square + float(log_determinant), np.asarray(calibration, dtype=np.float64)


def _fit(
    wheels: SegmentOdometry, turns: GyroTurns, gyro: Gyro, nodes: IntArray, sigmas: FloatArray, noise: NoiseParameters
) -> GyroFit:
    """Maximise the posterior of four sigmas under wide log-normal priors; motions with slip get additional variance."""
    known, block = _known_blocks(turns)
    blocks = _blocks(wheels, turns, gyro, nodes, sigmas, known, block)
    start = np.array(
        [
            gyro.noise_rad_per_sqrt_s,
            gyro.bias_walk_rad_s_per_sqrt_s,
            *(getattr(noise, name) for name in HEADING_NOISE),
        ]
    )
    width = np.log([_FACTOR_GYRO, _FACTOR_GYRO, _FACTOR_WHEELS, _FACTOR_WHEELS])
    extra = np.zeros(len(turns.turn_rad))
    logs = np.zeros(4)  # of the ratios to the start
    block_extra = np.zeros(len(blocks.rest))

    def cost(logs: FloatArray) -> float:
        return blocks.solve(start * np.exp(logs), block_extra)[0] + float(((logs / width) ** 2).sum())

    for _ in range(_ROUNDS):
        logs = np.asarray(minimize(cost, logs, method="L-BFGS-B", bounds=[(-_MOST_LOG, _MOST_LOG)] * 4).x)
        _, calibration = blocks.solve(start * np.exp(logs), block_extra)
        extra = _slips(wheels, turns, nodes, start * np.exp(logs), calibration, known)
        block_extra[:] = _sum_by_block(block, extra[known], len(block_extra))
    sigma = np.sqrt(np.diag(np.linalg.pinv(0.5 * _curvature(cost, logs))))
    white, walk, *heading = (start * np.exp(logs)).tolist()
    return GyroFit(
        gyro=gyro.model_copy(update={"noise_rad_per_sqrt_s": white, "bias_walk_rad_s_per_sqrt_s": walk}),
        heading_sigmas=np.array(heading),
        interval=(start * np.exp(logs))[:, None] * np.exp(2.576 * sigma[:, None] * [-1.0, 1.0]),
        extra_variance=extra,
    )


def _blocks(
    wheels: SegmentOdometry,
    turns: GyroTurns,
    gyro: Gyro,
    nodes: IntArray,
    sigmas: FloatArray,
    known: IntArray,
    block: IntArray,
) -> _DifferenceBlocks:
    difference = se2.wrap_angle(turns.turn_rad - wheels.motion[:, 2])[known]
    jacobian = _difference_jacobian(wheels, turns)[known]
    heading = wheels.parts.of(HEADING_NOISE)[:, known, 2, 2]
    other = wheels.parts.rest[known, 2, 2]
    n = int(block.max()) + 1
    per_block = np.bincount(block, minlength=n)
    return _DifferenceBlocks(
        difference_rad=_sum_by_block(block, difference, n),
        jacobian=np.stack([np.bincount(block, column, n) for column in jacobian.T], axis=1),
        unit=np.stack([np.bincount(block, each, n) for each in (turns.duration_s[known], *heading)]),
        # The rest is mostly quantisation, whose errors cancel between successive motions.
        rest=np.bincount(block, other, n) / per_block,
        prior_sigma=np.array([*sigmas, gyro.scale_sigma, gyro.time_offset_s_sigma, gyro.bias_rad_s_sigma]),
        spacing_s=np.diff(nodes) * 1e-9,
    )


def _difference_jacobian(wheels: SegmentOdometry, turns: GyroTurns) -> FloatArray:
    """Return (M, P) the derivative of the differences with respect to WHEEL_PARAMETERS, GYRO_PARAMETERS and the bias.

    The gyro's turn is regressed on that of the wheels, so its scale multiplies the turn by the wheels. If it multiplied
    the gyro's own turn, the residuals would shrink with scale and track together. Where the prior of the track is wide,
    the best fit would then be a robot that does not turn.
    """
    turn_rad = wheels.motion[:, 2]
    return np.column_stack([-wheels.jacobian[:, 2], turn_rad, turns.jacobian[:, 1:]])


def _sum_by_block(block: IntArray, values: FloatArray, n: int) -> FloatArray:
    return np.asarray(np.bincount(block, values, n), dtype=np.float64)


def _slips(
    wheels: SegmentOdometry,
    turns: GyroTurns,
    nodes: IntArray,
    sigmas: FloatArray,
    calibration: FloatArray,
    known: IntArray,
) -> FloatArray:
    """Return (M,) squared differences, in rad^2, of motions where they are significant; 0 elsewhere."""
    white, walk, *heading = sigmas.tolist()
    difference = se2.wrap_angle(turns.turn_rad - wheels.motion[:, 2])
    jacobian = _difference_jacobian(wheels, turns)
    residual = difference + jacobian @ calibration
    spacing_s = float(np.diff(nodes).max()) * 1e-9
    variance = (
        np.array(heading) ** 2 @ wheels.parts.of(HEADING_NOISE)[:, :, 2, 2]
        + wheels.parts.rest[:, 2, 2]
        + (white**2 + walk**2 * spacing_s**2 / 12.0) * turns.duration_s
    )
    extra = np.zeros(len(residual))
    extra[known] = np.where(residual**2 > _SLIP_SIGMAS**2 * variance, residual**2, 0.0)[known]
    return extra


def _curvature(cost: Callable[[FloatArray], float], at: FloatArray) -> FloatArray:
    """Return (4, 4) the second derivative of a cost by central differences."""
    h, n = 0.05, len(at)
    steps = h * np.eye(n)
    curvature = np.empty((n, n))
    for i in range(n):
        for j in range(n):
            corners = [cost(at + a * steps[i] + b * steps[j]) * a * b for a in (-1, 1) for b in (-1, 1)]
            curvature[i, j] = sum(corners) / (4.0 * h * h)
    return curvature
