"""Wheels and gyro -> one motion: the heading by the information of both, and what their difference says of either.

The turn by the gyro is a measurement of the motion's heading by the wheels: a Kalman update of the motion's right
tangent with gain K, whose covariance C' = (I - K h) C (I - K h)^T + K v K^T (Joseph's form) stays a sum of known
matrices times variances. The update spends one of four measured numbers; the one that is left, the difference of both
turns, depends on the calibration alone. All differences of a segment together are a linear factor on it, which holds
the gyro's bias and scale and the wheels' track wherever the robot stands or drives straight (Bar-Shalom, Li and
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
from groundsbot.offline.measurements.motion_model.gyro import (
    GyroSamples,
    GyroTurns,
    HeadingDifferences,
    bias_nodes,
    noise_density,
)
from groundsbot.offline.measurements.motion_model.motion_model import SegmentOdometry

HEADING_NOISE: Final = ("sigma_heading_rad_per_sqrt_m", "sigma_heading_rad_per_sqrt_rad")
# Differences are summed over about so long for the fit of the noise.
_BLOCK_S: Final = 0.5
# Beyond so many sigmas wheels have slipped: once in 15,000 motions by chance.
_SLIP_SIGMAS: Final = 4.0
_TOLD_SLIP_RAD: Final = np.radians(2.0)
_ROUNDS: Final = 3
# Sigmas are looked for up to a thousand times from where they are expected.
_MOST_LOG: Final = float(np.log(1e3))
# A gyro that turns less or more than this share of what the wheels do has another axis, sign or unit; tracked robots
# turn half as far as their wheels say.
_RATIOS: Final = (0.3, 3.0)
_TURNS_RAD: Final = 1.0  # of root-sum-square over half seconds, for the ratio to mean anything
# How far off a data sheet may be, as a factor at one sigma; of the wheels nobody knows it better than that.
_FACTOR_GYRO: Final = 3.0
_FACTOR_WHEELS: Final = 30.0


@dataclass(frozen=True)
class GyroFit:
    """Noise of a gyro and of the wheels' turns, as their differences show it.

    Attributes:
        gyro: with the noise that was fitted.
        heading_sigmas: (2,) of HEADING_NOISE.
        interval: (4, 2) 99 % bounds of white noise, bias walk and HEADING_NOISE.
        extra_variance: (M,) rad^2 of motions in which the wheels slipped; 0 where they did not.
    """

    gyro: Gyro
    heading_sigmas: FloatArray
    interval: FloatArray
    extra_variance: FloatArray

    @property
    def slip_warnings(self) -> list[str]:
        """Say where wheels slipped by so much that it matters to whoever drives; nothing where they did not."""
        slips_rad = np.sqrt(self.extra_variance)
        largest_rad = float(slips_rad.max(initial=0.0))
        if largest_rad < _TOLD_SLIP_RAD:
            return []
        n = int((slips_rad >= _TOLD_SLIP_RAD).sum())
        motions, most_deg = plural(n, "motion"), np.degrees(largest_rad)
        sentence = (
            f"the wheels slipped in {motions}: they turned by up to {most_deg:.0f} degrees otherwise than the gyro"
        )
        return [f"{sentence}, whose heading counts there"]


class FusedOdometry(NamedTuple):
    """Motions with the gyro where it is of use, the fit of its noise, and warnings."""

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
    """Fuse the motions of a segment with its gyro, under the noise that their differences show.

    Args:
        wheels: motions by the wheels alone.
        samples: of the gyro.
        stamps_ns: (K,) of the keyframes.
        gyro: what is known of it before the drive.
        sigmas: (3,) prior sigmas of WHEEL_PARAMETERS.
        noise: of all else.
        owner: of the bias.

    Returns:
        The motions by the wheels, and no fit, where the gyro covers none of them or turns unlike the robot.
    """
    nodes = bias_nodes(int(stamps_ns[0]), int(stamps_ns[-1]), gyro)
    turns = samples.turns(stamps_ns, nodes)
    if not turns.is_known.any():
        return FusedOdometry(wheels, None, [])
    ratio = turn_ratio(wheels, turns)
    if ratio is not None and not _RATIOS[0] < ratio < _RATIOS[1]:
        sentence = f"the gyro turns {ratio:.2f} times as far as the wheels: another axis, sign or unit? It is left out"
        return FusedOdometry(wheels, None, [sentence])
    fit = _fit(wheels, turns, gyro, nodes, sigmas, noise)
    own = noise.model_copy(update=dict(zip(HEADING_NOISE, fit.heading_sigmas.tolist(), strict=True)))
    nodes = bias_nodes(int(stamps_ns[0]), int(stamps_ns[-1]), fit.gyro)
    fused = fuse(wheels.with_noise(own), samples.turns(stamps_ns, nodes), nodes, fit, own, owner)
    return FusedOdometry(fused, fit, fit.slip_warnings)


def turn_ratio(wheels: SegmentOdometry, turns: GyroTurns) -> float | None:
    """Return the regression of the gyro's turns on those of the wheels; None where these turn too little."""
    known = np.flatnonzero(turns.is_known)
    _, block = np.unique(np.floor(np.cumsum(turns.duration_s) / _BLOCK_S)[known], return_inverse=True)
    n = int(block.max(initial=-1)) + 1
    duration_s = _sum_by_block(block, turns.duration_s[known], n)
    rates = [_sum_by_block(block, each[known], n) / duration_s for each in (wheels.motion[:, 2], turns.turn_rad)]
    by_wheels, by_gyro = ((rate - np.median(rate)) * duration_s for rate in rates)
    square = float(by_wheels @ by_wheels)
    return float(by_wheels @ by_gyro) / square if square > _TURNS_RAD**2 else None


def fuse(
    wheels: SegmentOdometry,
    turns: GyroTurns,
    node_stamps_ns: IntArray,
    fit: GyroFit,
    noise: NoiseParameters,
    owner: str,
) -> SegmentOdometry:
    """Motions with the heading by both, and the differences that are left.

    Args:
        wheels: under the noise.
        turns: between the same keyframes.
        node_stamps_ns: (n,) of the bias.
        fit: of the gyro's noise and the wheels' slips.
        noise: of the wheels.
        owner: of the bias.
    """
    slipped = np.zeros_like(wheels.covariance)
    slipped[:, 2, 2] = fit.extra_variance
    C = wheels.covariance + slipped
    variance = noise_density(fit.gyro, node_stamps_ns) * turns.duration_s
    K = np.where(turns.is_known[:, None], C[:, :, 2] / (C[:, 2, 2] + variance)[:, None], 0.0)
    A = np.tile(np.eye(3), (len(K), 1, 1))
    A[:, :, 2] -= K
    difference = se2.wrap_angle(turns.turn_rad - wheels.motion[:, 2])

    def carry(covariance: FloatArray) -> FloatArray:
        return np.asarray(A @ covariance @ A.swapaxes(-1, -2))

    # Settled by the differences, so that no fit of the noise on tags looks for it again.
    is_heading = np.isin(wheels.parts.names, HEADING_NOISE)[:, None, None, None]
    heading = np.tensordot(fit.heading_sigmas**2, wheels.parts.of(HEADING_NOISE), 1)
    parts = replace(
        wheels.parts,
        unit=carry(np.where(is_heading, 0.0, wheels.parts.unit)),
        rest=carry(heading + wheels.parts.rest + slipped) + variance[:, None, None] * K[:, :, None] * K[:, None, :],
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
    """Differences of B blocks of motions, with what they depend on and what their variances are made of.

    Attributes:
        difference_rad: (B,)
        jacobian: (B, P) by the wheels' parameters, GYRO_PARAMETERS and the bias at its nodes.
        unit: (3, B) variances for a sigma of one of white noise and HEADING_NOISE.
        rest: (B,) variance whatever these are.
        prior_sigma: (P,) of what is no node.
        spacing_s: (n - 1,) between nodes.
    """

    difference_rad: FloatArray
    jacobian: FloatArray
    unit: FloatArray
    rest: FloatArray
    prior_sigma: FloatArray
    spacing_s: FloatArray

    def solve(self, sigmas: FloatArray, extra: FloatArray) -> tuple[float, FloatArray]:
        """Minus twice the log likelihood with the calibration marginalised, and the calibration (P,).

        Args:
            sigmas: (4,) white noise, bias walk, HEADING_NOISE.
            extra: (B,) more variance.
        """
        white, walk, *heading = sigmas.tolist()
        variance = np.array([white, *heading]) ** 2 @ self.unit + self.rest + extra
        n_nodes = len(self.spacing_s) + 1
        variance += walk**2 * float(self.spacing_s.max()) ** 2 / 12.0 * self.unit[0]
        step = walk * np.sqrt(self.spacing_s)
        ties = np.zeros((n_nodes - 1, self.jacobian.shape[1]))
        ties[:, -n_nodes:] = np.diff(np.eye(n_nodes), axis=0) / step[:, None]
        prior = np.zeros((len(self.prior_sigma), self.jacobian.shape[1]))
        prior[:, : len(self.prior_sigma)] = np.diag(1.0 / self.prior_sigma)
        root = self.jacobian / np.sqrt(variance)[:, None]
        information = ties.T @ ties + prior.T @ prior
        posterior = information + root.T @ root
        weighted = self.difference_rad / variance
        calibration = -np.linalg.solve(posterior, self.jacobian.T @ weighted)
        square = float(self.difference_rad @ weighted + (self.jacobian.T @ weighted) @ calibration)
        log_determinant = np.log(variance).sum() + np.linalg.slogdet(posterior)[1] + 2.0 * np.log(step).sum()
        return square + float(log_determinant), np.asarray(calibration, dtype=np.float64)


def _fit(
    wheels: SegmentOdometry, turns: GyroTurns, gyro: Gyro, nodes: IntArray, sigmas: FloatArray, noise: NoiseParameters
) -> GyroFit:
    """Maximum likelihood of four sigmas under wide log-normal priors; motions that slip get a variance of their own."""
    block_of = np.floor(np.cumsum(turns.duration_s) / _BLOCK_S).astype(np.int64)
    known = np.flatnonzero(turns.is_known)
    blocks = _blocks(wheels, turns, gyro, nodes, sigmas, known, block_of)
    start = np.array(
        [
            gyro.noise_rad_per_sqrt_s,
            gyro.bias_walk_rad_s_per_sqrt_s,
            *(getattr(noise, name) for name in HEADING_NOISE),
        ]
    )
    width = np.log([_FACTOR_GYRO, _FACTOR_GYRO, _FACTOR_WHEELS, _FACTOR_WHEELS])
    _, block = np.unique(block_of[known], return_inverse=True)
    extra = np.zeros(len(turns.turn_rad))
    found = np.zeros(4)
    of_blocks = np.zeros(len(blocks.rest))

    def cost(logs: FloatArray) -> float:
        return blocks.solve(start * np.exp(logs), of_blocks)[0] + float(((logs / width) ** 2).sum())

    for _ in range(_ROUNDS):
        found = np.asarray(minimize(cost, found, method="L-BFGS-B", bounds=[(-_MOST_LOG, _MOST_LOG)] * 4).x)
        _, calibration = blocks.solve(start * np.exp(found), of_blocks)
        extra = _slips(wheels, turns, nodes, start * np.exp(found), calibration, known)
        of_blocks[:] = _sum_by_block(block, extra[known], len(of_blocks))
    sigma = np.sqrt(np.diag(np.linalg.pinv(0.5 * _curvature(cost, found))))
    white, walk, *heading = (start * np.exp(found)).tolist()
    return GyroFit(
        gyro=gyro.model_copy(update={"noise_rad_per_sqrt_s": white, "bias_walk_rad_s_per_sqrt_s": walk}),
        heading_sigmas=np.array(heading),
        interval=(start * np.exp(found))[:, None] * np.exp(2.576 * sigma[:, None] * [-1.0, 1.0]),
        extra_variance=extra,
    )


def _blocks(
    wheels: SegmentOdometry,
    turns: GyroTurns,
    gyro: Gyro,
    nodes: IntArray,
    sigmas: FloatArray,
    known: IntArray,
    block_of: IntArray,
) -> _DifferenceBlocks:
    _, block = np.unique(block_of[known], return_inverse=True)
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
        # Ticks: what one motion counts too much the next one counts too little.
        rest=np.bincount(block, other, n) / per_block,
        prior_sigma=np.array([*sigmas, gyro.scale_sigma, gyro.time_offset_s_sigma, gyro.bias_rad_s_sigma]),
        spacing_s=np.diff(nodes) * 1e-9,
    )


def _difference_jacobian(wheels: SegmentOdometry, turns: GyroTurns) -> FloatArray:
    """(M, P) derivative of the differences by WHEEL_PARAMETERS, GYRO_PARAMETERS and the bias.

    The true turn is that of the wheels and noise, so the gyro's turn is regressed on that of the wheels,
    by its scale too: with a scale times the gyro's own turn, noise would shrink with scale and track together, and the
    best fit would be a robot that does not turn, wherever the prior of the track is wide.
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
    """(M,) rad^2 by which motions differ beyond chance."""
    white, walk, *heading = sigmas.tolist()
    difference = se2.wrap_angle(turns.turn_rad - wheels.motion[:, 2])
    jacobian = _difference_jacobian(wheels, turns)
    rest = difference + jacobian @ calibration
    spacing_s = float(np.diff(nodes).max()) * 1e-9
    variance = (
        np.array(heading) ** 2 @ wheels.parts.of(HEADING_NOISE)[:, :, 2, 2]
        + wheels.parts.rest[:, 2, 2]
        + (white**2 + walk**2 * spacing_s**2 / 12.0) * turns.duration_s
    )
    extra = np.zeros(len(rest))
    extra[known] = np.where(rest**2 > _SLIP_SIGMAS**2 * variance, rest**2, 0.0)[known]
    return extra


def _curvature(cost: Callable[[FloatArray], float], at: FloatArray) -> FloatArray:
    """(4, 4) second derivative of a cost by central differences."""
    h, n = 0.05, len(at)
    steps = h * np.eye(n)
    curvature = np.empty((n, n))
    for i in range(n):
        for j in range(n):
            corners = [cost(at + a * steps[i] + b * steps[j]) * a * b for a in (-1, 1) for b in (-1, 1)]
            curvature[i, j] = sum(corners) / (4.0 * h * h)
    return curvature
