"""Noise and calibration go up the marginal likelihood, whose derivatives are those of cost + 1/2 ln det H."""

import itertools

import numpy as np
import pytest

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.robot.parameters import MOUNT_PARAMETERS, TIME_OFFSET
from groundsbot.offline.estimate import likelihood
from groundsbot.offline.estimate import problem as problem_file
from groundsbot.offline.estimate.kernels import Variables, errors_of_readings
from groundsbot.offline.estimate.parameters import Owned
from groundsbot.offline.estimate.problem import JointProblem, Noise, PlaceScales
from groundsbot.offline.measurements.motion_model.motion_model import ODOMETRY_NOISE
from groundsbot.offline.sam.multifrontal.fronts import FrontFactor
from tests.offline.estimate.made_problems import make_problem, spread_information

PRIOR = likelihood._PRIOR_RESIDUALS
STEP = 1e-4
ROBOTS = ("a", "b", "a")  # of the drives


@pytest.fixture
def normal(monkeypatch: pytest.MonkeyPatch) -> None:
    """Tails so thin that weights are one wherever residuals are."""
    for file in (problem_file, likelihood):
        monkeypatch.setattr(file, "NU", 1e9)
        monkeypatch.setattr(file, "NU_PLACES", 1e9)


def scales_of(problem: JointProblem) -> dict[tuple[str, str], float]:
    """Every scale, by robot and name; those of places by what they are of."""
    found = {("", "drive"): problem.places.of_drive_m, ("", "pass"): problem.places.of_pass_m}
    for robot, noise in zip(ROBOTS, problem.noises, strict=True):
        found |= {(robot, name): value for name, value in zip(ODOMETRY_NOISE, noise.motion.tolist(), strict=True)}
        found |= {(robot, name): value for name, value in noise.reading.items()}
    return found


def set_scales(problem: JointProblem, scales: dict[tuple[str, str], float]) -> None:
    noises = [
        Noise(
            np.array([scales[robot, name] for name in ODOMETRY_NOISE]),
            {name: scales[robot, name] for name in noise.reading},
        )
        for robot, noise in zip(ROBOTS, problem.noises, strict=True)
    ]
    problem.set_noise(noises, PlaceScales(scales["", "drive"], scales["", "pass"]))


def log_volume(problem: JointProblem, values: Variables) -> float:
    """Sum ln s + 1/2 ln det H."""
    system, _ = problem.system(values)
    log_scales = np.log(problem.motions.sigma).sum() - np.log(np.linalg.det(problem.readings.whitening)).sum()
    log_scales += 2.0 * len(problem.layout.tie) * np.log(problem.places.of_drive_m)
    log_scales += 2.0 * len(problem.layout.of_pass) * np.log(problem.places.of_pass_m)
    return float(log_scales) + 0.5 * problem.order.factorise(system).log_determinant()


def derivatives(
    problem: JointProblem, values: Variables
) -> tuple[likelihood._Score, dict[tuple[str, str], int], FrontFactor]:
    """Those by all scales, with each scale's index, and the factor there."""
    factor = problem.order.factorise(problem.system(values)[0])
    scales = likelihood._Scales(problem, problem.noises)
    score, _ = likelihood._derivatives(problem, values, factor, scales)
    names = [("a", name) for name in (*ODOMETRY_NOISE, *scales.robots[0].names)]
    names += [("b", name) for name in (*ODOMETRY_NOISE, *scales.robots[1].names)]
    index = {name: i for i, name in enumerate([*names, ("", "drive"), ("", "pass")])}
    present = scales_of(problem)
    assert scales.present == pytest.approx([present[name] for name in index])
    return score, index, factor


def cost_at(problem: JointProblem, values: Variables, logarithms: dict[tuple[str, str], float]) -> float:
    """Cost with some scales changed."""
    scales = scales_of(problem)
    set_scales(problem, scales | {name: scales[name] * np.exp(by) for name, by in logarithms.items()})
    cost = problem.system(values, is_whole=False)[1]
    set_scales(problem, scales)
    return cost


def by_log_scale(problem: JointProblem, values: Variables, name: tuple[str, str]) -> tuple[float, float, FloatArray]:
    """Derivatives of the cost, of the logarithm of the volume, and of the gradient, by the logarithm of a scale."""
    scales, costs, volumes, gradients = scales_of(problem), [], [], []
    for sign in (1.0, -1.0):
        set_scales(problem, scales | {name: scales[name] * np.exp(sign * STEP)})
        system, cost = problem.system(values, is_whole=False)
        costs.append(cost)
        volumes.append(log_volume(problem, values))
        gradients.append(system.gradient.copy())
    set_scales(problem, scales)
    of_cost, of_volume = ((ends[0] - ends[1]) / (2.0 * STEP) for ends in (costs, volumes))
    return of_cost, of_volume, (gradients[0] - gradients[1]) / (2.0 * STEP)


@pytest.fixture
def wide() -> tuple[JointProblem, Variables]:
    """A problem whose noise is too wide."""
    problem, values = make_problem()
    set_scales(
        problem,
        {name: (5.0 if name[1] in ODOMETRY_NOISE else 3.0) * value for name, value in scales_of(problem).items()},
    )
    return problem, values


@pytest.mark.usefixtures("normal")
def test_squares_found_and_expected_are_the_derivatives_of_cost_and_volume(
    wide: tuple[JointProblem, Variables],
) -> None:
    """With normal errors, where weights do not depend on the noise."""
    score, index, _ = derivatives(*wide)
    for name, i in index.items():
        of_cost, of_volume, of_gradient = by_log_scale(*wide, name)
        assert score.found[i] == pytest.approx(-of_cost, rel=1e-4, abs=1e-6), name
        assert score.expected[i] == pytest.approx(of_volume, rel=1e-4, abs=1e-3), name
        np.testing.assert_allclose(-2.0 * score.pulls[i], of_gradient, atol=1e-4 * np.abs(of_gradient).max())


@pytest.mark.usefixtures("normal")
def test_the_information_is_the_curvature_of_the_cost(wide: tuple[JointProblem, Variables]) -> None:
    """By the logarithms of two variances, at fixed variables, beyond that of the logarithms themselves."""
    score, index, _ = derivatives(*wide)
    step = 0.01
    for (one, i), (other, j) in itertools.combinations_with_replacement(index.items(), 2):
        ends = 0.0
        for a, b in itertools.product((1.0, -1.0), repeat=2):
            changes = {one: 0.5 * a * step}
            changes[other] = changes.get(other, 0.0) + 0.5 * b * step
            ends += a * b * cost_at(*wide, changes)
        curvature = ends / (4.0 * step**2)
        expected = 0.5 * (curvature + (0.5 * score.found[i] if i == j else 0.0))
        assert score.information[i, j] == pytest.approx(expected, rel=1e-2, abs=1e-2), (one, other)
        assert score.information[j, i] == pytest.approx(score.information[i, j], rel=1e-9)


def test_weights_count_in_what_is_expected() -> None:
    """With tails, where all residuals are zero: the weights there do not depend on the noise."""
    problem, values = make_problem()
    for begin, end in zip(problem.layout.first_pose[:-1], problem.layout.first_pose[1:], strict=True):
        problem.reckon(values, int(begin), int(end))
    n_own, layout = len(problem.layout.own), problem.layout
    for own, joint in layout.tie:
        values.points[own] = values.points[joint]
    values.points[layout.n_places :] = values.points[layout.of_pass]
    assert n_own < layout.n_places
    e, _ = errors_of_readings(problem.readings, values, 4.0)
    off = np.linalg.solve(problem.readings.whitening, e[:, :, None])[:, :, 0]
    problem.readings = problem.readings._replace(value=problem.readings.value + off)
    score, index, _ = derivatives(problem, values)
    for name, i in index.items():
        assert score.expected[i] == pytest.approx(by_log_scale(problem, values, name)[1], rel=1e-4, abs=1e-3), name
        assert score.found[i] == pytest.approx(0.0, abs=1e-9)


def test_squares_count_by_their_weights() -> None:
    """With tails, the squares found are the derivatives of the cost all the same."""
    problem, values = make_problem()
    score, index, _ = derivatives(problem, values)
    for name, i in index.items():
        assert score.found[i] == pytest.approx(-by_log_scale(problem, values, name)[0], rel=1e-4, abs=1e-6), name


def test_a_step_goes_where_the_derivatives_of_the_likelihood_vanish() -> None:
    """By Newton's method, with the information that the variables leave; the default is worth some residuals."""
    problem, values = make_problem()
    values = problem.minimise(values).values
    score, _, factor = derivatives(problem, values)
    defaults = [Noise(1.2 * each.motion, {k: 0.9 * v for k, v in each.reading.items()}) for each in problem.noises]
    scales = likelihood._Scales(problem, defaults)
    changed, length = score.step(scales, factor)
    prior = PRIOR * (scales.default / scales.present) ** 2
    gradient = 0.5 * (score.found - score.expected + prior - PRIOR)
    left = score.information + 0.5 * np.diag(np.maximum(prior, PRIOR))
    left -= 0.5 * np.array([[a @ factor.solve(b) for a in score.pulls] for b in score.pulls])
    step = np.linalg.solve(left, gradient)
    np.testing.assert_allclose(2.0 * np.log(changed / scales.present), np.clip(step, -1.4, 1.4), rtol=1e-6, atol=1e-9)
    assert length == pytest.approx(np.sqrt(gradient @ step / len(step)))
    assert (np.abs(step) < 1.4).sum() > 3
    new = likelihood.update(problem, values, factor, defaults)
    np.testing.assert_array_equal([each.motion[0] for each in new.noises], changed[[0, scales.robots[1].first, 0]])
    assert new.places == PlaceScales(*changed[-2:].tolist())
    assert new.counts[2]["sigma_range_m"] == pytest.approx(
        score.expected[4 + scales.robots[0].names.index("sigma_range_m")]
    )


def test_drives_of_a_robot_share_scales_even_if_only_one_gives_covariances() -> None:
    problem, _ = make_problem()
    problem.noises[2].reading["given"] = 1.5
    names, units = problem.reading_units[2]
    problem.reading_units[2] = ((*names, "given"), np.concatenate([units, units[:1]]))
    scales = likelihood._Scales(problem, problem.noises)
    assert "given" in scales.robots[0].names
    readings, reading_units = scales.units(scales.robots[0])[2:]
    given = reading_units[scales.robots[0].names.index("given")]
    is_first = readings < len(problem.drives[0].segment.observations)
    assert not given[is_first].any()
    assert given[~is_first].any()
    noises = scales.noises(scales.present, scales.present)[0]
    assert noises[0].reading == noises[2].reading


def gradient_of_volume(problem: JointProblem, values: Variables) -> FloatArray:
    """(n,) of 1/2 ln det H by differences, with H by the variables as they were before a step stretches some.

    The part of the prior on the places' spread is held.
    """
    columns, spread = spread_information(problem, values)
    n, found = problem.columns[3], []
    places = [
        (at[k], distance)
        for at, of in (
            (problem.columns[0][:, :2], problem.distance_of_poses),
            (problem.columns[1], problem.distance_of_points),
        )
        for k, distance in enumerate(zip(*problem.scale_columns(of), strict=True))
    ]
    for i in range(n):
        stretched = np.zeros(n + 1, dtype=np.bool_)  # the last one is held
        for at, by in places:
            stretched[at] |= i in by
        is_stretched, ends = stretched[:n], []
        for h in (STEP, -STEP):
            there = problem.move(values, h * np.eye(n)[i])
            system, _ = problem.system(there)
            by_square = np.exp(np.where(is_stretched[columns], -2.0 * h, 0.0))
            _, present = spread_information(problem, there)
            system.entries[problem.order.diagonal[columns]] += spread * by_square - present
            ends.append(0.5 * problem.order.factorise(system).log_determinant() + h * is_stretched.sum())
        found.append((ends[0] - ends[1]) / (2.0 * STEP))
    return np.array(found)


@pytest.mark.usefixtures("normal")
def test_the_tilt_is_the_gradient_of_the_volume_along_calibrations_at_their_own_best_places() -> None:
    problem, values = make_problem(seconds=4.0)
    factor = problem.order.factorise(problem.system(values)[0])
    tilt = likelihood.update(problem, values, factor, problem.noises).tilt
    gradient = gradient_of_volume(problem, values) + problem.measure
    columns = problem.columns[2][1:]
    covariance = factor.covariance(columns)
    expected = np.linalg.solve(covariance, factor.solve(gradient)[columns])
    sigma = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(sigma * tilt[columns], sigma * expected, rtol=1e-3, atol=1e-4)
    assert not np.delete(tilt, columns).any()


def test_a_larger_map_of_longer_distances_and_ranges_costs_only_what_priors_say() -> None:
    """Along the stretch of all, with ranges as much shorter in the map's metres, as in the marginal likelihood."""
    problem, values = make_problem(without=(*MOUNT_PARAMETERS[:2], TIME_OFFSET))  # metres that do not grow
    calibration, columns = problem.calibration, problem.columns[2]
    along = np.zeros(problem.columns[3])
    along[columns[problem.map_scale]] = 1.0
    along[[columns[calibration.index(Owned(robot, "range_scale"))] for robot in "ab"]] = -1.0
    system, _ = problem.system(values)
    gradient = system.gradient.copy()
    factor = problem.order.factorise(system)
    slope = likelihood.update(problem, values, factor, problem.noises).tilt

    def of_priors(share: float) -> float:
        c = problem.move(values, share * along).calibration
        e = [
            (sum(k * c[calibration.index(name)] for name, k in each.terms) - each.mean) / each.sigma
            for each in calibration.priors
        ]
        return 2.5 * float(np.log1p(np.square(e) / 4.0).sum())

    expected = (of_priors(STEP) - of_priors(-STEP)) / (2.0 * STEP)
    assert abs(expected) > 1.0
    assert gradient @ along + slope @ along == pytest.approx(expected, abs=1e-3)
