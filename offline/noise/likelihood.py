"""Quadratic forms of the residuals of one problem, and their expectations, at given variances.

The problem is solved under the variances, starting at its last solution, and the bias of its calibration is corrected
(`sam.bias`): a mount that is biased by centimetres leaves residuals that look like lateral slip, larger lateral noise
makes the bias larger, and on some drives both would grow without bound. For each variance component i the quadratic
form q_i = r' S^-1 V_i S^-1 r of the residuals r is computed, where V_i is the covariance for a variance of one. Each
component j contributes its variance times tr(S^-1 V_i S^-1 P V_j P') to the expectation of q_i, where
P = 1 - J H^-1 J' S^-1 projects errors on residuals. The traces are averages over random signs (Hutchinson, "A
stochastic estimator of the trace of the influence matrix for Laplacian smoothing splines", 1989).
`variance_components` estimates the variances from these.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final, NamedTuple

import numpy as np
from scipy import sparse
from scipy.special import chdtri

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.foundation import ResidentItems
from groundsbot.offline.noise.lasting_errors import LastingErrors
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

_N_SIGNS: Final = 8
# A trace over k directions has the relative error sqrt(2 / (32 k)). Few directions determine persistent errors, and
# other noise may be a hundred times larger: with 8 vectors the estimate would be dominated by chance.
_N_SIGNS_LASTING: Final = 32
_ROUNDING: Final = 1e-9
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
class Components:
    """Covariances of the factors of one problem as functions of K variances, and of those of shared errors.

    Attributes:
        odometry: (K, M, 3, 3) covariance of each motion for a variance of one.
        odometry_rest: (M, 3, 3) covariance that does not depend on the variances.
        observations: (K, N, 2, 2) as `odometry`.
        observations_rest: (N, 2, 2) as `odometry_rest`.
        lasting: L kinds of persistent errors, which observations of a tag share in part or in full.
        lasting_root: (N, 2, 2) its columns are the errors of each observation for a persistent component of one.
        common: index of the variance whose error all observations of a picture share, as that of its stamp; None: none.
            In the weights it counts as independent for each observation.
        common_root: (N, 2) change of each observation for such an error of one.
        jitter_root: (N, 2) change of each observation for one sigma of an error that all observations of a picture
            share, in `observations_rest` as if it were independent for each; None: there is none.
        picture: (N,) index of the picture of each observation, from 0 without gaps.
    """

    odometry: FloatArray
    odometry_rest: FloatArray
    observations: FloatArray
    observations_rest: FloatArray
    lasting: tuple[LastingErrors, ...] = ()
    lasting_root: FloatArray | None = None
    common: int | None = None
    common_root: FloatArray | None = None
    jitter_root: FloatArray | None = None
    picture: IntArray | None = None

    @property
    def n_lasting(self) -> int:
        """Number of variances of persistent errors: two for each kind."""
        return 2 * len(self.lasting)

    @cached_property
    def odometry_roots(self) -> list[FloatArray | None]:
        """Square roots (M, 3, 3) of `odometry`, component by component, then of `odometry_rest`; None where zero."""
        return [_root(each) for each in (*self.odometry, self.odometry_rest)]

    @cached_property
    def observation_roots(self) -> list[FloatArray | None]:
        """Square roots (N, 2, 2) of `observations` by component, then of the independent rest; None where zero."""
        rest = self.observations_rest
        if self.jitter_root is not None:
            rest = rest - self.jitter_root[:, :, None] * self.jitter_root[:, None, :]
        return [_root(each) for each in (*self.observations, rest)]

    def covariances(self, variances: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return covariances (M, 3, 3) of motions and (N, 2, 2) of observations under K + 2 L variances.

        Observations are made independent by larger variances: a shared error of variance s adds as much to the variance
        of the mean of n observations as n independent errors of variance n s.
        """
        own, lasting = variances[: len(self.odometry)], variances[len(self.odometry) :].reshape(-1, 2)
        odometry: FloatArray = np.tensordot(own, self.odometry, 1) + self.odometry_rest
        observations: FloatArray = np.tensordot(own, self.observations, 1) + self.observations_rest
        return _regular(odometry), _regular(observations + self._covariance_lasting(lasting))

    def _covariance_lasting(self, lasting: FloatArray) -> FloatArray:
        """Return the part (N, 2, 2) of the observations' covariances by the variances (L, 2) of persistent errors."""
        added = np.zeros_like(self.observations_rest)
        for errors, both in zip(self.lasting, lasting, strict=True):
            assert self.lasting_root is not None
            column = self.lasting_root * np.sqrt(both)
            added += errors.correlation_sums()[:, None, None] * (column @ column.swapaxes(-1, -2))
        return added


@dataclass(frozen=True)
class Part:
    """A problem with its initial state, its covariance components, and its name for errors."""

    problem: Problem
    start: State
    components: Components
    name: str = ""


class PartLikelihood(NamedTuple):
    """Quadratic forms of one part at given variances of C components.

    Attributes:
        squares: (C,) q_i, less the expectation by the parts of the covariances that no variance scales.
        traces: (C, C) derivative of the expectation of q_i with respect to the variance of component j.
        without_fit: (C,) expectation of q_i if the estimate absorbed no errors and no row was clipped.
        n_groups: (2 L,) effective number of independent series that determine each variance of persistent errors: the
            squared trace of P V_i over the trace of its square.
    """

    squares: FloatArray
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
        rows = _Rows(correct_bias(self.solution, scatter=1.0), self._components)
        n, rng = rows.n_components, np.random.default_rng(_SEED)
        traces, lengths, n_signs, without_fit = np.empty((n, n)), np.empty(n), np.empty(n), np.zeros(n)
        for j in range(n):
            drawn = rows.random_errors(j, rng)
            without_fit += variances[j] * rows.squares(drawn[:, :_N_SIGNS]).mean(axis=1)
            drawn = rows.weigh(drawn)
            residuals = rows.residuals(drawn)
            traces[:, j] = rows.squares(residuals).mean(axis=1)
            lengths[j], n_signs[j] = (drawn * residuals).sum(axis=0).mean(), drawn.shape[1]
        # Entries (i, j) and (j, i) estimate the same trace, so they are averaged by their numbers of vectors.
        traces = (n_signs * traces + (n_signs * traces).T) / (n_signs + n_signs[:, None])
        lasting = slice(n - self._components.n_lasting, n)
        n_groups = lengths[lasting] ** 2 / np.maximum(np.diag(traces)[lasting], 1e-300)
        unscaled = rows.squares(rows.residuals(rows.weigh(rows.random_unscaled_errors(rng)))).mean(axis=1)
        return PartLikelihood(rows.squares(rows.residual[:, None])[:, 0] - unscaled, traces, without_fit, n_groups)


class _Rows:
    """Whitened rows of a solution with the weights of its losses, and its variance components.

    Attributes:
        residual: (R,) three rows for each motion, then two for each observation; outliers are clipped.
    """

    def __init__(self, solution: Solution, components: Components) -> None:
        problem, state = solution.problem, solution.state
        kinds = (
            problem.odometry.linearise(state, problem.columns),
            problem.observations.linearise(state, problem.columns),
        )
        jacobian, residual = stack(kinds, problem.columns.n)
        _, weight = losses_and_weights(solution.losses.observations, kinds[1].residual)
        self._n_odometry = kinds[0].residual.size
        self._root = np.concatenate([np.ones(self._n_odometry), np.repeat(np.sqrt(weight), 2)])
        self._jacobian = sparse.csr_array(jacobian * self._root[:, None])
        self._factorisation = solution.factorisation
        self.residual = residual * self._root * np.concatenate([_clip_factors(each.residual) for each in kinds])
        of_motions = [_whiten(problem.odometry.whitening, each) for each in components.odometry_roots]
        of_observations = [_whiten(problem.observations.whitening, each) for each in components.observation_roots]
        self._of_motions, self._of_observations = of_motions[:-1], of_observations[:-1]
        self._unscaled = of_motions[-1], of_observations[-1]
        self._forms_of_motions = _quadratic_forms(self._of_motions, len(problem.odometry.whitening), 3)
        self._forms_of_observations = _quadratic_forms(self._of_observations, len(problem.observations.whitening), 2)
        self._lasting = components.lasting
        if components.lasting_root is not None:
            self._by_lasting = problem.observations.whitening @ components.lasting_root
        self._common = components.common
        if components.common_root is not None:
            self._by_stamp = np.einsum("mij,mj->mi", problem.observations.whitening, components.common_root)
        self._by_jitter = None
        if components.jitter_root is not None:
            self._by_jitter = np.einsum("mij,mj->mi", problem.observations.whitening, components.jitter_root)
        picture = components.picture
        if picture is not None and len(picture):
            self._pictures = sparse.csr_array((np.ones(len(picture)), (picture, np.arange(len(picture)))))
        self.n_components = len(components.odometry) + components.n_lasting

    def weigh(self, errors: FloatArray) -> FloatArray:
        """Return errors (R, n) times the root weights of the losses."""
        return np.asarray(self._root[:, None] * errors)

    def residuals(self, errors: FloatArray) -> FloatArray:
        """Return the residuals P e (R, n) of errors e (R, n)."""
        solved = self._factorisation.solve_many(np.asarray(self._jacobian.T @ errors))
        residuals: FloatArray = errors - self._jacobian @ solved
        return residuals

    def squares(self, rows: FloatArray) -> FloatArray:
        """Return the quadratic forms q (C, n) of rows (R, n)."""
        motions = rows[: self._n_odometry].reshape(-1, 3, rows.shape[1])
        observations = rows[self._n_odometry :].reshape(-1, 2, rows.shape[1])
        own = [*(self._forms_of_motions @ _products(motions) + self._forms_of_observations @ _products(observations))]
        if self._common is not None:
            along = np.einsum("mi,min->mn", self._by_stamp, observations)
            own[self._common] = (np.asarray(self._pictures @ along) ** 2).sum(axis=0)
        lasting = [
            errors.squares(self._by_lasting[..., axis], observations) for errors in self._lasting for axis in (0, 1)
        ]
        return np.array(own + lasting).reshape(self.n_components, rows.shape[1])

    def random_errors(self, component: int, rng: np.random.Generator) -> FloatArray:
        """Return random errors (R, n) of one component with a variance of one, from random signs."""
        if component == self._common:
            rows = np.zeros((len(self.residual), _N_SIGNS))
            rows[self._n_odometry :] = self._random_errors_by_picture(self._by_stamp, rng)
        elif component < len(self._of_motions):
            rows = self._random_errors_by(self._of_motions[component], self._of_observations[component], rng)
        else:
            kind, axis = divmod(component - len(self._of_motions), 2)
            errors = self._lasting[kind].correlate(rng.choice([-1.0, 1.0], (len(self._by_lasting), _N_SIGNS_LASTING)))
            observations = self._by_lasting[..., axis, None] * errors[:, None, :]
            rows = np.zeros((len(self.residual), _N_SIGNS_LASTING))
            rows[self._n_odometry :] = observations.reshape(-1, _N_SIGNS_LASTING)
        return rows

    def random_unscaled_errors(self, rng: np.random.Generator) -> FloatArray:
        """Return random errors (R, n) of the parts of the covariances that no variance scales."""
        rows = self._random_errors_by(*self._unscaled, rng)
        if self._by_jitter is not None:
            rows[self._n_odometry :] += self._random_errors_by_picture(self._by_jitter, rng)
        return rows

    def _random_errors_by_picture(self, root: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Return random errors (2 N, n) of observations that those of a picture share, of one root (N, 2) each."""
        signs = self._pictures.T @ rng.choice([-1.0, 1.0], (self._pictures.shape[0], _N_SIGNS))
        return np.asarray((root[..., None] * signs[:, None, :]).reshape(-1, _N_SIGNS))

    def _random_errors_by(
        self, of_motions: FloatArray | None, of_observations: FloatArray | None, rng: np.random.Generator
    ) -> FloatArray:
        rows = np.zeros((len(self.residual), _N_SIGNS))
        for root, own in ((of_motions, rows[: self._n_odometry]), (of_observations, rows[self._n_odometry :])):
            if root is not None:
                signs = rng.choice([-1.0, 1.0], (len(root), root.shape[2], _N_SIGNS))
                own[:] = (root @ signs).reshape(own.shape)
        return rows


def _regular(covariances: FloatArray) -> FloatArray:
    """Return covariances (M, n, n) regularised against rounding errors, so that they are positive definite."""
    n = covariances.shape[-1]
    level = np.trace(covariances, axis1=-2, axis2=-1) / n
    return np.asarray(covariances + (_ROUNDING * level)[:, None, None] * np.eye(n))


def _root(covariances: FloatArray) -> FloatArray | None:
    """Return square roots (M, n, n) of covariances (M, n, n), as matrices B with B B'; None if all are zero."""
    if not covariances.any():
        return None
    values, vectors = np.linalg.eigh(covariances)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :])


def _whiten(whitenings: FloatArray, root: FloatArray | None) -> FloatArray | None:
    return None if root is None else np.asarray(whitenings @ root)


def _quadratic_forms(roots: Sequence[FloatArray | None], m: int, n: int) -> FloatArray:
    """Return quadratic forms (K, M n (n + 1) / 2), which map `_products` of rows to sums of |root' r|^2.

    Args:
        roots: K times (M, n, n), or None for zero.
        m: M.
        n: components of a row.
    """
    i, j = np.triu_indices(n)
    forms = np.zeros((len(roots), m, len(i)))
    for form, root in zip(forms, roots, strict=True):
        if root is not None:
            form[:] = np.where(i == j, 1.0, 2.0) * (root @ root.swapaxes(-1, -2))[:, i, j]
    return forms.reshape(len(roots), -1)


def _products(rows: FloatArray) -> FloatArray:
    """Return the products (M n (n + 1) / 2, k) of each two components of rows (M, n, k)."""
    pairs = np.transpose(np.triu_indices(rows.shape[1]))
    products = np.empty((len(rows), len(pairs), rows.shape[2]))
    for k, (i, j) in enumerate(pairs):
        np.multiply(rows[:, i], rows[:, j], out=products[:, k])
    return products.reshape(-1, rows.shape[2])


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
