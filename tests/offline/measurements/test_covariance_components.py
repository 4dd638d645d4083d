"""Covariances are propagated as by plain matrix products, whatever their shapes."""

import numpy as np
import pytest

from groundsbot.offline.measurements.covariance_components import propagate


@pytest.mark.parametrize(
    ("jacobian", "covariance"),
    [
        ((7, 3, 3), (7, 3, 3)),
        ((7, 3, 3), (4, 7, 3, 3)),
        ((3, 3), (7, 3, 3)),
        ((7, 2, 2), (4, 7, 2, 2)),
        ((0, 3, 3),) * 2,
    ],
)
def test_propagated_covariances_are_products(jacobian: tuple[int, ...], covariance: tuple[int, ...]) -> None:
    rng = np.random.default_rng(0)
    J, C = rng.standard_normal(jacobian), rng.standard_normal(covariance)
    found = propagate(J, C.swapaxes(-1, -2))
    np.testing.assert_allclose(found, np.einsum("...ij,...kj,...lk->...il", J, C, J), rtol=1e-12, atol=1e-14)
