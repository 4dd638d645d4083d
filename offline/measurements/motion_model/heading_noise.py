"""Estimates the noise of a gyro and of the wheels' turns from the difference of both, and detects slip."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray, plural
from groundsbot.calib.geometry import se2
from groundsbot.calib.robot import Gyro, NoiseParameters
from groundsbot.offline.measurements.motion_model.gyro import GyroTurns
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
# Prior uncertainty of a sigma, as a factor at one sigma: of the gyro's data sheet, and of the wheels' defaults.
_FACTOR_GYRO: Final = 3.0
_FACTOR_WHEELS: Final = 30.0


@dataclass(frozen=True)
class GyroFit:
    """The noise of a gyro and of the wheels' turns, fitted to the differences of their turns.

    Attributes:
        gyro: gyro with the fitted noise.
        heading_sigmas: (2,) of HEADING_NOISE.
        extra_variance: (M,) rad^2 added to motions in which the wheels slipped; 0 elsewhere.
    """

    gyro: Gyro
    heading_sigmas: FloatArray
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


def fit_heading_noise(
    wheels: SegmentOdometry, turns: GyroTurns, gyro: Gyro, nodes: IntArray, sigmas: FloatArray, noise: NoiseParameters
) -> GyroFit:
    """Maximise the posterior of four sigmas under wide log-normal priors; motions with slip get additional variance."""
    from scipy.optimize import minimize  # takes a tenth of a second to load, and few robots have a gyro

    known, block = known_blocks(turns)
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
        extra = slip_variances(wheels, turns, nodes, start * np.exp(logs), calibration, known)
        block_extra[:] = sum_by_block(block, extra[known], len(block_extra))
    white, walk, *heading = (start * np.exp(logs)).tolist()
    return GyroFit(
        gyro=gyro.model_copy(update={"noise_rad_per_sqrt_s": white, "bias_walk_rad_s_per_sqrt_s": walk}),
        heading_sigmas=np.array(heading),
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
    jacobian = difference_jacobian(wheels, turns)[known]
    heading = wheels.parts.of(HEADING_NOISE)[:, known, 2, 2]
    other = wheels.parts.rest[known, 2, 2]
    n = int(block.max()) + 1
    per_block = np.bincount(block, minlength=n)
    return _DifferenceBlocks(
        difference_rad=sum_by_block(block, difference, n),
        jacobian=np.stack([np.bincount(block, column, n) for column in jacobian.T], axis=1),
        unit=np.stack([np.bincount(block, each, n) for each in (turns.duration_s[known], *heading)]),
        # The rest is mostly quantisation, whose errors cancel between successive motions.
        rest=np.bincount(block, other, n) / per_block,
        prior_sigma=np.array([*sigmas, gyro.scale_sigma, gyro.time_offset_s_sigma, gyro.bias_rad_s_sigma]),
        spacing_s=np.diff(nodes) * 1e-9,
    )


def known_blocks(turns: GyroTurns) -> tuple[IntArray, IntArray]:
    """Return (N,) the intervals with a known turn, and (N,) the number from 0 of the block of time each is in."""
    known = np.flatnonzero(turns.is_known)
    _, block = np.unique(np.floor(np.cumsum(turns.duration_s) / _BLOCK_S)[known], return_inverse=True)
    return known, np.asarray(block, dtype=np.int64)


def difference_jacobian(wheels: SegmentOdometry, turns: GyroTurns) -> FloatArray:
    """Return (M, P) the derivative of the differences with respect to WHEEL_PARAMETERS, GYRO_PARAMETERS and the bias.

    The gyro's turn is regressed on that of the wheels, so its scale multiplies the turn by the wheels. If it multiplied
    the gyro's own turn, the residuals would shrink with scale and track together. Where the prior of the track is wide,
    the best fit would then be a robot that does not turn.
    """
    turn_rad = wheels.motion[:, 2]
    return np.column_stack([-wheels.jacobian[:, 2], turn_rad, turns.jacobian[:, 1:]])


def sum_by_block(block: IntArray, values: FloatArray, n: int) -> FloatArray:
    """Return (n,) the sums of values (N,) over n blocks, given the block of each."""
    return np.asarray(np.bincount(block, values, n), dtype=np.float64)


def slip_variances(
    wheels: SegmentOdometry,
    turns: GyroTurns,
    nodes: IntArray,
    sigmas: FloatArray,
    calibration: FloatArray,
    known: IntArray,
    covariance: FloatArray | None = None,
) -> FloatArray:
    """Return (M,) squared differences, in rad^2, of motions where they are significant; 0 elsewhere.

    Args:
        wheels: the M motions by the wheels.
        turns: turns measured by the gyro.
        nodes: stamps of the bias.
        sigmas: (4,) white noise, bias walk, HEADING_NOISE.
        calibration: (P,) estimated corrections of wheels, gyro and bias.
        known: the motions that the gyro covers.
        covariance: (P, P) of the calibration; None: negligible.
    """
    white, walk, *heading = sigmas.tolist()
    difference = se2.wrap_angle(turns.turn_rad - wheels.motion[:, 2])
    jacobian = difference_jacobian(wheels, turns)
    residual = difference + jacobian @ calibration
    spacing_s = float(np.diff(nodes).max(initial=0)) * 1e-9
    variance = (
        np.array(heading) ** 2 @ wheels.parts.of(HEADING_NOISE)[:, :, 2, 2]
        + wheels.parts.rest[:, 2, 2]
        + (white**2 + walk**2 * spacing_s**2 / 12.0) * turns.duration_s
    )
    if covariance is not None:
        variance = variance + np.einsum("mp,pq,mq->m", jacobian, covariance, jacobian)
    extra = np.zeros(len(residual))
    extra[known] = np.where(residual**2 > _SLIP_SIGMAS**2 * variance, residual**2, 0.0)[known]
    return extra
