"""Whether NEES judges a bent map by its covariance, and nothing but the covariance."""

import numpy as np
import pytest
from scipy.stats import chi2

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.offline.evaluation.nees import link_errors, nees_per_dim

_N_STEPS = 12
_STEP_M = 5.0
_SIGMA_HEADING_RAD = np.radians(3.0)  # a step; some 10 degrees at the end
_SIGMA_STEP_M = 0.02
_SIGMA_TAG_M = 0.001


def _corridor(x: FloatArray) -> FloatArray:
    """(4 * steps,) tags on both sides of a drive: by heading changes, by lengths of steps, by offsets of tags."""
    theta = np.cumsum(x[:_N_STEPS])
    lengths_m, offsets_m = x[_N_STEPS : 2 * _N_STEPS], x[2 * _N_STEPS :].reshape(_N_STEPS, 2, 2)
    along = np.stack([np.cos(theta), np.sin(theta)], axis=-1)
    side = np.stack([-along[:, 1], along[:, 0]], axis=-1)
    path = np.cumsum(lengths_m[:, None] * along, axis=0)
    pairs = np.stack([path + side, path - side], axis=1)
    places: FloatArray = (pairs + offsets_m[..., :1] * along[:, None] + offsets_m[..., 1:] * side[:, None]).reshape(-1)
    return places


def _draw(rng: np.random.Generator) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Places found, true places, and the covariance that is right for them: J S J^T at the found."""
    sigma = np.repeat([_SIGMA_HEADING_RAD, _SIGMA_STEP_M, _SIGMA_TAG_M], [_N_STEPS, _N_STEPS, 4 * _N_STEPS])
    x = np.concatenate([rng.normal(0.0, 0.2, _N_STEPS), np.full(_N_STEPS, _STEP_M), np.zeros(4 * _N_STEPS)])
    wrong = sigma * rng.standard_normal(len(sigma))
    step = 1e-6 * np.eye(len(sigma))
    jacobian = np.stack([(_corridor(x + d) - _corridor(x - d)) / 2e-6 for d in step], axis=-1)
    return (
        _corridor(x).reshape(-1, 2),
        _corridor(x - wrong).reshape(-1, 2),
        jacobian @ np.diag(sigma**2) @ jacobian.T,
    )


def _nees(errors_m: FloatArray, covariance: FloatArray) -> float:
    found = nees_per_dim(errors_m.reshape(-1), covariance)
    assert found is not None
    return found


def _honest(nees: list[float], dim: int) -> bool:
    """Whether the mean of NEES of maps of so many dimensions is what chance makes of right covariances."""
    n = len(nees) * dim
    return bool(chi2.ppf(0.0005, n) / n < np.mean(nees) < chi2.ppf(0.9995, n) / n)


def test_a_map_that_bends_as_its_covariance_predicts_is_consistent() -> None:
    rng = np.random.default_rng(4)
    plain, bent = [], []
    for _ in range(20):
        found, true, covariance = _draw(rng)
        plain.append(_nees(found - true, covariance))
        bent.append(_nees(link_errors(found, true, covariance), covariance))
    assert _honest(bent, 4 * _N_STEPS)
    assert np.mean(plain) > 10.0  # what a straight comparison makes of the same maps


def test_a_map_rotated_far_about_its_start_is_consistent() -> None:
    """Known to a centimetre in length and to a quarter of its length across."""
    rng = np.random.default_rng(5)
    found, covariance = np.array([[10.0, 0.0]]), np.diag([0.01**2, 2.5**2])
    nees = []
    for _ in range(200):
        length, angle = 10.0 + 0.01 * rng.standard_normal(), 0.25 * rng.standard_normal()
        true = length * np.array([[np.cos(angle), np.sin(angle)]])
        nees.append(_nees(link_errors(found, true, covariance), covariance))
    assert _honest(nees, 2)


def test_a_spur_behind_an_uncertain_link_does_not_dominate_the_rest() -> None:
    """Two tags out of sight of the rest turn as one, by degrees more than what they are near to."""
    rng = np.random.default_rng(6)
    corridor = np.array([[6.0, 0.0], [12.0, 0.0], [18.0, 0.0]])
    spur = np.array([[8.0, 1.0], [10.0, 1.0]])
    found = np.concatenate([corridor, spur])

    def placed(x: FloatArray) -> FloatArray:
        """By one turn of the corridor, one of the spur about the link's end, its position, and millimetres."""
        turn, of_spur = ((np.cos(a), np.sin(a)) for a in (x[0], x[1]))
        rotation, rotation_of_spur = (np.array([[c, -s], [s, c]]) for c, s in (turn, of_spur))
        spur_m = (spur - spur[0]) @ rotation_of_spur.T + spur[0] @ rotation.T + x[2:4]
        return np.concatenate([corridor @ rotation.T, spur_m]) + x[4:].reshape(-1, 2)

    sigma = np.concatenate([np.radians([5.0, 8.0]), [0.1, 0.2], np.full(10, 1e-3)])
    step = 1e-6 * np.eye(len(sigma))
    jacobian = np.stack([((placed(d) - placed(-d)) / 2e-6).reshape(-1) for d in step], axis=-1)
    covariance = jacobian @ np.diag(sigma**2) @ jacobian.T
    nees = [
        _nees(link_errors(found, placed(-sigma * rng.standard_normal(len(sigma))), covariance), covariance)
        for _ in range(100)
    ]
    assert _honest(nees, 10)


def test_a_covariance_that_claims_too_much_is_found_out_in_a_bent_map() -> None:
    found, true, covariance = _draw(np.random.default_rng(7))
    errors = link_errors(found, true, covariance)
    honest = _nees(errors, covariance)
    assert _nees(errors, covariance / 4.0) == pytest.approx(4.0 * honest)
    # a tag one centimetre off, where the map knows its neighbour to 1.4 mm
    found[7, 0] += 0.01
    worse = _nees(link_errors(found, true, covariance), covariance)
    assert (worse - honest) * errors.size > chi2.ppf(0.999, 2)


def test_small_errors_stand_as_they_are() -> None:
    found, true, covariance = _draw(np.random.default_rng(8))
    small = found + 1e-4 * (true - found)
    errors = link_errors(found, small, covariance)
    assert errors == pytest.approx(found - small, abs=1e-3 * np.abs(found - small).max())


@pytest.mark.parametrize("sigmas_apart", [0.0, 0.5, 1.0, 2.0, 6.0])
def test_two_runs_that_start_side_by_side_are_consistent(sigmas_apart: float) -> None:
    """Nearer to each other than they are known, too: there a length and a direction would not do."""
    rng = np.random.default_rng(9)
    true = np.array([[0.01 * sigmas_apart, 0.0]])
    nees = [
        _nees(link_errors(true + 0.01 * rng.standard_normal((1, 2)), true, 1e-4 * np.eye(2)), 1e-4 * np.eye(2))
        for _ in range(400)
    ]
    assert _honest(nees, 2)


@pytest.mark.parametrize("scale", [1e-9, 1e6])
def test_units_do_not_matter(scale: float) -> None:
    found, true, covariance = _draw(np.random.default_rng(10))
    errors = link_errors(scale * found, scale * true, scale**2 * covariance)
    assert errors == pytest.approx(scale * link_errors(found, true, covariance), rel=1e-6)


def test_places_that_may_be_one_have_no_direction() -> None:
    """A run that started where the frame did, and a tag beside it known to 10 cm: differences count as they are."""
    found, true = np.array([[0.0, 0.0], [0.02, 0.0]]), np.array([[0.003, -0.004], [-0.05, 0.01]])
    errors = link_errors(found, true, np.diag([1e-4, 1e-4, 1e-2, 1e-2]))
    assert errors == pytest.approx(found - true, abs=1e-12)
