"""Noise and calibration by Laplace's marginal likelihood, with exact traces of the selected inverse.

With y all variables, H the information at the minimum of the cost and s the scales of the noise, the marginal
likelihood is exp(-F), F = cost + sum ln s + 1/2 ln det H (Patterson and Thompson 1971; Kristensen et al. 2016, TMB).
Its gradient by a scale is sum tr(A) - w (e^T A e + tr(A B)) with A the share of the scale in a factor's variance,
whitened, e the whitened residual, w its weight and B = J H^-1 J^T. Its gradient by y beyond that of the cost, the tilt,
is what the joint optimum of poses and calibration lacks (Neyman and Scott 1948): without it a map is too small against
its wheels by the square of their noise.
"""

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.calib.robot import NoiseParameters
from groundsbot.offline.estimate.kernels import (
    Variables,
    errors_of_motions,
    errors_of_readings,
    selected_inverse,
    trace_motions,
    trace_readings,
    trace_ties,
)
from groundsbot.offline.estimate.problem import NU, NU_PLACES, JointProblem, Noise, PlaceScales
from groundsbot.offline.measurements import ODOMETRY_NOISE
from groundsbot.offline.sam import FrontFactor

_PRIOR_RESIDUALS: Final = 2.0  # what a default is worth
_MOST_CHANGE: Final = 4.0  # factor on a variance in one step
_GIVEN: Final = "given"
_MOST_SIGMAS: Final = 5.0  # root mean square


class NoiseStep(NamedTuple):
    """One step of the noise.

    Attributes:
        noises: of each drive.
        places: scales of places.
        tilt: what the marginal likelihood adds to the cost, by the calibration alone.
        change: the largest step in standard errors.
        counts: residuals behind each scale of each drive.
    """

    noises: list[Noise]
    places: PlaceScales
    tilt: FloatArray
    change: float
    counts: list[dict[str, float]]


def default_noise(names: Sequence[str], prior: NoiseParameters) -> Noise:
    """Return the noise before there are drives."""
    motion = np.array([getattr(prior, name) for name in ODOMETRY_NOISE])
    return Noise(motion, {name: 1.0 if name == _GIVEN else getattr(prior, name) for name in names})


def update(problem: JointProblem, values: Variables, factor: FrontFactor, defaults: Sequence[Noise]) -> NoiseStep:
    """Return the noise after one scoring step of the marginal likelihood, and the tilt at these values.

    Args:
        problem: problem with its present noise.
        values: minimum of its cost under the present tilt.
        factor: factor of the information there.
        defaults: noise of each drive before it was seen.
    """
    nodes, kinds = factor.order.nodes, factor.order.kinds
    Z = selected_inverse(nodes, factor.entries)
    tilt = np.zeros(factor.order.n)
    scratch = Variables(values.poses.copy(), values.points.copy(), values.calibration.copy())
    h = trace_motions(problem.motions, kinds[0], scratch, NU, nodes, Z, tilt)
    B = trace_readings(problem.readings, kinds[1], scratch, NU, nodes, Z, tilt)
    e, w = errors_of_motions(problem.motions, values, NU)
    er, wr = errors_of_readings(problem.readings, values, NU)
    tilt += problem.measure
    robots = [each.segment.run.robot_id for each in problem.drives]
    noises = [each.copy() for each in problem.noises]
    change = 0.0
    m0 = r0 = 0
    motion_at, reading_at = [], []
    for drive in problem.drives:
        motion_at.append(slice(m0, m0 + len(drive.segment.odometry)))
        reading_at.append(slice(r0, r0 + len(drive.segment.observations)))
        m0, r0 = motion_at[-1].stop, reading_at[-1].stop
    done: dict[str, int] = {}
    counts = [dict[str, float]() for _ in robots]
    for d, robot in enumerate(robots):
        if robot in done:
            noises[d], counts[d] = noises[done[robot]].copy(), counts[done[robot]]
            continue
        done[robot] = d
        same = [k for k, other in enumerate(robots) if other == robot]
        own = np.concatenate([np.arange(*motion_at[k].indices(m0)) for k in same])
        shares = noises[d].motion[:, None, None] ** 2 * problem.motion_units[:, own] / problem.motions.sigma[own] ** 2
        found = (shares * w[own] * e[own] ** 2).sum(axis=(1, 2))
        expected = (shares * (1.0 - w[own] * h[own])).sum(axis=(1, 2))
        counts[d] = dict(zip(ODOMETRY_NOISE, expected.tolist(), strict=True))
        noises[d].motion, most = _rescale(noises[d].motion, defaults[d].motion, found, expected)
        change = max(change, most)
        names = problem.reading_units[d][0]
        found, expected = np.zeros(len(names)), np.zeros(len(names))
        present = np.array([noises[d].reading[name] for name in names])
        for k in same:
            at = reading_at[k]
            W = problem.readings.whitening[at]
            A = present[:, None, None, None] ** 2 * (W @ problem.reading_units[k][1] @ W.swapaxes(-1, -2))
            found += np.einsum("kmij,m,mi,mj->k", A, wr[at], er[at], er[at])
            expected += np.einsum("kmii->k", A) - np.einsum("kmij,m,mij->k", A, wr[at], B[at])
        before = np.array([defaults[d].reading[name] for name in names])
        counts[d] |= dict(zip(names, expected.tolist(), strict=True))
        scaled, most = _rescale(present, before, found, expected)
        noises[d].reading = dict(zip(names, scaled.tolist(), strict=True))
        change = max(change, most)
    scales = []
    for ties, kind, nu, scale, default in (
        (problem.joint_ties, kinds[2], NU_PLACES, problem.places.of_drive_m, PlaceScales.of_drive_m),
        (problem.pass_ties, kinds[3], NU, problem.places.of_pass_m, PlaceScales.of_pass_m),
    ):
        hp = trace_ties(ties, kind, scratch, nu, nodes, Z, tilt)
        et = (
            np.exp(-values.calibration[ties.unit])[:, None]
            * (values.points[ties.case] - values.points[ties.general])
            / scale
        )
        Q = (et**2).sum(axis=1)
        wt = (nu + 2.0) / (nu + Q)
        scaled, most = _rescale(
            np.array([scale]), np.array([default]), np.array([(wt * Q).sum()]), np.array([(2.0 - wt * hp).sum()])
        )
        scales.append(float(scaled[0]))
        change = max(change, most)
    return NoiseStep(
        noises, PlaceScales(*scales), _of_calibration(tilt, factor, problem.free_parameters), change, counts
    )


def _of_calibration(gradient: FloatArray, factor: FrontFactor, columns: IntArray) -> FloatArray:
    """Return the gradient (n,) by the calibration alone, with all else at its minimum for each calibration.

    With x all else, it is t_c - H_cx H_xx^-1 t_x, which is S (H^-1 t)_c with S^-1 the covariance of the calibration. It
    is of second order in the noise, and held to what moves the calibration by some sigmas.
    """
    found = np.zeros_like(gradient)
    if len(columns):
        shift = factor.solve(gradient)[columns]
        slope = np.linalg.solve(factor.covariance(columns), shift)
        squared_sigmas = float(slope @ shift) / len(columns)
        found[columns] = slope * min(1.0, _MOST_SIGMAS / max(squared_sigmas, 1e-12) ** 0.5)
    return found


def _rescale(
    scale: FloatArray, default: FloatArray, found: FloatArray, expected: FloatArray
) -> tuple[FloatArray, float]:
    """Return scales after one step to the maximum, and the largest step in standard errors.

    A variance is multiplied by the sum of squares of its share over what is expected of it, which never overshoots
    where several variances share one error. The prior is that of a few more residuals of the default scale.

    Args:
        scale: scales.
        default: their values before.
        found: weighted sums of squares of the whitened residuals that are each scale's share.
        expected: number of residuals that are its share, without those that the variables take.
    """
    expected = np.maximum(expected, 0.0) + _PRIOR_RESIDUALS
    factor = np.clip((found + _PRIOR_RESIDUALS * (default / scale) ** 2) / expected, 1.0 / _MOST_CHANGE, _MOST_CHANGE)
    change = float(np.max(np.abs(0.5 * np.log(factor)) * np.sqrt(2.0 * expected)))
    return scale * np.sqrt(factor), change
