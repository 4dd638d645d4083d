"""Noise and calibration by Laplace's marginal likelihood, with exact traces of the selected inverse.

With y all variables, H the information at the minimum of the cost and s the scales of the noise, the marginal
likelihood is exp(-F), F = cost + sum ln s + 1/2 ln det H (Patterson and Thompson 1971; Kristensen et al. 2016, TMB).
Its gradient by a scale is sum tr(A) - w (e^T A e + tr(A B)) with A the share of the scale in a factor's variance,
whitened, e the whitened residual, w its weight and B = J H^-1 J^T. The scales take Newton's steps with the average
information (Gilmour, Thompson and Cullis 1995, "Average information REML").

The gradient by y beyond that of the cost, the tilt, is what the joint optimum of poses and calibration lacks (Neyman
and Scott 1948): without it a map is too small against its wheels by the square of their noise.
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
    errors_of_ties,
    pull_motions,
    pull_readings,
    pull_ties,
    selected_inverse,
    trace_motions,
    trace_readings,
    trace_ties,
)
from groundsbot.offline.estimate.problem import NU, NU_PLACES, JointProblem, Noise, PlaceScales
from groundsbot.offline.measurements import ODOMETRY_NOISE
from groundsbot.offline.sam import FrontFactor

_PRIOR_RESIDUALS: Final = 2.0  # what a default is worth
_MOST_CHANGE: Final = 1.4  # of the logarithm of a variance in one step
_GIVEN: Final = "given"
_MOST_SIGMAS: Final = 5.0  # root mean square


class NoiseStep(NamedTuple):
    """One step of the noise.

    Attributes:
        noises: of each drive.
        places: scales of places.
        tilt: what the marginal likelihood adds to the cost, by the calibration alone.
        change: length of the step in standard errors, root mean square.
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


class _Robot(NamedTuple):
    """The scales of one robot, from the `first` one on: those of its motions, then those of its readings by name."""

    first: int
    names: tuple[str, ...]
    drives: tuple[int, ...]


class _Scales:
    """All K scales in a row: those of each robot, that of places of drives, that of places of passes.

    Attributes:
        robots: in the order of their first drives.
        present, default: (K,) values, and those before the drives were seen.
    """

    def __init__(self, problem: JointProblem, defaults: Sequence[Noise]) -> None:
        self._problem = problem
        self.robots: list[_Robot] = []
        present, default = list[float](), list[float]()
        owners = [each.segment.run.robot_id for each in problem.drives]
        for owner in dict.fromkeys(owners):
            drives = tuple(d for d, other in enumerate(owners) if other == owner)
            of_readings: dict[str, float] = {}
            before: dict[str, float] = {}
            for d in reversed(drives):
                of_readings |= problem.noises[d].reading
                before |= defaults[d].reading
            names = tuple(of_readings)
            self.robots.append(_Robot(len(present), names, drives))
            present += [*problem.noises[drives[0]].motion.tolist(), *of_readings.values()]
            default += [*defaults[drives[0]].motion.tolist(), *(before[name] for name in names)]
        self.present = np.array([*present, problem.places.of_drive_m, problem.places.of_pass_m])
        self.default = np.array([*default, PlaceScales.of_drive_m, PlaceScales.of_pass_m])

    def units(self, robot: _Robot) -> tuple[IntArray, FloatArray, IntArray, FloatArray]:
        """Return a robot's motions, their variances (4, M, 3) for unit noise, and the same (k, M, 2, 2) of readings."""
        drives = self._problem.drives
        ends = np.cumsum(
            [(0, 0)] + [(len(each.segment.odometry), len(each.segment.observations)) for each in drives], 0
        )
        motions, readings = (
            np.concatenate([np.arange(ends[d, kind], ends[d + 1, kind]) for d in robot.drives]) for kind in (0, 1)
        )
        units = []
        for d in robot.drives:
            names, own = self._problem.reading_units[d]
            units.append(np.zeros((len(robot.names), *own.shape[1:])))
            units[-1][[robot.names.index(name) for name in names]] = own
        return motions, self._problem.motion_units[:, motions], readings, np.concatenate(units, axis=1)

    def noises(
        self, scales: FloatArray, expected: FloatArray
    ) -> tuple[list[Noise], list[dict[str, float]], PlaceScales]:
        """Return the noise of each drive, the residuals behind each of its scales, and the scales of places."""
        noises, counts = {}, {}
        for robot in self.robots:
            at = slice(robot.first, robot.first + 4 + len(robot.names))
            own, names = scales[at], (*ODOMETRY_NOISE, *robot.names)
            for d in robot.drives:
                noises[d] = Noise(own[:4].copy(), dict(zip(robot.names, own[4:].tolist(), strict=True)))
                counts[d] = dict(zip(names, expected[at].tolist(), strict=True))
        n = len(noises)
        return [noises[d] for d in range(n)], [counts[d] for d in range(n)], PlaceScales(*scales[-2:].tolist())


class _Score:
    """The derivatives of the marginal likelihood by all scales.

    Attributes:
        found: (K,) weighted sums of squares of the whitened residuals that are each scale's share.
        expected: (K,) number of residuals that are its share, without those that the variables take.
        information: (K, K) about the logarithms of the variances, without what the variables take of it.
        pulls: (K, n) gradients of the cost by the variables as far as they are each scale's share.
    """

    def __init__(self, n_scales: int, n: int) -> None:
        self.found, self.expected = np.zeros(n_scales), np.zeros(n_scales)
        self.information, self.pulls = np.zeros((n_scales, n_scales)), np.zeros((n_scales, n))

    def add(self, first: int, A: FloatArray, e: FloatArray, w: FloatArray, B: FloatArray) -> FloatArray:
        """Add factors of scales from `first` on; return their shares of the gradients by the residuals (k, M, d).

        Args:
            first: the first of k scales.
            A: (k, M, d, d) shares of the scales in the variance of each factor, whitened.
            e: (M, d) whitened residuals.
            w: (M,) weights.
            B: (M, d, d) J H^-1 J^T.
        """
        moved = np.einsum("kmij,mj->kmi", A, e)
        at = slice(first, first + len(A))
        self.found[at] += np.einsum("kmi,m,mi->k", moved, w, e)
        self.expected[at] += np.einsum("kmii->k", A) - np.einsum("kmij,m,mij->k", A, w, B)
        self.information[at, at] += 0.5 * np.einsum("kmi,m,lmi->kl", moved, w, moved)
        return np.ascontiguousarray(moved * w[:, None])

    def step(self, scales: _Scales, factor: FrontFactor) -> tuple[FloatArray, float]:
        """Return the scales after one step, and its length in standard errors, root mean square."""
        Z = factor.whiten(self.pulls)
        of_prior = _PRIOR_RESIDUALS * (scales.default / scales.present) ** 2
        gradient = 0.5 * (self.found - self.expected + of_prior - _PRIOR_RESIDUALS)
        information = self.information - 0.5 * Z @ Z.T + np.diag(0.5 * np.maximum(of_prior, _PRIOR_RESIDUALS))
        step = np.linalg.solve(information, gradient)
        length = float(np.sqrt(max(gradient @ step, 0.0) / len(step)))
        return scales.present * np.exp(0.5 * np.clip(step, -_MOST_CHANGE, _MOST_CHANGE)), length


def update(problem: JointProblem, values: Variables, factor: FrontFactor, defaults: Sequence[Noise]) -> NoiseStep:
    """Return the noise after one step to the maximum of the marginal likelihood, and the tilt at these values.

    Args:
        problem: problem with its present noise.
        values: minimum of its cost under the present tilt.
        factor: factor of the information there.
        defaults: noise of each drive before it was seen.
    """
    scales = _Scales(problem, defaults)
    score, tilt = _derivatives(problem, values, factor, scales)
    changed, length = score.step(scales, factor)
    noises, counts, places = scales.noises(changed, score.expected)
    return NoiseStep(noises, places, _of_calibration(tilt, factor, problem.free_parameters), length, counts)


def _derivatives(
    problem: JointProblem, values: Variables, factor: FrontFactor, scales: _Scales
) -> tuple[_Score, FloatArray]:
    """Return the derivatives of the marginal likelihood by all scales, and those beyond the cost's by the variables."""
    nodes, kinds = factor.order.nodes, factor.order.kinds
    Z = selected_inverse(nodes, factor.entries)
    tilt = problem.measure.copy()
    scratch = Variables(values.poses.copy(), values.points.copy(), values.calibration.copy())
    h = trace_motions(problem.motions, kinds[0], scratch, NU, nodes, Z, tilt)
    B = trace_readings(problem.readings, kinds[1], scratch, NU, nodes, Z, tilt)
    e, w = errors_of_motions(problem.motions, values, NU)
    e_read, w_read = errors_of_readings(problem.readings, values, NU)
    score = _Score(len(scales.present), factor.order.n)
    for robot in scales.robots:
        motions, motion_units, readings, reading_units = scales.units(robot)
        # Each component of a motion has a tail of its own: as many factors of one residual.
        first, n = robot.first, robot.first + 4
        shares = scales.present[first:n, None, None] ** 2 * motion_units / problem.motions.sigma[motions] ** 2
        pull = score.add(
            first, shares.reshape(4, -1, 1, 1), e[motions].reshape(-1, 1), w[motions].reshape(-1),
            h[motions].reshape(-1, 1, 1),
        ).reshape(shares.shape)  # fmt: skip
        pull_motions(problem.motions, kinds[0], values, motions, pull, score.pulls[first:n])
        first, n = n, n + len(robot.names)
        W = problem.readings.whitening[readings]
        A = scales.present[first:n, None, None, None] ** 2 * (W @ reading_units @ W.swapaxes(-1, -2))
        pull = score.add(first, A, e_read[readings], w_read[readings], B[readings])
        pull_readings(problem.readings, kinds[1], values, readings, pull, score.pulls[first:n])
    first = len(scales.present) - 2
    for ties, kind, nu in ((problem.joint_ties, kinds[2], NU_PLACES), (problem.pass_ties, kinds[3], NU)):
        h_ties = trace_ties(ties, kind, scratch, nu, nodes, Z, tilt)
        e_ties, w_ties = errors_of_ties(ties, values, nu)
        A, B_ties = np.tile(np.eye(2), (1, len(e_ties), 1, 1)), 0.5 * h_ties[:, None, None] * np.eye(2)
        pull = score.add(first, A, e_ties, w_ties, B_ties)
        pull_ties(ties, kind, values, pull, score.pulls[first : first + 1])
        first += 1
    return score, tilt


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
