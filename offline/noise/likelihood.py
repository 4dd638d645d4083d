"""Quadratic forms of the residuals of one problem, and their expectations, at given variances.

The problem is solved under the variances, starting at its last solution, and the bias of its calibration is corrected
(`sam.bias`): a mount that is biased by centimetres leaves residuals that look like lateral slip, larger lateral noise
makes the bias larger, and on some drives both would grow without bound. For each variance component i the quadratic
form q_i = r' S^-1 V_i S^-1 r of the residuals r is computed, where V_i is the covariance for a variance of one. Its
expectation is the mean over the residuals P e of random errors e by all components together, where
P = 1 - J H^-1 J' S^-1 projects errors on residuals: q_i varies among these as among drives, so with n of them the
estimate varies by chance 1 / sqrt(n) as much as by the measurements. Each component j contributes its variance times
T_ij = tr(S^-1 V_i S^-1 P V_j P') to the expectation. The search needs this derivative less accurately: the traces are
averages over random signs (Hutchinson, "A stochastic estimator of the trace of the influence matrix for Laplacian
smoothing splines", 1989). `variance_components` estimates the variances from these.
"""

from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np
from scipy import sparse
from scipy.special import chdtri

from groundsbot.calib.foundation import FloatArray
from groundsbot.offline.foundation import ResidentItems
from groundsbot.offline.noise.components import Components
from groundsbot.offline.noise.whitened_components import WhitenedComponents, random_signs
from groundsbot.offline.sam import (
    Problem,
    Solution,
    State,
    correct_bias,
    losses_and_weights,
    solve,
    stack,
    whitening,
)

# Numbers of random errors, and of random signs: with n of them a trace over k directions has the relative error
# sqrt(2 / (n k)). Small problems take the larger numbers, and in all that many rows where these bounds allow it.
_N_ERRORS: Final = (32, 256)
_N_SIGNS: Final = (4, 64)
_ERROR_ROWS: Final = 200_000
_SIGN_ROWS: Final = 16_000
_SEED: Final = 11
# Residuals are clipped to the bound that this share of good ones exceeds.
_FAULT: Final = 1e-3
# Tolerances of the solves. The relative error of residuals is the root of that of the cost.
_COST_TOLERANCE: Final = 1e-4
_RELATIVE_TOLERANCE: Final = 1e-8
# A solve takes about three steps. With contradicting observations it may take hundreds without progress. After so many
# steps of all solves together, each further solve takes a single one.
_STEPS_IN_ALL: Final = 100


@dataclass(frozen=True)
class Part:
    """A problem with its initial state, its covariance components, and its name for errors."""

    problem: Problem
    start: State
    components: Components
    name: str = ""


class PartLikelihood(NamedTuple):
    """Quadratic forms of one part at given variances v of C components.

    Attributes:
        squares: (C,) q_i.
        expected: (C,) its expectation.
        traces: (C, C) derivative of the expectation of q_i with respect to the variance of component j.
        without_fit: (C,) expectation of q_i if the estimate absorbed no errors and no row was clipped.
        n_groups: (2 L,) effective number of independent series that determine each variance of persistent errors: the
            squared trace of P V_i over the trace of its square.
    """

    squares: FloatArray
    expected: FloatArray
    traces: FloatArray
    without_fit: FloatArray
    n_groups: FloatArray


class LikelihoodEvaluator:
    """Evaluation of one part at several variances in succession.

    Attributes:
        solution: under the last variances.
    """

    def __init__(self, part: Part) -> None:
        self.solution = Solution(part.start, (0.0,), "", converged=True, problem=part.problem)
        self._components = part.components
        self._steps_left = _STEPS_IN_ALL

    def evaluate(self, variances: FloatArray) -> PartLikelihood:
        """Solve under variances (C,): K of factors, then two of each kind of persistent errors."""
        odometry, observations = self._components.covariances(variances)
        problem = self.solution.problem.reweigh(whitening(odometry), whitening(observations))
        self.solution = replace(self.solution, problem=problem)  # frees the last factorisation
        self.solution = solve(
            problem,
            self.solution.state,
            _COST_TOLERANCE,
            relative_tolerance=_RELATIVE_TOLERANCE,
            most_steps=max(1, self._steps_left),
        )
        self._steps_left -= self.solution.n_linearised
        corrected = correct_bias(self.solution, scatter=1.0)
        components, rng = WhitenedComponents(problem, self._components), np.random.default_rng(_SEED)
        projection = _Projection(corrected)
        n_errors, n_signs = (
            int(np.clip(rows // max(components.n_rows, 1), *bounds))
            for rows, bounds in ((_ERROR_ROWS, _N_ERRORS), (_SIGN_ROWS, _N_SIGNS))
        )
        errors = components.random_errors(variances, n_errors, rng)
        without_fit = components.squares(errors).mean(axis=1)
        signs = random_signs((components.n_rows, n_signs), rng)
        residuals = projection.of(np.hstack([projection.root[:, None] * errors, signs]))
        squares = components.squares(projection.residual[:, None])[:, 0]
        expected = components.squares(residuals[:, :n_errors]).mean(axis=1)
        traces, lengths = _traces(projection, components, residuals[:, n_errors:])
        lasting = slice(components.n - self._components.n_lasting, components.n)
        n_groups = lengths[lasting] ** 2 / np.maximum(np.diag(traces)[lasting], 1e-300)
        return PartLikelihood(squares, expected, traces, without_fit, n_groups)


def _traces(
    projection: "_Projection", components: WhitenedComponents, residuals: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return tr(V_i P V_j P) (C, C) and tr(P V_i) (C,), whitened, from the residuals (R, n) of random signs."""
    n = residuals.shape[1]
    weight = projection.root[:, None]
    products = weight * components.times(weight * residuals)
    flat = products.reshape(components.n, -1)
    columns = products.transpose(1, 0, 2).reshape(len(residuals), -1)
    projected = projection.of(columns).reshape(len(residuals), -1, n).transpose(1, 0, 2)
    traces = flat @ projected.reshape(components.n, -1).T / n
    return 0.5 * (traces + traces.T), flat @ residuals.reshape(-1) / n


class _Projection:
    """Projection P of whitened errors (R, n) on the residuals of a solution, with the weights of its losses.

    Attributes:
        root: (R,) roots of the weights: three rows for each motion, then two for each observation.
        residual: (R,) of the solution, weighted; outliers are clipped.
    """

    def __init__(self, solution: Solution) -> None:
        problem, state = solution.problem, solution.state
        kinds = (
            problem.odometry.linearise(state, problem.columns),
            problem.observations.linearise(state, problem.columns),
        )
        jacobian, residual = stack(kinds, problem.columns.n)
        _, weight = losses_and_weights(solution.losses.observations, kinds[1].residual)
        self.root = np.concatenate([np.ones(kinds[0].residual.size), np.repeat(np.sqrt(weight), 2)])
        self._jacobian = sparse.csr_array(jacobian * self.root[:, None])
        self._factorisation = solution.factorisation
        self.residual = residual * self.root * np.concatenate([_clip_factors(each.residual) for each in kinds])

    def of(self, errors: FloatArray) -> FloatArray:
        """Return the residuals P e (R, n) of weighted errors e (R, n)."""
        solved = self._factorisation.solve_many(np.asarray(self._jacobian.T @ errors))
        residuals: FloatArray = errors - self._jacobian @ solved
        return residuals


def _clip_factors(residual: FloatArray) -> FloatArray:
    """Return factors (M n,) that clip whitened residuals (M, n) to the length that 0.1 % of good ones exceed.

    If the median shows that sigmas are too small, the bound grows in proportion.
    """
    square, n = (residual**2).sum(axis=1), residual.shape[1]
    level = max(1.0, float(np.median(square)) / float(chdtri(n, 0.5))) if len(square) else 1.0
    bound = level * chdtri(n, _FAULT)
    return np.repeat(np.sqrt(np.minimum(1.0, bound / np.maximum(square, 1e-300))), n)


def evaluate_all(evaluators: ResidentItems[LikelihoodEvaluator], variances: FloatArray) -> PartLikelihood:
    """Evaluate all parts and return the sums over them."""
    found = evaluators.map(LikelihoodEvaluator.evaluate, variances)
    return PartLikelihood(*(np.asarray(sum(each)) for each in zip(*found, strict=True)))
