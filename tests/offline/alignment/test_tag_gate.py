"""Whether a tag fits where others predict it, and where a wrong one may be."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import multivariate_normal

from groundsbot.offline.alignment.model_selection import log_chance_likelihood
from groundsbot.offline.alignment.tag_gate import (
    TAG_GATE,
    gate_ratio,
    log_likelihood_ratio,
    log_outlier_density,
    squared_sigmas,
)


def test_a_wrong_tag_is_somewhere_and_each_order_of_magnitude_is_as_likely() -> None:
    def share(from_m: float, to_m: float) -> float:
        return float(quad(lambda r: 2.0 * np.pi * r * np.exp(log_outlier_density(np.array(r * r))), from_m, to_m)[0])

    assert share(0.0, 100.0) == pytest.approx(1.0, rel=1e-6)
    assert share(3.0, 9.0) == pytest.approx(share(9.0, 27.0), rel=0.03)


def test_the_weight_of_a_tag_is_the_ratio_of_its_density_to_that_of_a_wrong_one() -> None:
    covariance = np.array([[0.5, 0.2], [0.2, 0.3]])
    off_m = np.array([[0.4, -0.9]])
    by_chance = log_outlier_density(np.array([0.4**2 + 0.9**2 + 0.8]))
    worth = log_likelihood_ratio(off_m, covariance[None])
    assert worth == pytest.approx(multivariate_normal(np.zeros(2), covariance).logpdf(off_m[0]) - by_chance)


@pytest.mark.parametrize("sigma_m", [0.02, 0.3, 1.0, 10.0])
def test_it_fits_as_far_as_chance_takes_it_and_being_wrong_explains_it_less(sigma_m: float) -> None:
    off_m = sigma_m * np.column_stack([np.linspace(0.0, 6.0, 200), np.zeros(200)])
    covariance = np.tile(sigma_m**2 * np.eye(2), (200, 1, 1))
    fits = gate_ratio(off_m, covariance) < 1.0
    inside = squared_sigmas(off_m, covariance) < TAG_GATE
    assert (fits == (inside & (log_likelihood_ratio(off_m, covariance) > 0.0))).all()
    assert 0 < fits.sum() < 200


def test_a_tag_predicted_to_metres_is_weak_evidence() -> None:
    """Less than a factor of 20 however far that is, and more than 1,000 where it is predicted to centimetres."""
    worth = log_likelihood_ratio(np.zeros((3, 2)), np.array([30.0, 3.0, 0.03])[:, None, None] ** 2 * np.eye(2))
    assert (worth[:2] < np.log(20.0)).all()
    assert worth[2] > np.log(1000.0)


def test_chance_is_the_weight_of_wrong_tags_about_each_at_the_typical_heading() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.uniform(-20.0, 20.0, (2, 5, 2))
    heading = np.linspace(-np.pi, np.pi, 20_000, endpoint=False)
    turn = np.exp(1j * heading)
    a_i, b_i = (p[:, 0] + 1j * p[:, 1] for p in (a, b))
    by_tag = []
    for i in range(5):
        off = (a_i - a_i[i])[None] - turn[:, None] * (b_i - b_i[i])[None]
        log_each = log_outlier_density(np.abs(np.delete(off, i, axis=1)) ** 2)
        by_tag.append(2.0 * np.pi * np.exp(log_each.sum(axis=1).mean()))
    assert log_chance_likelihood(a, b) == pytest.approx(np.log(2.0 * np.mean(by_tag)), abs=0.05)
