"""Whitened components of a small problem against their dense covariances."""

import numpy as np
import pytest

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.offline.noise.components import Components
from groundsbot.offline.noise.lasting_errors import LastingErrors
from groundsbot.offline.noise.whitened_components import WhitenedComponents
from tests.support.data.problems import make_problem

_PROBLEM = make_problem(3, 0.7).problem
_N_MOTIONS, _N_OBSERVATIONS = len(_PROBLEM.odometry.whitening), len(_PROBLEM.observations.whitening)
_OWN, _COMMON = 0, 1


def _covariances(rng: np.random.Generator, m: int, n: int) -> FloatArray:
    root = rng.standard_normal((m, n, n))
    return np.asarray(root @ root.swapaxes(-1, -2))


@pytest.fixture(scope="module")
def components() -> Components:
    """One component of motions and observations, one of the stamps of pictures, one kind of shared errors."""
    rng = np.random.default_rng(5)
    stamp, jitter = rng.standard_normal((2, _N_OBSERVATIONS, 2))
    rest = _covariances(rng, _N_OBSERVATIONS, 2) + jitter[:, :, None] * jitter[:, None, :]
    order = rng.permutation(_N_OBSERVATIONS)
    return Components(
        odometry=np.array([_covariances(rng, _N_MOTIONS, 3), np.zeros((_N_MOTIONS, 3, 3))]),
        odometry_rest=_covariances(rng, _N_MOTIONS, 3),
        observations=np.array([_covariances(rng, _N_OBSERVATIONS, 2), stamp[:, :, None] * stamp[:, None, :]]),
        observations_rest=rest,
        lasting=(LastingErrors(order, np.where(np.arange(_N_OBSERVATIONS) % 4 == 0, 0.0, 0.6)),),
        lasting_root=rng.standard_normal((_N_OBSERVATIONS, 2, 2)),
        common=_COMMON,
        common_root=stamp,
        jitter_root=jitter,
        picture=np.arange(_N_OBSERVATIONS, dtype=np.int64) // 3,
    )


@pytest.fixture(scope="module")
def dense(components: Components) -> FloatArray:
    """(C + 1, R, R) whitened covariances by component, then of what no variance scales."""
    whitening = _block_diagonal([*_PROBLEM.odometry.whitening, *_PROBLEM.observations.whitening])
    assert components.common_root is not None
    assert components.jitter_root is not None
    assert components.lasting_root is not None
    assert components.picture is not None
    same_picture = components.picture[:, None] == components.picture
    rest = components.observations_rest - components.jitter_root[:, :, None] * components.jitter_root[:, None, :]
    found = [_block_diagonal([*components.odometry[_OWN], *components.observations[_OWN]])]
    found.append(_of_observations(components.common_root, same_picture))
    correlation = components.lasting[0].correlate(np.eye(_N_OBSERVATIONS))
    found += [_of_observations(components.lasting_root[..., axis], correlation @ correlation.T) for axis in (0, 1)]
    found.append(
        _block_diagonal([*components.odometry_rest, *rest]) + _of_observations(components.jitter_root, same_picture)
    )
    return np.asarray(whitening @ np.array(found) @ whitening.T)


def _block_diagonal(blocks: list[FloatArray]) -> FloatArray:
    found = np.zeros((sum(map(len, blocks)),) * 2)
    at = 0
    for block in blocks:
        found[at : at + len(block), at : at + len(block)] = block
        at += len(block)
    return found


def _of_observations(root: FloatArray, correlation: FloatArray) -> FloatArray:
    found = np.zeros((3 * _N_MOTIONS + 2 * _N_OBSERVATIONS,) * 2)
    blocks = root[:, None, :, None] * root[None, :, None, :] * correlation[:, :, None, None]
    found[3 * _N_MOTIONS :, 3 * _N_MOTIONS :] = blocks.transpose(0, 2, 1, 3).reshape((2 * _N_OBSERVATIONS,) * 2)
    return found


def test_products_and_squares_are_those_with_the_covariances(components: Components, dense: FloatArray) -> None:
    whitened = WhitenedComponents(_PROBLEM, components)
    rows = np.random.default_rng(0).standard_normal((whitened.n_rows, 3))
    np.testing.assert_allclose(whitened.times(rows), dense[:-1] @ rows, atol=1e-9 * np.abs(dense).max())
    np.testing.assert_allclose(whitened.squares(rows), np.einsum("rn,crs,sn->cn", rows, dense[:-1], rows))


def test_random_errors_have_the_sum_of_the_covariances(components: Components, dense: FloatArray) -> None:
    whitened = WhitenedComponents(_PROBLEM, components)
    variances = np.array([0.5, 2.0, 0.3, 0.8])
    n = 40_000
    errors = whitened.random_errors(variances, n, np.random.default_rng(1))
    expected = np.tensordot(np.append(variances, 1.0), dense, 1)
    sigma = np.sqrt(np.diag(expected))
    # The correlation of n pairs of independent errors has the standard deviation 1 / sqrt(n).
    deviation = (errors @ errors.T / n - expected) / (sigma[:, None] * sigma)
    assert np.abs(deviation).max() < 6.0 / np.sqrt(n)
