"""Noise and calibration go up the marginal likelihood, whose derivatives are those of cost + 1/2 ln det H."""

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


def by_log_scale(problem: JointProblem, values: Variables, name: tuple[str, str]) -> tuple[float, float]:
    """Derivatives of the cost, and of the logarithm of the volume, by the logarithm of a scale."""
    scales, ends = scales_of(problem), []
    for sign in (1.0, -1.0):
        set_scales(problem, scales | {name: scales[name] * np.exp(sign * STEP)})
        ends.append((problem.system(values, is_whole=False)[1], log_volume(problem, values)))
    set_scales(problem, scales)
    return tuple((ahead - behind) / (2.0 * STEP) for ahead, behind in zip(*ends, strict=True))


def assert_steps_are_the_ratio(problem: JointProblem, values: Variables, tolerance: float) -> None:
    """Each variance is multiplied by the squares found over those expected, a few of the default scale with both."""
    before = scales_of(problem)
    defaults = [Noise(1.2 * each.motion, {k: 0.9 * v for k, v in each.reading.items()}) for each in problem.noises]
    factor = problem.order.factorise(problem.system(values)[0])
    step = likelihood.update(problem, values, factor, defaults)
    before_them = {("", "drive"): PlaceScales.of_drive_m, ("", "pass"): PlaceScales.of_pass_m}
    for (robot, name), value in before.items():
        in_motion = name in ODOMETRY_NOISE
        default = before_them.get((robot, name), (1.2 if in_motion else 0.9) * value)
        of_cost, of_volume = by_log_scale(problem, values, (robot, name))
        ratio = (PRIOR * (default / value) ** 2 - of_cost) / (PRIOR + of_volume)
        if robot:
            d = ROBOTS.index(robot)
            noise = step.noises[d]
            new = noise.motion[ODOMETRY_NOISE.index(name)] if in_motion else noise.reading[name]
            assert step.counts[d][name] == pytest.approx(of_volume, rel=tolerance, abs=1e-3), name
        else:
            new = step.places.of_drive_m if name == "drive" else step.places.of_pass_m
        assert (new / value) ** 2 == pytest.approx(np.clip(ratio, 0.25, 4.0), rel=tolerance), (robot, name)
    assert not any(np.may_share_memory(a.motion, b.motion) for a, b in zip(step.noises, problem.noises, strict=True))


@pytest.mark.usefixtures("normal")
def test_a_step_of_the_noise_is_the_ratio_of_the_derivatives_of_cost_and_volume() -> None:
    """With normal errors, where weights do not depend on the noise."""
    problem, values = make_problem()
    wide = {name: (5.0 if name[1] in ODOMETRY_NOISE else 3.0) * value for name, value in scales_of(problem).items()}
    set_scales(problem, wide)
    assert_steps_are_the_ratio(problem, values, 1e-4)


def test_weights_count_in_what_is_expected() -> None:
    """With tails, where all residuals are zero: the weights there do not depend on the noise either."""
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
    assert_steps_are_the_ratio(problem, values, 1e-4)


def test_squares_count_by_their_weights() -> None:
    """With tails, a step of a variance is that of the cost by it, over as many residuals as are said to be behind."""
    problem, values = make_problem()
    before = scales_of(problem)
    factor = problem.order.factorise(problem.system(values)[0])
    step = likelihood.update(problem, values, factor, problem.noises)
    after = dict(before)
    for robot, noise in zip(ROBOTS, step.noises, strict=True):
        after |= {(robot, name): value for name, value in zip(ODOMETRY_NOISE, noise.motion.tolist(), strict=True)}
        after |= {(robot, name): value for name, value in noise.reading.items()}
    n_free = 0
    for (robot, name), value in before.items():
        if not robot:
            continue
        of_cost, _ = by_log_scale(problem, values, (robot, name))
        count = step.counts[ROBOTS.index(robot)][name]
        ratio = (PRIOR - of_cost) / (PRIOR + max(count, 0.0))
        n_free += 0.25 < ratio < 4.0
        assert (after[robot, name] / value) ** 2 == pytest.approx(np.clip(ratio, 0.25, 4.0), rel=1e-4), (robot, name)
    assert n_free > 3


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
