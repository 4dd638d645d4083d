"""The solve as a whole: where it ends, why it stops, and that neither order nor frame matters."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from groundsbot.calib.geometry import se2
from groundsbot.offline.sam.arrowhead import system
from groundsbot.offline.sam.factors.odometry_and_observations import State
from groundsbot.offline.sam.linearisation.robust_losses import SQUARES
from groundsbot.offline.sam.solver import Losses, Problem, solve
from tests.benchmarks.speed.solver_world import joint_start, make_fleet
from tests.support.data.graphs import make_graph, reorder

PLAIN = Losses(SQUARES, SQUARES)


@pytest.mark.parametrize("seed", range(4))
def test_long_drives_end_in_the_optimum_that_is_reached_from_the_truth(seed: int) -> None:
    fleet = make_fleet(seed, 3, 3000, 60)
    found = solve(fleet.problem, joint_start(fleet), losses=PLAIN)
    best = solve(fleet.problem, fleet.truth, losses=PLAIN)
    assert found.converged
    assert found.cost == pytest.approx(best.cost, rel=1e-9)
    np.testing.assert_allclose(found.state.tags, best.state.tags, atol=1e-6)
    np.testing.assert_allclose(found.state.poses[:, :2], best.state.poses[:, :2], atol=1e-6)


def test_a_loose_solve_does_not_end_where_the_cost_only_happens_to_fall_as_predicted() -> None:
    """From these starts a step that lowers the cost by a third of it does so to 1e-4 as predicted, in seed 7."""
    for seed in range(1, 9):
        fleet = make_fleet(seed, 2, 1000, 50)
        start = joint_start(fleet)
        found = solve(fleet.problem, start, losses=PLAIN, relative_tolerance=1e-7)
        best = solve(fleet.problem, start, losses=PLAIN)
        assert found.converged
        assert found.cost == pytest.approx(best.cost, rel=1e-6)


@given(seed=st.integers(0, 10**6))
@settings(max_examples=8, deadline=None)
def test_order_of_observations_does_not_matter(seed: int) -> None:
    fleet = make_fleet(seed, 2, 400, 12)
    problem, truth = fleet.problem, fleet.truth
    one = solve(problem, truth)
    other = solve(reorder(problem, np.random.default_rng(seed)), truth)
    np.testing.assert_allclose(other.state.tags, one.state.tags, atol=1e-6)
    np.testing.assert_allclose(se2.between(one.state.poses, other.state.poses), 0.0, atol=1e-6)


@given(seed=st.integers(0, 10**6), turn=st.floats(-3.0, 3.0))
@settings(max_examples=8, deadline=None)
def test_frame_does_not_matter(seed: int, turn: float) -> None:
    fleet = make_fleet(seed, 2, 400, 12)
    problem, truth = fleet.problem, fleet.truth
    T = np.array([30.0, -12.0, turn])
    moved = State(se2.compose(T, truth.poses), se2.apply(T, truth.tags), truth.calibration)
    one, other = solve(problem, truth), solve(problem, moved)
    np.testing.assert_allclose(other.state.tags, se2.apply(T, one.state.tags), atol=1e-6)
    np.testing.assert_allclose(se2.between(se2.compose(T, one.state.poses), other.state.poses), 0.0, atol=1e-6)


def test_a_fleet_without_spare_blocks_ends_in_the_same_state(monkeypatch: pytest.MonkeyPatch) -> None:
    """They are computed again after steps that fail, as some do from so far away."""
    fleet = make_fleet(0, 2, 100, 8)
    rng = np.random.default_rng(0)
    far = fleet.problem.retract(fleet.truth, 3.0 * rng.standard_normal(fleet.problem.columns.n))
    expected = solve(fleet.problem, far, losses=PLAIN)
    monkeypatch.setattr(system, "_MOST_WITH_SPARE", 0)
    found = solve(replace(fleet.problem), far, losses=PLAIN)
    assert found.n_linearised > len(found.costs)  # some steps failed
    assert found.costs == expected.costs
    np.testing.assert_array_equal(found.state.poses, expected.state.poses)


def test_what_nothing_ties_down_stays_finite_and_is_named() -> None:
    problem, truth = make_graph(3, [40, 40], 3, calibrated=False)
    only_first = problem.observations.pose < 40
    observations = replace(
        problem.observations,
        **{name: getattr(problem.observations, name)[only_first] for name in problem.observations.__dataclass_fields__},
    )
    loose = Problem(problem.odometry, observations, problem.prior, problem.columns, np.zeros(3, dtype=np.int64))
    found = solve(loose, truth)
    assert found.unobservable.segments == (1,)
    assert found.rank == problem.columns.n - 3
    assert np.isfinite(found.state.poses).all()
    sigma = np.sqrt(found.covariance(problem.columns.poses[60]).diagonal())
    assert (sigma > 1e3).all()


def test_other_weights_on_the_same_factors_solve_like_a_new_problem() -> None:
    problem, truth = make_graph(6, [60, 40], 6, calibrated=True)
    rng = np.random.default_rng(0)
    problem = reorder(problem, rng)
    odometry = problem.odometry.whitening * rng.uniform(0.5, 2.0, (len(problem.odometry.first), 1, 1))
    observations = problem.observations.whitening * rng.uniform(0.5, 2.0, (len(problem.observations.tag), 1, 1))
    anew = replace(
        problem,
        odometry=replace(problem.odometry, whitening=odometry),
        observations=replace(problem.observations, whitening=observations),
    )
    found, expected = solve(problem.reweigh(odometry, observations), truth), solve(anew, truth)
    assert found.cost == pytest.approx(expected.cost, rel=1e-12)
    np.testing.assert_allclose(found.state.tags, expected.state.tags, atol=1e-9)
