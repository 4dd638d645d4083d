"""The noise of simulated drives, found again from far off."""

import numpy as np
import pytest

from tests.benchmarks.noise_study import study_seed


@pytest.mark.parametrize("factor", [0.1, 10.0])
def test_the_noise_of_a_drive_is_found_from_ten_times_too_large_and_too_small(factor: float) -> None:
    found = study_seed(3, "room", factor)
    # Wheels that slip go sideways too, which no lateral noise was drawn for.
    told = [each for each in found if each.fitted.told and each.fitted.name != "sigma_lateral_m_per_sqrt_m"]
    assert {each.fitted.name for each in told} >= {"sigma_corner_px", "sigma_distance_m_per_sqrt_m"}
    deviations = [np.log(each.ratio) * 2.576 / np.log(each.fitted.high / each.fitted.value) for each in told]
    assert np.abs(deviations).max() < 4.0
