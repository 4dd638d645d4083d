"""A drive alone ends near the truth, whatever its wheels do not tell and whatever ids are misread."""

from typing import Final

import numpy as np
import pytest

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.offline.estimate.estimate import _solve_alone
from groundsbot.offline.estimate.parameters import TURN_LOSS, Owned
from groundsbot.offline.estimate.start import Alone, _turns_anywhere, rigid
from groundsbot.offline.foundation import Stages
from tests.offline.estimate.made_drives import NO_FAULT, PLACES, Fault, Truth, fit, make_drive

SECONDS: Final = 90.0
TRUTH: Final = Truth(distance=-0.02, turn_left=-0.02, mount=(0.1, 0.0, 0.03), delay_s=0.1, depth=1.0)
WORST_M: Final = 0.12  # rms: some seconds without a tag leave the two sides of a turn this far apart


def alone(seed: int, fault: Fault = NO_FAULT, truth: Truth = TRUTH, seconds: float = SECONDS) -> Alone:
    drive = make_drive("a", seed, seconds, truth, fault=fault)
    return _solve_alone((drive.segment, NoiseParameters()), Stages())


def errors_m(found: Alone) -> FloatArray:
    """(T,) of all tags but for those that are under another id, by the fit of the others."""
    places = np.array([found.places[tag] for tag in sorted(found.places)])
    true = np.array([PLACES[tag.tag_id] for tag in sorted(found.places)])
    best = fit(places, true)
    return best.errors_m(places, true)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("at_s", [25.0, 41.0, 60.0])
def test_a_turn_that_the_wheels_do_not_tell(seed: int, at_s: float) -> None:
    found = alone(seed, Fault(turned_at_s=at_s, turned_rad=2.6))
    assert np.sqrt((errors_m(found) ** 2).mean()) < WORST_M


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("first", [0, 15], ids=["the first readings of a tag", "readings between others"])
@pytest.mark.parametrize("n", [5, 20])
def test_a_run_of_misread_ids(seed: int, first: int, n: int) -> None:
    """Tag 9 as tag 3, which is four metres away."""
    found = alone(seed, Fault(called=(9, 3, n, first)))
    assert np.sqrt((errors_m(found) ** 2).mean()) < WORST_M


@pytest.mark.parametrize("seed", range(2))
def test_distance_lost_in_turns_is_found(seed: int) -> None:
    truth = Truth(turn_loss=0.05, depth=1.0)
    found = alone(seed, truth=truth, seconds=240.0)
    index = found.problem.calibration.index(Owned("a", TURN_LOSS))
    assert index > 0
    column = found.problem.columns[2][index]
    sigma = np.sqrt(found.problem.factor_at(found.values, is_information=True).covariance(np.array([column]))[0, 0])
    assert abs(found.values.calibration[index] - 0.05) < 3.0 * sigma
    assert sigma < 0.02  # of 0.025 before


def test_a_turn_is_found_where_it_was() -> None:
    """From what is seen after it, and though a third of that is of other tags."""
    rng = np.random.default_rng(3)
    way = np.cumsum(rng.uniform(0.1, 0.5, (40, 2)), axis=0)
    seen = way[-1] + rng.uniform(-3.0, 3.0, (9, 2))
    cos, sin = np.cos(0.8), np.sin(0.8)
    target = way[17] + (seen - way[17]) @ np.array([[cos, sin], [-sin, cos]])
    target[::3] += [5.0, 2.0]
    assert (17, 0.8) in _turns_anywhere(way, seen, target)


def test_a_rigid_placement_is_exact_for_points_that_were_moved_as_one() -> None:
    a = np.random.default_rng(4).uniform(-3.0, 3.0, (5, 2))
    T = np.array([0.4, -1.2, 2.1])
    cos, sin = np.cos(T[2]), np.sin(T[2])
    np.testing.assert_allclose(rigid(a, a @ np.array([[cos, sin], [-sin, cos]]) + T[:2]), T, atol=1e-12)
