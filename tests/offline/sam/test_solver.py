"""The solve: the same optimum as plain dense algebra, from any start nearby, with consistent covariances and scale."""

from dataclasses import replace

import numpy as np
import pytest

from groundsbot.calib.geometry import se2, wheels
from groundsbot.calib.geometry.se2 import chain_motions
from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.calib.robot.parameters import CAMERA_PARAMETERS
from groundsbot.offline.local_map.local_map import LocalMap, solve_local_map
from groundsbot.offline.measurements.motion_model.motion_model import WheelSegment
from groundsbot.offline.measurements.segment import segments_of
from groundsbot.offline.measurements.tags import TagKey
from groundsbot.offline.sam.factors.odometry_and_observations import CalibrationPrior, OdometryFactors, State
from groundsbot.offline.sam.graph import columns_of
from groundsbot.offline.sam.linearisation.robust_losses import huber, losses_and_weights
from groundsbot.offline.sam.solver import DEFAULT_LOSSES, PLAIN_SQUARES, Losses, Problem, solve
from tests.support.data.drives import FAMILY, START_NS, make_positions, make_robot, make_run
from tests.support.data.factors import observations_of, odometry_of
from tests.support.data.problems import CALIBRATION_SIGMA, N_CALIBRATION, N_TAGS, SEGMENTS, make_problem, random_state

SEEDS = range(3)
ODOMETRY_FIELDS = tuple(OdometryFactors.__dataclass_fields__)


def distance(problem: Problem, a: State, b: State) -> float:
    """Between two states in sigmas, roughly: the largest change of any pose, tag or calibration number."""
    poses = se2.log(se2.between(a.poses, b.poses))
    return float(max(np.abs(poses).max(), np.abs(a.tags - b.tags).max(), np.abs(a.calibration - b.calibration).max()))


@pytest.mark.parametrize("seed", range(5))
def test_steps_do_not_creep_where_many_observations_lie_beyond_the_threshold(seed: int) -> None:
    made = make_problem(seed)
    whitening = (
        5.0 * made.problem.observations.whitening
    )  # sigmas given too small: most observations lie beyond 3 of them
    problem = made.problem.reweigh(made.problem.odometry.whitening, whitening)
    solution = solve(problem, made.truth)
    weights = losses_and_weights(solution.losses.observations, problem.observations.residual(solution.state))[1]
    assert (weights < 1.0).mean() > 0.3
    assert solution.converged
    assert len(solution.costs) < 20


@pytest.mark.parametrize("seed", SEEDS)
def test_every_start_nearby_leads_to_the_same_optimum(seed: int) -> None:
    made = make_problem(seed, n_outliers=2)
    reference = solve(made.problem, made.truth)
    for start_seed in range(5):
        start = random_state(start_seed, made.truth, spread=0.15)
        solution = solve(made.problem, start)
        assert solution.converged
        assert solution.cost == pytest.approx(reference.cost, abs=1e-8)
        assert distance(made.problem, solution.state, reference.state) < 1e-4


def test_a_kept_factorisation_is_that_of_the_solution_even_after_another_solve() -> None:
    made = make_problem(0)
    columns = made.problem.columns.tags.reshape(-1)
    kept = solve(made.problem, made.truth, keep_factorisation=True)
    assert "_factorisation_and_floor" in vars(kept)
    solve(made.problem, random_state(1, made.truth, spread=0.15), most_steps=1)
    found = kept.covariance(columns)
    other = solve(made.problem, made.truth)
    assert "_factorisation_and_floor" not in vars(other)
    assert kept.floor == other.floor
    np.testing.assert_array_equal(found, other.covariance(columns))


def test_errors_are_as_large_as_the_covariance_says() -> None:
    """Chi-square over 60 problems: measurements with Gaussian noise, so nothing but the solve can spoil it."""
    total, n = 0.0, 0
    for seed in range(60):
        made = make_problem(seed)
        solution = solve(made.problem, made.truth)
        columns = made.problem.columns
        error = (solution.state.tags - made.truth.tags).reshape(-1)
        covariance = solution.covariance(columns.tags.reshape(-1))
        total += float(error @ np.linalg.solve(covariance, error))
        n += len(error)
    # 720 dimensions: the standard deviation of the mean is 0.053.
    assert total / n == pytest.approx(1.0, abs=0.2)


@pytest.mark.parametrize("seed", SEEDS)
def test_exact_measurements_lead_to_the_truth(seed: int) -> None:
    made = make_problem(seed, noise=0.0, true_calibration=True)
    solution = solve(made.problem, random_state(seed, made.truth, spread=0.1))
    assert solution.cost < 1e-12
    assert distance(made.problem, solution.state, made.truth) < 1e-7


@pytest.mark.parametrize("losses", [DEFAULT_LOSSES, PLAIN_SQUARES, Losses(huber(3.0), huber(3.0))], ids=str)
@pytest.mark.parametrize("seed", SEEDS)
def test_an_optimum_is_left_alone(seed: int, losses: Losses) -> None:
    """One linearisation, no step: by the linear model there is nothing left to win."""
    made = make_problem(seed, n_outliers=4)
    found = solve(made.problem, made.truth, losses=losses)
    assert found.converged
    again = solve(made.problem, found.state, losses=losses)
    assert (again.reason, again.converged, again.costs, again.n_linearised) == ("converged", True, (found.cost,), 1)
    np.testing.assert_array_equal(again.state.poses, found.state.poses)


def test_what_is_no_number_ends_the_solve_with_a_reason() -> None:
    made = make_problem(0)
    value = made.problem.observations.value.copy()
    value[3] = np.nan
    spoilt = replace(made.problem, observations=replace(made.problem.observations, value=value))
    found = solve(spoilt, made.truth)
    assert not found.converged
    assert found.reason == "the cost is not a number at the start"


@pytest.mark.parametrize("seed", SEEDS)
def test_neither_order_of_segments_nor_of_tags_matters(seed: int) -> None:
    """The same factors and the same held pose, everything numbered anew."""
    made = make_problem(seed, n_outliers=2)
    problem, truth = made.problem, made.truth
    rng = np.random.default_rng(seed)
    n_first, n_poses = SEGMENTS[0], sum(SEGMENTS)
    new_pose = np.concatenate([np.arange(n_first) + n_poses - n_first, np.arange(n_poses - n_first)])
    new_tag = rng.permutation(N_TAGS)
    old_pose, old_tag = np.argsort(new_pose), np.argsort(new_tag)
    order = np.argsort(new_pose[problem.odometry.first])
    odometry = OdometryFactors(**{name: getattr(problem.odometry, name)[order] for name in ODOMETRY_FIELDS})
    observations = problem.observations
    mixed = Problem(
        replace(odometry, first=new_pose[odometry.first]),
        replace(observations, pose=new_pose[observations.pose], tag=new_tag[observations.tag]),
        problem.prior,
        replace(problem.columns, poses=problem.columns.poses[old_pose], tags=problem.columns.tags[old_tag]),
        new_pose[problem.anchor[old_tag]],
    )
    start = random_state(seed, truth, spread=0.1)
    one = solve(problem, start)
    other = solve(mixed, State(start.poses[old_pose], start.tags[old_tag], start.calibration))
    assert one.converged
    assert other.converged
    back = State(other.state.poses[new_pose], other.state.tags[new_tag], other.state.calibration)
    assert distance(problem, one.state, back) < 1e-6


# An eight past twelve tags, true to its calibration. Observations are so sharp that they show the wheels' noise: what
# is seen of it is what a shrunken map would make smaller.
OBSERVATION_SIGMA_M = 0.003
TAGS_M = np.array([[x, y] for x in (-1.5, 1.5, 4.5) for y in (-3.5, -1.0, 1.0, 3.5)])


def noisy_local_map(seed: int, n_steps: int = 400, step_m: float = 0.05) -> LocalMap:
    """Wheels and observations with exactly the noise that the estimator believes in, calibration exactly as it says."""
    rng = np.random.default_rng(seed)
    noise = NoiseParameters()
    turn_rad = 2.0 * np.pi / 200 * np.where(np.arange(n_steps) % 400 < 200, 1.0, -1.0)
    left_m, right_m = step_m - 0.25 * turn_rad, step_m + 0.25 * turn_rad
    heading_variance = noise.sigma_heading_rad_per_sqrt_m**2 * step_m
    heading_variance += noise.sigma_heading_rad_per_sqrt_rad**2 * abs(turn_rad[0])
    root_m = np.sqrt(step_m)
    sigma = [noise.sigma_distance_m_per_sqrt_m * root_m, noise.sigma_lateral_m_per_sqrt_m * root_m]
    disturbance = se2.exp(np.array([*sigma, np.sqrt(heading_variance)]) * rng.standard_normal((n_steps, 3)))
    true = chain_motions(se2.compose(wheels.advance(left_m, right_m, 0.5), disturbance), np.zeros(3))
    stamps_ns = START_NS + 50_000_000 * np.arange(n_steps + 1, dtype=np.int64)
    counted_left_m, counted_right_m = (np.concatenate([[0.0], np.cumsum(each)]) for each in (left_m, right_m))
    track = WheelSegment(stamps_ns, counted_left_m, counted_right_m)
    pose, tag = (index.reshape(-1) for index in np.mgrid[0 : n_steps + 1, 0 : len(TAGS_M)])
    place = se2.apply(se2.inverse(true[pose]), TAGS_M[tag])
    near = np.linalg.norm(place, axis=1) < 4.0
    read = place[near] + OBSERVATION_SIGMA_M * rng.standard_normal((int(near.sum()), 2))
    keys = [TagKey(FAMILY, i) for i in range(len(TAGS_M))]
    run = make_run(
        [track],
        robot=make_robot(),
        tags=keys,
        positions=make_positions(stamps_ns[pose[near]], tag[near], read, OBSERVATION_SIGMA_M),
    )
    (segment,) = segments_of(run, noise)
    return solve_local_map(segment)


def test_true_calibration_is_found_without_bias() -> None:
    """Were residuals to shrink with the map, wheels and tags would come out several of their sigmas too small."""
    estimates = [{p.name: v for p, v in noisy_local_map(seed).calibration.items()} for seed in range(20)]
    for name in ("wheel_scale", "tag_scale"):
        values = np.array([estimate[name] for estimate in estimates])
        standard_error = values.std(ddof=1) / np.sqrt(len(values))
        assert abs(values.mean()) < 3.0 * standard_error, name


@pytest.mark.parametrize("seed", range(8))
def test_a_tag_that_is_placed_at_the_sensor_does_not_stop_the_solve(seed: int) -> None:
    """Wheels that turn the robot while it stands, as where it is stuck, place the tag in all directions around it.

    The mean is near the sensor, where bearings change by radians within micrometres.
    """
    rng, n = np.random.default_rng(seed), 8
    truth = State(np.zeros((n, 3)), np.array([[2.0, 0.0]]), np.zeros(N_CALIBRATION))
    zero = np.zeros(n, dtype=np.int64)
    parameters = np.tile(zero[:, None], (1, 3)), zero, np.tile(zero[:, None], (1, len(CAMERA_PARAMETERS)))
    polar, mounted = np.ones(n, dtype=np.bool_), np.zeros(n, dtype=np.bool_)
    odometry = odometry_of(truth, np.arange(n - 1), np.zeros((n - 1, 3), dtype=np.int64), rng, by_wheels=0.0)
    observations = observations_of(truth, np.arange(n), zero, polar, mounted, parameters, lambda value: None, rng)
    motion = np.column_stack([rng.uniform(0.0, 0.02, n - 1), np.zeros(n - 1), rng.uniform(-3.0, 3.0, n - 1)])
    problem = Problem(
        odometry=replace(odometry, motion=motion, whitening=np.tile(np.diag([100.0, 100.0, 1000.0]), (n - 1, 1, 1))),
        observations=replace(observations, whitening=np.tile(np.diag([1.0 / 0.35, 50.0]), (n, 1, 1))),
        prior=CalibrationPrior(CALIBRATION_SIGMA),
        columns=columns_of(n, 1, np.zeros(N_CALIBRATION, dtype=np.bool_)),
        anchor=np.array([0]),
    )
    start = State(chain_motions(motion, np.zeros(3)), np.zeros((1, 2)), truth.calibration)
    mean_m = problem.observations.places_in_map(start).mean(axis=0, keepdims=True)
    solution = solve(problem, replace(start, tags=mean_m))
    assert solution.converged
    assert solution.n_linearised < 150
