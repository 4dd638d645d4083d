"""Every Jacobian block agrees with finite differences, and the gradient is that of the cost."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.sam.factors.odometry_and_observations import Linearised, State, whitening
from groundsbot.offline.sam.linearisation.observations import FADED_BELOW
from groundsbot.offline.sam.linearisation.robust_losses import (
    SQUARES,
    Loss,
    huber,
    losses_and_weights,
)
from groundsbot.offline.sam.solver import Problem
from tests.support.data.problems import BATCHES, CALIBRATION_SIGMA, N_CALIBRATION, WHEELS, make_problem, random_state

KINDS = ("odometry", "observations", "prior")
SEEDS = range(5)


def dense(kind: Linearised, n_columns: int) -> FloatArray:
    """(m n, columns): the blocks where they belong; blocks on the same columns add up."""
    jacobian = np.zeros((*kind.residual.shape, n_columns + 1))
    for columns, derivative in kind.blocks:
        assert columns.shape == (derivative.shape[0], derivative.shape[2])
        for row in range(len(columns)):
            for k, column in enumerate(columns[row]):
                jacobian[row, :, column] += derivative[row, :, k]
    return jacobian[..., :n_columns].reshape(-1, n_columns)


def numeric(residual: Callable[[State], FloatArray], problem: Problem, state: State, h: float = 1e-6) -> FloatArray:
    """The same by central differences in the tangent space."""
    columns = []
    for step in h * np.eye(problem.columns.n):
        ahead, behind = residual(problem.retract(state, step)), residual(problem.retract(state, -step))
        columns.append((ahead - behind).reshape(-1) / (2 * h))
    return np.array(columns).T


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", SEEDS)
def test_jacobian_blocks_agree_with_finite_differences(kind: str, seed: int) -> None:
    """Anywhere, far from where the measurements are met: nothing may be left out because it is small at the truth."""
    problem = make_problem(seed).problem
    factors, state = getattr(problem, kind), random_state(seed + 100)
    linearised = factors.linearise(state, problem.columns)
    np.testing.assert_allclose(linearised.residual, factors.residual(state), rtol=1e-12, atol=1e-9)
    expected = numeric(factors.residual, problem, state)
    # A reading may sit where its bearing changes fast: compare in units of what each row holds.
    scale = np.maximum(np.abs(expected).max(axis=1, keepdims=True), 1.0)
    np.testing.assert_allclose(dense(linearised, problem.columns.n) / scale, expected / scale, atol=2e-7)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_bearing_fades_out_smoothly_where_the_tag_is_predicted_at_the_sensor(seed: int) -> None:
    """The residuals are continuous at the limit and at the sensor, and the blocks are their derivatives."""
    problem, state = make_problem(seed).problem, random_state(seed + 100)
    polar = np.flatnonzero(problem.observations.polar)[:1]
    factors = problem.observations.part(polar)
    (tag,), (pose,), ((range_m, _),) = factors.tag, factors.pose, factors.value
    T_map_sensor = se2.compose(state.poses[pose], factors.mount[0] + state.calibration[factors.mount_parameters[0]])
    scale = 1.0 + state.calibration[factors.scale_parameter[0]]

    def at(share: float) -> State:
        tags = state.tags.copy()
        tags[tag] = se2.apply(T_map_sensor, share * range_m * scale * np.array([0.6, 0.8]))
        return State(state.poses, tags, state.calibration)

    def check_blocks(share: float) -> None:
        expected, linearised = (
            numeric(factors.residual, problem, at(share)),
            factors.linearise(at(share), problem.columns),
        )
        most = np.maximum(np.abs(expected).max(axis=1, keepdims=True), 1.0)
        np.testing.assert_allclose(dense(linearised, problem.columns.n) / most, expected / most, atol=2e-6)
        np.testing.assert_allclose(linearised.residual, factors.residual(at(share)), rtol=1e-9)

    for share in (0.01, 0.5 * FADED_BELOW, FADED_BELOW - 0.01, FADED_BELOW + 0.01):
        check_blocks(share)
    for low, high in ((-1e-6, 1e-6), (FADED_BELOW - 1e-6, FADED_BELOW + 1e-6)):
        change = factors.whitening[0] @ np.array([range_m, 4.0 / FADED_BELOW]) * (high - low)
        assert np.abs(factors.residual(at(high)) - factors.residual(at(low))).max() < 2.0 * np.abs(change).max()


@pytest.mark.parametrize("seed", SEEDS)
def test_every_block_of_every_kind_is_felt(seed: int) -> None:
    """Otherwise the test above could pass on columns of zeros."""
    problem = make_problem(seed).problem
    state = random_state(seed + 100)
    felt = sum(
        np.abs(dense(getattr(problem, kind).linearise(state, problem.columns), problem.columns.n)).sum(axis=0)
        for kind in ("odometry", "observations")
    )
    assert (np.asarray(felt) > 0.0).all()


@pytest.mark.parametrize("seed", SEEDS)
def test_observations_put_their_tag_where_it_is(seed: int) -> None:
    made = make_problem(seed, noise=0.0)
    observations = made.problem.observations
    np.testing.assert_allclose(observations.places_in_map(made.truth), made.truth.tags[observations.tag], atol=1e-12)


def test_a_map_stretched_with_its_calibration_has_the_same_residuals() -> None:
    """Scale is a gauge that only priors hold: were residuals to shrink with the map, thousands of them would outvote
    the priors, and every map would come out too small."""
    problem = make_problem(0).problem
    straight, by_wheels = problem.odometry.motion * [1.0, 0.0, 0.0], np.zeros_like(problem.odometry.jacobian)
    by_wheels[:, 0, 0] = straight[:, 0]
    odometry = replace(problem.odometry, motion=straight, jacobian=by_wheels)
    at_base, no_mount = np.zeros_like(problem.observations.mount), np.zeros_like(problem.observations.mount_parameters)
    scaled = BATCHES[problem.observations.tag % 2]
    observations = replace(problem.observations, mount=at_base, mount_parameters=no_mount, scale_parameter=scaled)

    nominal = random_state(1)
    state = State(nominal.poses, nominal.tags, np.zeros(N_CALIBRATION))
    change = np.zeros(N_CALIBRATION)
    change[[WHEELS[0], *BATCHES]] = -0.1
    shrunk = State(0.9 ** np.array([1, 1, 0]) * state.poses, 0.9 * state.tags, change)
    np.testing.assert_allclose(odometry.residual(shrunk), odometry.residual(state), atol=1e-8)
    np.testing.assert_allclose(observations.residual(shrunk), observations.residual(state), atol=1e-8)


def test_the_prior_is_in_sigmas_and_holds_what_has_none() -> None:
    made = make_problem(0)
    state = State(made.truth.poses, made.truth.tags, 2.0 * CALIBRATION_SIGMA)
    np.testing.assert_allclose(made.problem.prior.residual(state)[:, 0], [0.0, *[2.0] * (N_CALIBRATION - 1)])


@pytest.mark.parametrize("n", range(1, 6))
def test_whitening_makes_unit_covariances(n: int) -> None:
    rng = np.random.default_rng(3)
    root = rng.standard_normal((20, n, n))
    covariance = root @ root.swapaxes(-1, -2)
    W = whitening(covariance)
    np.testing.assert_allclose(W @ covariance @ W.swapaxes(-1, -2), np.tile(np.eye(n), (20, 1, 1)), atol=1e-6)


def test_huber_is_square_then_linear() -> None:
    length = np.linspace(0.01, 20.0, 500)
    loss, _ = losses_and_weights(huber(3.0), length[:, None] * [0.6, -0.8])
    inside = length <= 3.0
    np.testing.assert_allclose(loss[inside], length[inside] ** 2)
    np.testing.assert_allclose(np.diff(loss[~inside]), 6.0 * np.diff(length[~inside]))


@pytest.mark.parametrize("loss", [SQUARES, huber(3.0)], ids=repr)
def test_weights_are_the_slopes_of_the_losses(loss: Loss) -> None:
    square = np.setdiff1d(np.geomspace(1e-4, 1e4, 300), [loss.threshold**2])
    h = 1e-6 * square

    def at(square: FloatArray) -> tuple[FloatArray, FloatArray]:
        return losses_and_weights(loss, np.sqrt(square)[:, None] * [0.6, -0.8])

    slope = (at(square + h)[0] - at(square - h)[0]) / (2 * h)
    np.testing.assert_allclose(at(square)[1], slope, rtol=1e-4)
    assert (np.diff(at(square)[0]) > 0.0).all()
    assert (at(square)[0] <= square * (1 + 1e-12)).all()
