"""What the residuals of one problem say of K variances, at given values of them: see `variance_components`.

The problem is solved under them from where it was before, and what the estimate takes is worked out for all vectors at
once.
"""

from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np
from scipy.linalg import hadamard
from scipy.special import chdtr, chdtri

from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray
from groundsbot.offline.sam import Problem, Solution, State, solve, stacked, whitening

# A residual beyond this is no noise but a fault, and says nothing of the noise; of good ones 0.1 % lie there.
_FAULT: Final = 1e-3
_MAX_FAULTS: Final = 0.1
_N_SIGNS: Final = 16  # a power of two
_SEED: Final = 11
# Of the solves in between. The cost as a whole is level where a solve ends, but its parts are not: what they are off by
# is its root.
_COST_TOLERANCE: Final = 1e-4
_RELATIVE_TOLERANCE: Final = 1e-8
# Drives take some three a look, and not twenty where the sigmas are ten times off. Where readings contradict each other
# steps lead nowhere, hundreds of them: each further look then goes on from where the last one ended by one.
_STEPS_IN_ALL: Final = 100

Good = tuple[BoolArray, BoolArray]  # which motions and which readings are no faults


@dataclass(frozen=True)
class Components:
    """How the covariances of one problem's factors follow from K variances.

    Attributes:
        odometry: (K, M, 3, 3) of each motion, for a variance of one; zero where a variance has no part in it.
        odometry_rest: (M, 3, 3) what is added whatever the variances.
        readings: (K, N, 2, 2) and readings_rest: (N, 2, 2) likewise.
    """

    odometry: FloatArray
    odometry_rest: FloatArray
    readings: FloatArray
    readings_rest: FloatArray


@dataclass(frozen=True)
class Part:
    """A problem, where its solve begins, and what its covariances are made of."""

    problem: Problem
    start: State
    components: Components


class Seen(NamedTuple):
    """What one part says at given variances, by the logarithms of sigma.

    Attributes:
        squares: (K,) weighted squares of residuals that each sigma answers for; expected: (K,) what they should be;
            at_most: (K,) what they would be if the estimate took nothing.
        information: (K, K) average information.
        good: what took part.
    """

    squares: FloatArray
    expected: FloatArray
    at_most: FloatArray
    information: FloatArray
    good: Good


class Looker:
    """Looks at one part again and again.

    Attributes:
        solution: under the variances of the last look.
    """

    def __init__(self, part: Part) -> None:
        problem, components = part.problem, part.components
        self.solution = Solution(part.start, (0.0,), "", converged=True, problem=problem)
        self._odometry = _Kind(components.odometry, components.odometry_rest)
        self._readings = _Kind(components.readings, components.readings_rest)
        self._steps_left = _STEPS_IN_ALL
        self._n_odometry = problem.odometry.motion.size
        self._signs = _signs(self._n_odometry + problem.readings.value.size)

    def look(self, variances: FloatArray, good: Good | None) -> Seen:
        """Solves under variances (K,); `good` are no faults, where that is settled."""
        weights = self._odometry.whitening(variances), self._readings.whitening(variances)
        problem = self.solution.problem.reweighed(*weights)
        self.solution = replace(self.solution, problem=problem)  # lets go of the factorisation of the look before
        self.solution = solve(
            problem,
            self.solution.state,
            _COST_TOLERANCE,
            relative_tolerance=_RELATIVE_TOLERANCE,
            most_steps=max(1, self._steps_left),
        )
        self._steps_left -= self.solution.n_linearised
        state = self.solution.state
        kinds = problem.odometry.linearise(state, problem.columns), problem.readings.linearise(state, problem.columns)
        jacobian, _ = stacked(kinds, problem.columns.n)
        residuals = kinds[0].residual, kinds[1].residual
        good = good or (_no_fault(residuals[0]), _no_fault(residuals[1]))
        shares = (
            self._odometry.shares(weights[0], variances, residuals[0], good[0]),
            self._readings.shares(weights[1], variances, residuals[1], good[1]),
        )
        force = np.concatenate([share.force for share in shares], axis=1)
        wanted = np.concatenate([self._signs, force.T], axis=1)
        inner = np.asarray(jacobian.T @ wanted)
        solved = self.solution.factorisation.solve_many(inner)
        explained = np.asarray(jacobian @ solved[:, :_N_SIGNS])
        left = _own_blocks_left(self._signs, explained, self._n_odometry)
        kept = [_kept_of_square(each) for each in residuals]
        return Seen(
            force @ np.concatenate([each.reshape(-1) for each in residuals]),
            kept[0] * shares[0].expected(left[0]) + kept[1] * shares[1].expected(left[1]),
            kept[0] * shares[0].at_most + kept[1] * shares[1].at_most,
            _positive(2.0 * (force @ force.T - inner[:, _N_SIGNS:].T @ solved[:, _N_SIGNS:])),
            good,
        )


class _Shares(NamedTuple):
    """Of variances in the whitened covariance of each factor of a kind.

    Attributes:
        of: (k,) which variances have one; matrices: (k, M, n, n); n_variances: K.
        force: (K, M n) matrices times residuals.
        at_most: (K,) traces.
    """

    of: IntArray
    matrices: FloatArray
    n_variances: int
    force: FloatArray
    at_most: FloatArray

    def expected(self, left: FloatArray) -> FloatArray:
        """(K,) traces of the shares times what the estimate leaves (M, n, n)."""
        found = np.zeros(self.n_variances)
        found[self.of] = self.matrices.reshape(len(self.of), left.size) @ left.reshape(-1)
        return found


class _Kind:
    """Motions or readings, and what their covariances are made of."""

    def __init__(self, unit: FloatArray, rest: FloatArray) -> None:
        self._n_variances, self._rest = len(unit), rest
        self._of = np.flatnonzero(unit.any(axis=(1, 2, 3)))
        self._unit = np.ascontiguousarray(unit[self._of])

    def whitening(self, variances: FloatArray) -> FloatArray:
        """(M, n, n) under variances (K,)."""
        return whitening(np.tensordot(variances[self._of], self._unit, 1) + self._rest)

    def shares(self, weights: FloatArray, variances: FloatArray, residual: FloatArray, good: BoolArray) -> _Shares:
        """Those of factors (M,) that are good; the others have none."""
        matrices = np.where(good[:, None, None], weights, 0.0)
        turned = np.ascontiguousarray(matrices.swapaxes(-1, -2))
        own = np.empty_like(self._unit)
        for share, unit, variance in zip(own, self._unit, variances[self._of].tolist(), strict=True):
            np.matmul(matrices @ unit, variance * turned, out=share)
        force = np.zeros((self._n_variances, residual.size))
        force[self._of] = np.einsum("kmij,mj->kmi", own, residual).reshape(len(own), residual.size)
        at_most = np.zeros(self._n_variances)
        at_most[self._of] = np.einsum("kmii->k", own)
        return _Shares(self._of, own, self._n_variances, force, at_most)


def _signs(n: int) -> FloatArray:
    """(n, _N_SIGNS) random, and such that the products of two rows nearer than _N_SIGNS sum to nothing."""
    random = np.random.default_rng(_SEED).choice([-1.0, 1.0], (n, 1))
    signs: FloatArray = random * hadamard(_N_SIGNS)[np.arange(n) % _N_SIGNS]
    return signs


def _own_blocks_left(signs: FloatArray, explained: FloatArray, n_odometry: int) -> tuple[FloatArray, FloatArray]:
    """Estimates (M, 3, 3) and (N, 2, 2) of what the estimate leaves of each factor's whitened covariance.

    Args:
        signs: (rows, n) as `_signs` has them.
        explained: (rows, n) what the estimate explains of them.
        n_odometry: how many of the rows belong to motions.
    """
    blocks = []
    for rows, size in ((slice(0, n_odometry), 3), (slice(n_odometry, None), 2)):
        before, after = (each[rows].reshape(-1, size, _N_SIGNS) for each in (signs, explained))
        blocks.append(np.eye(size) - before @ after.swapaxes(-1, -2) / _N_SIGNS)
    return blocks[0], blocks[1]


def _positive(matrix: FloatArray) -> FloatArray:
    """The nearest symmetric matrix without negative eigenvalues; faults left out of a few terms can cause them."""
    values, vectors = np.linalg.eigh(0.5 * (matrix + matrix.T))
    nearest: FloatArray = (vectors * np.maximum(values, 0.0)) @ vectors.T
    return nearest


def _no_fault(residual: FloatArray) -> BoolArray:
    """(M,) which whitened residuals (M, n) may be noise; all, where the sigmas are so far off that many look bad."""
    if not len(residual):
        return np.zeros(0, dtype=np.bool_)
    n = residual.shape[1]
    square = (residual**2).sum(axis=1)
    level = max(1.0, float(np.median(square)) / float(chdtri(n, 0.5)))
    good: BoolArray = square <= level * chdtri(n, _FAULT)
    return good if good.mean() > 1.0 - _MAX_FAULTS else np.ones(len(good), dtype=np.bool_)


def _kept_of_square(residual: FloatArray) -> float:
    """What is expected of the squares of good residuals (M, n), as a share, though the largest are taken for faults.

    The mean of chi-square up to a bound, over the share of it that lies there: those left out would bring n times
    P(chi-square with n + 2 degrees beyond the bound).
    """
    n = residual.shape[1]
    return float(chdtr(n + 2, chdtri(n, _FAULT)) / (1.0 - _FAULT))
