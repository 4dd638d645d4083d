"""Fuses wheel odometry with a gyro.

The turn by the gyro is a measurement of the heading of each motion. A Kalman update of the motion's right tangent with
gain K has the covariance C' = (I - K h) C (I - K h)^T + K v K^T (Joseph form), which remains linear in the variances of
the noise parameters. Wheels and gyro measure four numbers, and the fused motion has three. The fourth, the difference
of the two turns, depends on the calibration alone. All differences of a segment form one linear factor, which makes the
gyro's bias and scale and the wheels' track observable where the robot stands or drives straight (Bar-Shalom, Li and
Kirubarajan, "Estimation with applications to tracking and navigation", 2001, section 5.2).
"""

from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
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
from groundsbot.offline.measurements.motion_model.heading_noise import (
    HEADING_NOISE,
    GyroFit,
    difference_jacobian,
    fit_heading_noise,
    known_blocks,
    slip_variances,
    sum_by_block,
)
from groundsbot.offline.measurements.motion_model.motion_model import SegmentOdometry

# A ratio of the gyro's turns to the wheels' outside of this comes from a wrong axis, sign or unit. That of tracked
# robots is about one half.
_RATIOS: Final = (0.3, 3.0)
_WINDOW_PERIODS: Final = 2.0  # over which trapezoids smooth the heading
_TURNS_RAD: Final = 1.0  # least root-sum-square turn by the wheels, over half seconds, that determines the ratio


class FusedOdometry(NamedTuple):
    """Fused motions.

    Attributes:
        odometry: the motions.
        fit: fit of the noise; None where the gyro is not used.
        heading_jitter_rad: (K,) sigma of what the headings at the keyframes lack (`heading_jitter_rad`).
        warnings: messages for the user.
    """

    odometry: SegmentOdometry
    fit: GyroFit | None
    heading_jitter_rad: FloatArray
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
        samples: samples of the gyro.
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
        return FusedOdometry(wheels, None, np.zeros(len(stamps_ns)), [])
    ratio = turn_ratio(wheels, turns)
    if ratio is not None and not _RATIOS[0] < ratio < _RATIOS[1]:
        warning = (
            f"the gyro turns {ratio:.2f} times as far as the wheels, so it is not used; check the axis, sign and unit "
            "of /gyro"
        )
        return FusedOdometry(wheels, None, np.zeros(len(stamps_ns)), [warning])
    fit = fit_heading_noise(wheels, turns, gyro, nodes, sigmas, noise)
    own = noise.model_copy(update=dict(zip(HEADING_NOISE, fit.heading_sigmas.tolist(), strict=True)))
    nodes = bias_nodes(int(stamps_ns[0]), int(stamps_ns[-1]), fit.gyro)
    turns = samples.turns(stamps_ns, nodes)
    fused = fuse(wheels.with_noise(own), turns, nodes, fit, own, owner)
    return FusedOdometry(fused, fit, heading_jitter_rad(wheels, turns, samples.period_s, fit), fit.slip_warnings)


class GyroEstimate(NamedTuple):
    """A calibration of wheels and gyro that is estimated already, as by an online localizer.

    Attributes:
        gyro: gyro with its noise.
        calibration: (6,) corrections of WHEEL_PARAMETERS and GYRO_PARAMETERS, and the bias in rad/s.
        covariance: (6, 6)
    """

    gyro: Gyro
    calibration: FloatArray
    covariance: FloatArray


def with_estimated_gyro(
    wheels: SegmentOdometry,
    samples: GyroSamples,
    stamps_ns: IntArray,
    estimate: GyroEstimate,
    noise: NoiseParameters,
    owner: str,
) -> FusedOdometry:
    """Fuse motions with a gyro whose noise is known; the bias is one for all of them.

    The wheels have slipped in motions whose difference contradicts the estimate. Where the gyro covers none of the
    motions, they are those by the wheels, without a fit.

    Args:
        wheels: motions by the wheels alone.
        samples: samples of the gyro.
        stamps_ns: (K,) of the keyframes.
        estimate: calibration and noise.
        noise: other noise parameters.
        owner: the segment that the bias belongs to.
    """
    node, by_wheels = stamps_ns[:1], FusedOdometry(wheels, None, np.zeros(len(stamps_ns)), [])
    if not len(wheels.motion):
        return by_wheels
    turns = samples.turns(stamps_ns, node)
    if not turns.is_known.any():
        return by_wheels
    heading_sigmas = np.array([getattr(noise, name) for name in HEADING_NOISE])
    sigmas = np.array([estimate.gyro.noise_rad_per_sqrt_s, estimate.gyro.bias_walk_rad_s_per_sqrt_s, *heading_sigmas])
    known = np.flatnonzero(turns.is_known)
    extra = slip_variances(wheels, turns, node, sigmas, estimate.calibration, known, estimate.covariance)
    fit = GyroFit(estimate.gyro, heading_sigmas, extra)
    fused = fuse(wheels, turns, node, fit, noise, owner)
    return FusedOdometry(fused, fit, heading_jitter_rad(wheels, turns, samples.period_s, fit), [])


def heading_jitter_rad(wheels: SegmentOdometry, turns: GyroTurns, period_s: float, fit: GyroFit) -> FloatArray:
    """Return (K,) the sigma of the difference of the heading at each keyframe from the gyro's integral, less its drift.

    Between two samples the gyro does not resolve the heading: trapezoids over mean rates of each period give the mean
    heading over about two periods. A random walk of variance q per second deviates from its mean over a window w by the
    variance q w / 12. The deviations at successive keyframes are independent. They do not accumulate, so they are
    errors of what is observed from the keyframes, and no noise of the motions.

    Args:
        wheels: the K - 1 motions, whose heading noise is the random walk.
        turns: between the same keyframes.
        period_s: between samples.
        fit: fit with the wheels' heading noise.
    """
    unit = wheels.parts.of(HEADING_NOISE)[..., 2, 2]
    added = np.where(turns.is_known, np.tensordot(fit.heading_sigmas**2, unit, 1), 0.0)
    # The rate of the random walk at a keyframe is that of both motions beside it.
    variance, duration_s = (np.append(0.0, each) + np.append(each, 0.0) for each in (added, turns.duration_s))
    return np.asarray(np.sqrt(_WINDOW_PERIODS * period_s / 12.0 * variance / duration_s))


def turn_ratio(wheels: SegmentOdometry, turns: GyroTurns) -> float | None:
    """Return the regression of the gyro's turns on those of the wheels; None where the wheels turn too little."""
    known, block = known_blocks(turns)
    n = int(block.max(initial=-1)) + 1
    duration_s = sum_by_block(block, turns.duration_s[known], n)
    rates = [sum_by_block(block, each[known], n) / duration_s for each in (wheels.motion[:, 2], turns.turn_rad)]
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
    """Update the heading of each motion by the gyro, and add the differences as a factor on the calibration.

    Args:
        wheels: motions with the covariances of `noise`.
        turns: between the same keyframes.
        node_stamps_ns: (n,) of the bias.
        fit: the gyro's noise and the wheels' slips.
        noise: noise of the wheels.
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
    jacobian = difference_jacobian(wheels, turns)
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
