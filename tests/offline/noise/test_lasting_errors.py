"""Errors that last, against the dense covariance of their process."""

import numpy as np
import pytest

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.offline.noise.lasting_errors import LastingErrors


@pytest.fixture
def place() -> FloatArray:
    """(N,) where observations were made along the way, series 0 and 1 in turns."""
    return np.array([0.0, 0.1, 0.3, 0.35, 0.9, 1.0, 1.0, 2.5])


@pytest.fixture
def series() -> FloatArray:
    return np.array([0, 1, 0, 0, 1, 1, 0, 1])


@pytest.fixture
def errors(place: FloatArray, series: FloatArray) -> LastingErrors:
    order = np.lexsort((place, series))
    correlation = np.zeros(len(order))
    goes_on = np.diff(series[order]) == 0
    correlation[1:][goes_on] = np.exp(-np.diff(place[order])[goes_on] / 0.4)
    return LastingErrors(order, correlation)


@pytest.fixture
def covariance(place: FloatArray, series: FloatArray) -> FloatArray:
    """(N, N) by the kernel exp(-d / 0.4 m) within each series."""
    apart = np.abs(place[:, None] - place)
    return np.asarray(np.exp(-apart / 0.4) * (series[:, None] == series))


def test_drawn_errors_have_the_covariance_of_the_process(errors: LastingErrors, covariance: FloatArray) -> None:
    root = errors.correlate(np.eye(len(covariance)))
    np.testing.assert_allclose(root @ root.T, covariance, atol=1e-12)


def test_squares_are_those_by_the_covariance(errors: LastingErrors, covariance: FloatArray) -> None:
    rows = np.random.default_rng(0).standard_normal((len(covariance), 3))
    np.testing.assert_allclose(errors.squares(rows), np.einsum("in,ij,jn->n", rows, covariance, rows))


def test_products_are_those_with_the_covariance(errors: LastingErrors, covariance: FloatArray) -> None:
    rows = np.random.default_rng(0).standard_normal((len(covariance), 3))
    np.testing.assert_allclose(errors.times(rows), covariance @ rows)


def test_correlation_sums_are_row_sums_of_the_covariance(errors: LastingErrors, covariance: FloatArray) -> None:
    np.testing.assert_allclose(errors.correlation_sums(), covariance.sum(axis=1))


def test_without_observations_there_is_nothing() -> None:
    none = LastingErrors(np.zeros(0, dtype=np.int64), np.zeros(0))
    assert none.correlate(np.zeros((0, 8))).shape == (0, 8)
    assert none.times(np.zeros((0, 8))).shape == (0, 8)
    assert none.squares(np.zeros((0, 8))).tolist() == [0.0] * 8
    assert none.correlation_sums().shape == (0,)
