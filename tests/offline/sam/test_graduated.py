"""Graduated non-convexity: it ends among the right readings where Huber's loss does not, and changes nothing else."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from groundsbot.calib.foundation.arrays import BoolArray, FloatArray, IntArray
from groundsbot.offline.sam.factors.odometry_and_readings import ReadingFactors, State
from groundsbot.offline.sam.factors.robust_losses import SQUARES, huber, truncated
from groundsbot.offline.sam.graduated import solve_graduated
from groundsbot.offline.sam.solver import DEFAULT_LOSSES, PLAIN_SQUARES, Losses, Problem, Solution, solve
from tests.benchmarks.speed.solver_world import SIGMA_START, Fleet, made_fleet

# Beyond this lies one good reading in a million.
GATE = float(np.sqrt(chi2.isf(1e-6, 2)))
WRONG_SHARE = 0.4
ENOUGH_READINGS = 10


def with_wrong_readings(fleet: Fleet, seed: int) -> tuple[Problem, BoolArray]:
    """Ranges and bearings of nothing in 40 % of the readings, and (M,) which they are."""
    rng = np.random.default_rng(seed)
    readings = fleet.problem.readings
    wrong = rng.random(len(readings.pose)) < WRONG_SHARE
    wrong[np.unique(readings.tag, return_index=True)[1]] = False  # each tag is read rightly once
    n = int(wrong.sum())
    value = readings.value.copy()
    value[wrong] = np.column_stack([rng.uniform(0.5, 6.0, n), rng.uniform(-1.0, 1.0, n)])
    return replace(fleet.problem, readings=replace(readings, value=value)), wrong


def right_only(problem: Problem, wrong: BoolArray) -> Problem:
    names = problem.readings.__dataclass_fields__
    right = ReadingFactors(**{name: getattr(problem.readings, name)[~wrong] for name in names})
    return replace(problem, readings=right)


def sigmas_off(state: State, reference: Solution, tags: IntArray) -> FloatArray:
    """(T,) how far tags are from where the reference has them, in its sigmas."""
    errors = []
    for tag in tags:
        covariance = reference.covariance(reference.problem.columns.tags[tag])
        off = state.tags[tag] - reference.state.tags[tag]
        errors.append(np.sqrt(off @ np.linalg.solve(covariance, off)))
    return np.array(errors)


def spoilt_start(fleet: Fleet, problem: Problem) -> State:
    """From the pass in order of time, which believes each reading: metres off."""
    sigma = np.tile(SIGMA_START, (fleet.n_robots, 1))
    sigma[0] = 1e-6
    return problem.skeleton.starting_values(fleet.dead_reckoned, sigma)


@pytest.mark.parametrize("seed", range(6))
def test_it_finds_the_right_readings_among_many_wrong_ones(seed: int) -> None:
    """Within a sigma of the solution that knows which readings are right; Huber's is not."""
    fleet = made_fleet(seed, 2, 500, 30)
    problem, wrong = with_wrong_readings(fleet, seed)
    start = spoilt_start(fleet, problem)
    reference = solve(right_only(problem, wrong), fleet.truth, losses=PLAIN_SQUARES)
    tags = np.flatnonzero(np.bincount(problem.readings.tag[~wrong], minlength=30) >= ENOUGH_READINGS)
    assert len(tags) > 10
    found = solve_graduated(problem, start, Losses(SQUARES, truncated(GATE)))
    by_huber = solve(problem, start, losses=DEFAULT_LOSSES)
    assert found.converged
    assert sigmas_off(found.state, reference, tags).max() < 1.0
    assert sigmas_off(by_huber.state, reference, tags).max() > 1.0


@pytest.mark.parametrize("seed", range(3))
def test_it_agrees_with_plain_squares_where_nothing_is_wrong(seed: int) -> None:
    fleet = made_fleet(seed, 2, 500, 30)
    plain = solve(fleet.problem, fleet.truth, losses=PLAIN_SQUARES)
    assert np.linalg.norm(fleet.problem.readings.residual(plain.state), axis=1).max() < GATE
    found = solve_graduated(fleet.problem, fleet.dead_reckoned, Losses(SQUARES, truncated(GATE)))
    np.testing.assert_allclose(found.state.tags, plain.state.tags, atol=1e-6)
    assert found.cost == pytest.approx(plain.cost, rel=1e-9)
    assert found.n_linearised > len(found.costs)


def test_losses_that_forget_nothing_are_left_alone() -> None:
    fleet = made_fleet(3, 1, 300, 20)
    losses = Losses(huber(3.0), huber(2.0))
    plain, found = (method(fleet.problem, fleet.truth, losses=losses) for method in (solve, solve_graduated))
    assert found.cost == pytest.approx(plain.cost, rel=1e-9)


def test_a_tag_of_which_no_reading_fits_keeps_a_place_and_a_wide_covariance() -> None:
    fleet = made_fleet(4, 1, 300, 20)
    readings = fleet.problem.readings
    tag = int(np.argmax(np.bincount(readings.tag)))
    (of_tag,) = np.nonzero(readings.tag == tag)
    value, rng = readings.value.copy(), np.random.default_rng(4)
    value[of_tag] = np.column_stack([rng.uniform(50.0, 500.0, len(of_tag)), rng.uniform(-3.0, 3.0, len(of_tag))])
    problem = replace(fleet.problem, readings=replace(readings, value=value))
    found = solve(problem, fleet.truth, losses=Losses(SQUARES, truncated(GATE)))
    assert np.isfinite(found.state.tags).all()
    columns = problem.columns.tags[tag]
    by_readings = solve(fleet.problem, fleet.truth, losses=PLAIN_SQUARES).covariance(columns)
    assert np.trace(found.covariance(columns)) > 1e4 * np.trace(by_readings)
