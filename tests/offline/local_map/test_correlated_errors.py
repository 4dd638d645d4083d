"""Errors that neighbouring observations of a tag share: how large, and that they raise no alarm and hide none."""

from dataclasses import replace

import numpy as np
import pytest

from groundsbot.offline.local_map.correlated_errors import CorrelatedErrors, fit_correlated_errors
from groundsbot.offline.local_map.goodness_of_fit import fit_windows
from groundsbot.offline.local_map.windows import in_windows
from groundsbot.offline.sam.factors.odometry_and_observations import State
from groundsbot.offline.sam.factors.priors import DistanceFactors, Priors, StartFactors
from groundsbot.offline.sam.graph import Graph, build_graph
from groundsbot.offline.sam.solver import PLAIN_SQUARES, solve
from tests.support.data.long_drives import LongDrive, make_long_drive, with_a_moved_tag, with_drifting_observations

LENGTH_M = 500.0
SIGMAS = 1.5
DRIFT_M = 2.0


def dense_drive(seed: int) -> LongDrive:
    """A picture every 5 cm, and noise as given."""
    return make_long_drive(seed, LENGTH_M, picture_every=1, noise_factors=(1.0, 1.0))


def drifting_graph(drive: LongDrive) -> Graph:
    return build_graph([with_drifting_observations(drive.segment, SIGMAS, DRIFT_M, seed=1)])


@pytest.mark.parametrize("seed", [4, 7, 8])
def test_errors_that_neighbours_share_raise_no_alarm(seed: int) -> None:
    """As independent ones these would: for that they cost too much."""
    drive = dense_drive(seed)
    graph = drifting_graph(drive)
    best = solve(graph.problem, drive.true_state(graph))
    windows = fit_windows(graph.problem)
    assert windows.goodness_of_fit(best.state).fits


def test_a_moved_tag_is_noticed_among_them() -> None:
    drive = dense_drive(5)
    drifting = with_drifting_observations(drive.segment, SIGMAS, DRIFT_M, seed=1)
    graph = build_graph([with_a_moved_tag(drive, drifting)])
    best = solve(graph.problem, drive.true_state(graph))
    assert not fit_windows(graph.problem).goodness_of_fit(best.state).fits


def test_a_wrong_end_is_noticed_among_them() -> None:
    """Plain Levenberg-Marquardt from dead reckoning ends there."""
    drive = dense_drive(0)
    graph = drifting_graph(drive)
    right = solve(graph.problem, drive.true_state(graph))
    wrong = solve(graph.problem, graph.start(drive.segment.odometry.dead_reckon(), {}, {}))
    assert wrong.converged
    assert wrong.cost > 1.01 * right.cost
    windows = fit_windows(graph.problem)
    assert windows.goodness_of_fit(right.state).fits
    assert not windows.goodness_of_fit(wrong.state).fits


@pytest.mark.parametrize("drawn", [0.0, 1.0])
def test_the_shared_part_is_found(drawn: float) -> None:
    """Ranges err by what a cell shares, of a variance as drawn, or by nothing more than each observation's own."""
    shared, own = [], []
    for seed in range(4):
        drive = dense_drive(seed)
        problem = build_graph([drive.segment]).problem
        observations = problem.observations
        cell = np.unique(10_000 * observations.tag + observations.pose // 50, return_inverse=True)[1]
        error = np.sqrt(drawn) * np.random.default_rng(seed).standard_normal(cell.max() + 1)[cell]
        value = observations.value + np.column_stack([error / observations.whitening[:, 0, 0], np.zeros(len(cell))])
        windows = in_windows(replace(problem, observations=replace(observations, value=value)))
        places = np.zeros((len(windows.columns.tags), 2))
        true = drive.true_state(build_graph([drive.segment]))
        places[windows.observations.tag] = true.tags[observations.tag]
        found = fit_correlated_errors(solve(windows, replace(true, tags=places), losses=PLAIN_SQUARES), cell)
        shared.append(found.common_variance[0])
        own.append(found.independent_variance[0])
    # Shared parts are held to what was assumed before, none; the own ones take up what is lacking.
    assert np.mean(own) == pytest.approx(1.0, abs=0.05 + 0.05 * drawn)
    assert 0.5 * drawn <= np.mean(shared) < max(1.1 * drawn, 0.04)


def test_factors_and_freedom_follow_from_the_parts() -> None:
    """Two cells of one and three observations: variances of own 1 and shared 2 make 3 and 7 of an observation's."""
    errors = CorrelatedErrors(
        np.array([1.0, 0.5]), np.array([100.0, 100.0]), np.array([2.0, 0.0]), np.array([5.0, 5.0])
    )
    cell = np.array([0, 1, 1, 1])
    np.testing.assert_allclose(errors.factors(cell) ** 2, [[3.0, 0.5], [7.0, 0.5], [7.0, 0.5], [7.0, 0.5]])
    known = np.array([[0.0, 0.0], [1.0, 1.0], [3.0, 3.0], [0.0, 0.0]])  # to be shared, observation by observation
    wanted = [[3.0, 0.5], [7.0, 3.5], [10.0, 9.5], [7.0, 0.5]]
    np.testing.assert_allclose(errors.factors(cell, known) ** 2, wanted)
    # Sums over observations: own 4 and 2, shared 2 (1 + 3 + 3 + 3) = 20.
    assert errors.degrees_of_freedom(cell) == pytest.approx(26.0**2 / (4.0**2 / 100.0 + 2.0**2 / 100.0 + 20.0**2 / 5.0))


def test_drives_that_only_a_tape_joins_have_nothing_to_contradict() -> None:
    segment = dense_drive(0).segment.prefix(200)
    segment = replace(segment, tags=(), observations=segment.observations.where(segment.observations.tag < 0))
    problem = build_graph([segment, segment]).problem
    none, first, second = np.array([-1]), np.array([0]), np.array([200])
    placed = np.array([[3.0, 4.0, 0.0]])
    measured = Priors(
        StartFactors(second, placed, np.diag([100.0, 100.0, 100.0])[None]),
        DistanceFactors(first, none, second, none, np.array([9.0]), np.array([0.01])),
    )
    alone = segment.odometry.dead_reckon()
    poses = np.concatenate([alone, alone + placed])
    state = State(poses, np.zeros((0, 2)), np.zeros(len(problem.prior.sigma)))
    verdict = fit_windows(replace(problem, measured=measured)).goodness_of_fit(state)
    assert verdict.expected == 0
    assert verdict.fits
