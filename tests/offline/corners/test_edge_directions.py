"""Which way sides face, for cameras that see them too far in: as corners are predicted, not as they were seen."""

from dataclasses import replace

import numpy as np
import pytest

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.tags.edges import outward
from groundsbot.offline.corners.edge_directions import with_predicted_facings
from groundsbot.offline.corners.factors import CornerFactors, SpatialState
from tests.offline.corners.made_problems import CAMERAS, make_factors, make_state, plain_residual


def make_scene(model: str = "plumb_bob") -> tuple[CornerFactors, SpatialState]:
    rng = np.random.default_rng(3)
    return make_factors(rng, model), make_state(rng)


def predicted_px(factors: CornerFactors, state: SpatialState) -> FloatArray:
    """What the factors hold the seen corners against, of a camera that sees sides where they are."""
    sharp = replace(state, calibration=np.append(state.calibration[:-1], 0.0))  # the shift is the last one
    off = plain_residual(factors, sharp).reshape(-1, 4, 2) * factors.observations.sigma_px[:, None, None]
    return np.asarray(off + factors.observations.corners_px)


@pytest.mark.parametrize("model", CAMERAS)
def test_sides_face_as_the_state_has_them(model: str) -> None:
    factors, state = make_scene(model)
    faced = with_predicted_facings(factors, state)
    np.testing.assert_allclose(faced.observations.outward, outward(predicted_px(factors, state)), atol=1e-9)
    np.testing.assert_array_equal(faced.observations.corners_px, factors.observations.corners_px)


def test_noise_of_seen_corners_turns_no_side() -> None:
    factors, state = make_scene()
    seen = predicted_px(factors, state)
    noise = np.random.default_rng(4).standard_normal(seen.shape)
    clean, noisy = (
        with_predicted_facings(
            replace(factors, observations=factors.observations._replace(corners_px=each)), state
        ).observations.outward
        for each in (seen, seen + noise)
    )
    np.testing.assert_array_equal(clean, noisy)


def test_where_a_lens_has_no_image_sides_face_as_they_were_seen() -> None:
    factors, state = make_scene()
    behind = replace(state, tags=np.where(np.arange(len(state.tags))[:, None] == 1, -state.tags, state.tags))
    faced, hidden = with_predicted_facings(factors, behind), factors.observations.tag == 1
    np.testing.assert_array_equal(faced.observations.outward[hidden], factors.observations.outward[hidden])
    assert (faced.observations.outward[~hidden] != factors.observations.outward[~hidden]).any()
    assert np.isfinite(faced.observations.outward).all()
