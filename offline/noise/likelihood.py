"""What the residuals of one problem say of variances, at given values of them: see `variance_components`.

The problem is solved under the variances from where it was before. Of each variance component i the quadratic form
q_i = r' S^-1 V_i S^-1 r of the residuals is taken, with V_i the covariance that a variance of one would bring, and how
much each component j contributes to its expectation, tr(S^-1 V_i S^-1 P V_j P'), with P = 1 - J H^-1 J' S^-1 what the
estimate leaves of an error. The traces are averages over random signs (Hutchinson, "A stochastic estimator of the trace
of the influence matrix for Laplacian smoothing splines", 1989).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final, NamedTuple

import numpy as np
from scipy import sparse
from scipy.stats import chi2

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.foundation import ResidentItems
from groundsbot.offline.noise.lasting_errors import LastingErrors
from groundsbot.offline.sam import Problem, Solution, State, losses_and_weights, solve, stack, whitening

_N_SIGNS: Final = 8
# A trace over k directions is known to sqrt(2 / (32 k)): where errors that last, of which few directions tell, are set
# against noise of a hundred times their size, with 8 what was left was chance.
_N_SIGNS_LASTING: Final = 32
_ROUNDING: Final = 1e-9
_SEED: Final = 11
# A residual beyond this is rather a fault than noise, and counts as if it lay there; of good ones 0.1 % do.
_FAULT: Final = 1e-3
# Of the solves in between: their residuals are asked for, which are off by the root of what the cost is off by.
_COST_TOLERANCE: Final = 1e-4
_RELATIVE_TOLERANCE: Final = 1e-8
# Drives take some three steps a look. Where observations contradict each other steps lead nowhere, hundreds of them:
# each further look then goes on from where the last one ended by one.
_STEPS_IN_ALL: Final = 100


@dataclass(frozen=True)
class Components:
    """How the covariances of one problem's factors follow from K variances, and from what observations share.

    Attributes:
        odometry: (K, M, 3, 3) of each motion, for a variance of one; zero where a variance has no part in it.
        odometry_rest: (M, 3, 3) what is added whatever the variances.
        observations: (K, N, 2, 2) and observations_rest: (N, 2, 2) likewise.
        lasting: L kinds of errors that observations of a tag have in common, in part or all.
        lasting_root: (N, 2, 2) its columns are the errors of each observation for a lasting component of one.
        common: which of the K variances is of an error that all observations of a picture have in common, as that of
            its stamp; None: none. It is weighed as if each observation had its own.
        common_root: (N, 2) what such an error of one adds to each observation.
        picture: (N,) of each observation, from 0 without gaps.
    """

    odometry: FloatArray
    odometry_rest: FloatArray
    observations: FloatArray
    observations_rest: FloatArray
    lasting: tuple[LastingErrors, ...] = ()
    lasting_root: FloatArray | None = None
    common: int | None = None
    common_root: FloatArray | None = None
    picture: IntArray | None = None

    @property
    def n_lasting(self) -> int:
        """Variances of lasting errors: two a kind."""
        return 2 * len(self.lasting)

    @cached_property
    def odometry_roots(self) -> list[FloatArray | None]:
        """Square roots (M, 3, 3) of `odometry`, component by component, then of `odometry_rest`; None where zero."""
        return [_root(each) for each in (*self.odometry, self.odometry_rest)]

    @cached_property
    def observation_roots(self) -> list[FloatArray | None]:
        """Square roots (N, 2, 2) of `observations` by component, then of `observations_rest`; None where zero."""
        return [_root(each) for each in (*self.observations, self.observations_rest)]

    def covariances(self, variances: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(M, 3, 3) and (N, 2, 2) under K + 2 L variances; observations count as independent with what that takes.

        The mean of n observations that share an error of variance s errs by it as n independent ones would of n s.
        """
        own, lasting = variances[: len(self.odometry)], variances[len(self.odometry) :].reshape(-1, 2)
        odometry: FloatArray = np.tensordot(own, self.odometry, 1) + self.odometry_rest
        observations: FloatArray = np.tensordot(own, self.observations, 1) + self.observations_rest
        return _regular(odometry), _regular(observations + self._covariance_lasting(lasting))

    def _covariance_lasting(self, lasting: FloatArray) -> FloatArray:
        """(N, 2, 2) what (L, 2) variances of lasting errors add to each observation's covariance."""
        added = np.zeros_like(self.observations_rest)
        for errors, both in zip(self.lasting, lasting, strict=True):
            assert self.lasting_root is not None
            column = self.lasting_root * np.sqrt(both)
            added += errors.alike()[:, None, None] * (column @ column.swapaxes(-1, -2))
        return added


@dataclass(frozen=True)
class Part:
    """A problem, where its solve begins, what its covariances are made of, and what to call it in errors."""

    problem: Problem
    start: State
    components: Components
    name: str = ""


class PartLikelihood(NamedTuple):
    """What one part says at given variances.

    Attributes:
        squares: (C,) q_i, less what the parts of the covariances bring that no variance scales.
        traces: (C, C) what a variance of one of component j brings to q_i.
        at_most: (C,) q_i as all variances would bring it if the estimate took nothing and no row was cut off.
        n_groups: (2 L,) how many independent series tell how their errors last, once the estimate has taken its
            part: the squared trace of P V_i over the trace of its square.
    """

    squares: FloatArray
    traces: FloatArray
    at_most: FloatArray
    n_groups: FloatArray


class LikelihoodEvaluator:
    """Looks at one part again and again.

    Attributes:
        solution: under the variances of the last look.
    """

    def __init__(self, part: Part) -> None:
        self.solution = Solution(part.start, (0.0,), "", converged=True, problem=part.problem)
        self._components = part.components
        self._steps_left = _STEPS_IN_ALL

    def evaluate(self, variances: FloatArray) -> PartLikelihood:
        """Solves under (C,) variances, which are K of factors and two of each level."""
        odometry, observations = self._components.covariances(variances)
        problem = self.solution.problem.reweigh(whitening(odometry), whitening(observations))
        self.solution = replace(self.solution, problem=problem)  # lets go of the factorisation of the look before
        self.solution = solve(
            problem,
            self.solution.state,
            _COST_TOLERANCE,
            relative_tolerance=_RELATIVE_TOLERANCE,
            most_steps=max(1, self._steps_left),
        )
        self._steps_left -= self.solution.n_linearised
        rows = _Rows(self.solution, self._components)
        n, rng = rows.n_components, np.random.default_rng(_SEED)
        traces, lengths, n_signs, at_most = np.empty((n, n)), np.empty(n), np.empty(n), np.zeros(n)
        for j in range(n):
            drawn = rows.random_errors(j, rng)
            at_most += variances[j] * rows.squares(drawn[:, :_N_SIGNS]).mean(axis=1)
            drawn = rows.weigh(drawn)
            left = rows.residuals(drawn)
            traces[:, j] = rows.squares(left).mean(axis=1)
            lengths[j], n_signs[j] = (drawn * left).sum(axis=0).mean(), drawn.shape[1]
        # Both of a pair of components tell of the same trace.
        traces = (n_signs * traces + (n_signs * traces).T) / (n_signs + n_signs[:, None])
        lasting = slice(n - self._components.n_lasting, n)
        n_groups = lengths[lasting] ** 2 / np.maximum(np.diag(traces)[lasting], 1e-300)
        unscaled = rows.squares(rows.residuals(rows.weigh(rows.random_unscaled_errors(rng)))).mean(axis=1)
        return PartLikelihood(rows.squares(rows.residual[:, None])[:, 0] - unscaled, traces, at_most, n_groups)


class _Rows:
    """The whitened rows of a solution, weighed as its losses weighed them, and its variance components.

    Attributes:
        residual: (R,) three rows a motion, then two an observation; faults cut to what noise may bring.
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
        self.residual = residual * self._root * np.concatenate([_within_noise(each.residual) for each in kinds])
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
        if components.common_root is not None and components.picture is not None:
            self._by_stamp = np.einsum("mij,mj->mi", problem.observations.whitening, components.common_root)
            picture = components.picture
            self._pictures = sparse.csr_array((np.ones(len(picture)), (picture, np.arange(len(picture)))))
        self.n_components = len(components.odometry) + components.n_lasting

    def weigh(self, errors: FloatArray) -> FloatArray:
        """(R, n) errors as the losses weigh them."""
        return np.asarray(self._root[:, None] * errors)

    def residuals(self, errors: FloatArray) -> FloatArray:
        """P e of (R, n) errors."""
        solved = self._factorisation.solve_many(np.asarray(self._jacobian.T @ errors))
        left: FloatArray = errors - self._jacobian @ solved
        return left

    def squares(self, rows: FloatArray) -> FloatArray:
        """(C, n) the quadratic forms q of (R, n) rows."""
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
        """(R, n) errors as component j brings with a variance of one, by random signs."""
        rows = np.zeros((len(self.residual), _N_SIGNS))
        if component == self._common:
            signs = self._pictures.T @ rng.choice([-1.0, 1.0], (self._pictures.shape[0], _N_SIGNS))
            rows[self._n_odometry :] = (self._by_stamp[..., None] * signs[:, None, :]).reshape(-1, _N_SIGNS)
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
        """(R, n) errors as the parts of the covariances bring that no variance scales."""
        return self._random_errors_by(*self._unscaled, rng)

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
    """(M, n, n) raised by what rounding may have taken: with variances near none they would have no square root."""
    n = covariances.shape[-1]
    level = np.trace(covariances, axis1=-2, axis2=-1) / n
    return np.asarray(covariances + (_ROUNDING * level)[:, None, None] * np.eye(n))


def _root(covariances: FloatArray) -> FloatArray | None:
    """Return matrices (M, n, n) with root root' the covariances (M, n, n); None where all are zero."""
    if not covariances.any():
        return None
    values, vectors = np.linalg.eigh(covariances)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :])


def _whiten(whitenings: FloatArray, root: FloatArray | None) -> FloatArray | None:
    return None if root is None else np.asarray(whitenings @ root)


def _quadratic_forms(roots: Sequence[FloatArray | None], m: int, n: int) -> FloatArray:
    """Return (K, M n (n + 1) / 2): times the `_products` of rows, sums of |root' r|^2 for each of K roots (M, n, n)."""
    i, j = np.triu_indices(n)
    forms = np.zeros((len(roots), m, len(i)))
    for form, root in zip(forms, roots, strict=True):
        if root is not None:
            form[:] = np.where(i == j, 1.0, 2.0) * (root @ root.swapaxes(-1, -2))[:, i, j]
    return forms.reshape(len(roots), -1)


def _products(rows: FloatArray) -> FloatArray:
    """Return (M n (n + 1) / 2, k) products of each two components of rows (M, n, k)."""
    i, j = np.triu_indices(rows.shape[1])
    return np.asarray((rows[:, i] * rows[:, j]).reshape(-1, rows.shape[2]))


def _within_noise(residual: FloatArray) -> FloatArray:
    """(M n,) by what to multiply whitened residuals (M, n) so that none is longer than noise makes them.

    Where the sigmas are far too small that is measured in what most of them are.
    """
    n = residual.shape[1]
    square = (residual**2).sum(axis=1)
    level = max(1.0, float(np.median(square)) / float(chi2.ppf(0.5, n))) if len(square) else 1.0
    bound = level * chi2.isf(_FAULT, n)
    return np.repeat(np.sqrt(np.minimum(1.0, bound / np.maximum(square, 1e-300))), n)


def evaluate_all(evaluators: ResidentItems[LikelihoodEvaluator], variances: FloatArray) -> PartLikelihood:
    """Return the sums over all parts."""
    found = evaluators.map(LikelihoodEvaluator.evaluate, variances)
    return PartLikelihood(*(np.asarray(sum(each)) for each in zip(*found, strict=True)))
