"""Fitted sigmas against the ones the measurements were drawn with."""

import numpy as np
import pytest
from scipy.stats import norm

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.offline.noise.components import Components
from groundsbot.offline.noise.likelihood import Part
from groundsbot.offline.noise.variance_components import PRIOR_SIGMA, FittedVariances, fit_variances
from tests.support.data.problems import MadeProblem, make_problem

_NOISE = 0.7
_SEEDS = range(12)


def _part(made: MadeProblem, *, useless: bool = False) -> Part:
    """One variance for all motions, one for all observations; and one that no factor has a part of."""
    problem = made.problem
    odometry, observations = (
        np.linalg.inv(factors.whitening.swapaxes(-1, -2) @ factors.whitening)
        for factors in (problem.odometry, problem.observations)
    )
    none_o, none_r = np.zeros_like(odometry), np.zeros_like(observations)
    components = Components(
        odometry=np.array([odometry, none_o] + [none_o] * useless),
        odometry_rest=none_o,
        observations=np.array([none_r, observations] + [none_r] * useless),
        observations_rest=none_r,
    )
    return Part(problem, made.truth, components)


def _fit(seed: int, start: FloatArray, n_parts: int = 2) -> FittedVariances:
    return fit_variances([_part(make_problem(100 * seed + i, _NOISE)) for i in range(n_parts)], start)


@pytest.mark.parametrize("start", [[1.0, 1.0], [10.0, 10.0], [0.1, 0.1], [10.0, 0.1], [0.1, 10.0]])
def test_sigmas_are_found_from_ten_times_too_large_and_too_small(start: list[float]) -> None:
    inside, deviations = 0, []
    for seed in _SEEDS:
        fitted = _fit(seed, np.array(start))
        low, high = fitted.interval(norm.ppf(0.995))
        inside += int(((low < _NOISE) & (high > _NOISE)).sum())
        deviations.append(np.log(fitted.sigma / _NOISE) / np.sqrt(np.diag(fitted.log_covariance)))
        assert fitted.is_determined.all()
    n = 2 * len(_SEEDS)
    assert inside >= n - 2  # at 99 % three outside have a chance of two in a thousand
    assert abs(np.mean(deviations)) < 3.0 / np.sqrt(n)
    assert 0.5 < np.std(deviations) < 1.6


def test_what_is_known_within_a_third_may_be_next_to_nothing() -> None:
    """Only a large estimate is accepted, so it may be large by chance; a sigma of many squares may not."""
    deviation = np.array([1.0 / np.sqrt(10.0), 0.01])
    fitted = FittedVariances(
        np.array([2.0, 2.0]),
        np.diag(deviation**2),
        np.array([5.0, 5000.0]),
        np.ones(2) > 0,
        True,
        np.zeros((0, 2)),
        np.zeros((0, 2)),
    )
    low, high = fitted.interval(norm.ppf(0.995))
    assert low[0] == 0.0
    assert low[1] == pytest.approx(2.0 * np.sqrt(1.0 - 2.0 * 0.02576), rel=1e-4)
    np.testing.assert_allclose(high, 2.0 * np.exp(2.5758 * deviation), rtol=1e-4)


def test_where_the_search_begins_does_not_matter() -> None:
    near, far = _fit(3, np.array([0.7, 0.7])), _fit(3, np.array([7.0, 0.07]))
    assert near.converged
    assert far.sigma == pytest.approx(near.sigma, rel=0.05)


def test_redundancy_counts_what_the_estimate_leaves() -> None:
    fitted = _fit(1, np.array([1.0, 1.0]), n_parts=1)
    problem = make_problem(100, _NOISE).problem
    n_unknown = problem.columns.n - int((problem.columns.calibration >= 0).sum())
    left = problem.n_residuals - n_unknown
    # Squares that share what is left count less than as many of their own; calibration takes eight at most.
    assert 0.75 * left < fitted.redundancy.sum() < left


def test_a_sigma_without_residuals_keeps_its_value() -> None:
    fitted = fit_variances([_part(make_problem(5, _NOISE), useless=True)], np.array([1.0, 1.0, 0.03]))
    assert fitted.is_determined.tolist() == [True, True, False]
    assert fitted.sigma[2] == pytest.approx(0.03)
    assert fitted.log_covariance[2, 2] == pytest.approx(PRIOR_SIGMA**2)


def test_faults_do_not_count_as_noise() -> None:
    clean = fit_variances([_part(make_problem(7, _NOISE))], np.array([1.0, 1.0]))
    faulty = fit_variances([_part(make_problem(7, _NOISE, n_outliers=4))], np.array([1.0, 1.0]))
    assert faulty.sigma == pytest.approx(clean.sigma, rel=0.15)
