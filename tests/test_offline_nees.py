"""Whether NEES judges a bent map by its covariance, and nothing but the covariance."""

import numpy as np
import pytest
from scipy.stats import chi2

from calib.arrays import FloatArray
from offline.nees import errors_along_arcs, nees_per_dim

_N_STEPS = 12
_STEP_M = 5.0
_SIGMA_HEADING_RAD = np.radians(1.5)  # a step; some 5 degrees at the end
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


def _drawn(rng: np.random.Generator) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Places found, true places, the turn at each, and the covariance that is right for them: J S J^T at the found."""
    sigma = np.repeat([_SIGMA_HEADING_RAD, _SIGMA_STEP_M, _SIGMA_TAG_M], [_N_STEPS, _N_STEPS, 4 * _N_STEPS])
    x = np.concatenate([rng.normal(0.0, 0.2, _N_STEPS), np.full(_N_STEPS, _STEP_M), np.zeros(4 * _N_STEPS)])
    wrong = sigma * rng.standard_normal(len(sigma))
    step = 1e-6 * np.eye(len(sigma))
    jacobian = np.stack([(_corridor(x + d) - _corridor(x - d)) / 2e-6 for d in step], axis=-1)
    turn = np.repeat(np.cumsum(wrong[:_N_STEPS]), 2)
    return (
        _corridor(x).reshape(-1, 2),
        _corridor(x - wrong).reshape(-1, 2),
        turn,
        jacobian @ np.diag(sigma**2) @ jacobian.T,
    )


def _nees(errors_m: FloatArray, covariance: FloatArray) -> float:
    found = nees_per_dim(errors_m.reshape(-1), covariance)
    assert found is not None
    return found


def test_a_map_that_bends_as_its_covariance_says_is_honest() -> None:
    rng = np.random.default_rng(4)
    plain, along_arcs = [], []
    for _ in range(20):
        found, true, turn, covariance = _drawn(rng)
        plain.append(_nees(found - true, covariance))
        along_arcs.append(_nees(errors_along_arcs(found, true, turn, covariance), covariance))
    n = 20 * 4 * _N_STEPS
    assert chi2.ppf(0.0005, n) / n < np.mean(along_arcs) < chi2.ppf(0.9995, n) / n
    assert np.mean(plain) > 3.0  # what a straight comparison makes of the same maps


def test_a_covariance_that_claims_too_much_is_found_out_in_a_bent_map() -> None:
    found, true, turn, covariance = _drawn(np.random.default_rng(5))
    errors = errors_along_arcs(found, true, turn, covariance)
    honest = _nees(errors, covariance)
    assert _nees(errors, covariance / 4.0) == pytest.approx(4.0 * honest)
    # a tag one centimetre off, where the map knows its neighbour to 1.4 mm
    found[7, 0] += 0.01
    worse = _nees(errors_along_arcs(found, true, turn, covariance), covariance)
    assert (worse - honest) * errors.size > chi2.ppf(0.999, 2)


def test_without_a_turn_errors_stand_as_they_are() -> None:
    found, true, turn, covariance = _drawn(np.random.default_rng(6))
    errors = errors_along_arcs(found, true, np.zeros_like(turn), covariance)
    assert errors == pytest.approx(found - true, abs=1e-9)


def test_a_turn_told_wrongly_hides_nothing_of_the_first_order() -> None:
    found, true, turn, covariance = _drawn(np.random.default_rng(7))
    small = true + 1e-3 * (found - true)
    told = errors_along_arcs(small, true, 1e-3 * np.flip(turn), covariance)
    assert told == pytest.approx(small - true, abs=3e-3 * np.abs(small - true).max())
