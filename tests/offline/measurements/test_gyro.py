"""A gyro's yaw rate: integrated, fused with the wheels, and what both say of each other's calibration."""

import re
from dataclasses import replace

import numpy as np
import pytest

from groundsbot.calib.foundation.arrays import FloatArray, IntArray
from groundsbot.calib.geometry import se2
from groundsbot.calib.robot import Gyro, NoiseParameters, Robot
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.measurements.motion_model.gyro import GyroSamples, bias_nodes, gyro_samples
from groundsbot.offline.measurements.motion_model.heading_fusion import with_gyro
from groundsbot.offline.measurements.motion_model.heading_noise import GyroFit
from groundsbot.offline.measurements.motion_model.motion_model import SegmentOdometry, WheelSegment, compose_odometry
from tests.support.data.drives import make_robot

S = 1_000_000_000
TRACK_M = 0.5
RATE_HZ = 100.0
SIGMAS = np.array([0.005, 0.007, 0.01])


def samples_of(rate_rad_s: FloatArray, rng: np.random.Generator, bias: float = 0.0, scale: float = 0.0) -> GyroSamples:
    """What a gyro measures of yaw rates, with the white noise of the defaults."""
    stamps_ns = (np.arange(len(rate_rad_s)) / RATE_HZ * S).astype(np.int64)
    noise = Gyro().noise_rad_per_sqrt_s * RATE_HZ**0.5 * rng.standard_normal(len(rate_rad_s))
    return GyroSamples(stamps_ns, rate_rad_s / (1.0 + scale) + bias + noise)


def weaving(rng: np.random.Generator, seconds: int = 60) -> tuple[WheelSegment, FloatArray, IntArray]:
    """A drive that stands, weaves and turns on the spot, its true yaw rates, and stamps of keyframes."""
    t_s = np.arange(seconds * int(RATE_HZ)) / RATE_HZ
    wanted = np.where(t_s < 4.0, 0.0, 0.6 * np.sin(0.7 * t_s))
    speed = np.where((t_s < 4.0) | (t_s % 20.0 > 16.0), 0.0, 0.5)
    noise, dt = NoiseParameters(), 1.0 / RATE_HZ
    variance = noise.sigma_heading_rad_per_sqrt_m**2 * speed * dt
    variance += noise.sigma_heading_rad_per_sqrt_rad**2 * np.abs(wanted) * dt
    true_rate = wanted + np.sqrt(variance) * rng.standard_normal(len(t_s)) / dt
    half = 0.5 * TRACK_M * wanted
    stamps_ns = (t_s * S).astype(np.int64)
    left, right = np.cumsum((speed - half) * dt), np.cumsum((speed + half) * dt)
    return WheelSegment(stamps_ns, left, right), true_rate, stamps_ns[::10]


def fuse_drive(
    seed: int, track_scale: float = 0.0, sigmas: FloatArray = SIGMAS, bias: float = 0.02, scale: float = 0.01
) -> tuple[SegmentOdometry, SegmentOdometry, GyroFit, FloatArray]:
    """By the wheels, by both, the fit, and the true turns between keyframes."""
    rng = np.random.default_rng(seed)
    wheels, rate, keyframes_ns = weaving(rng)
    odometry = compose_odometry(wheels, keyframes_ns, TRACK_M * (1.0 + track_scale), NoiseParameters())
    samples = samples_of(rate, rng, bias, scale)
    fused = with_gyro(odometry, samples, keyframes_ns, Gyro(), sigmas, NoiseParameters(), "a")
    assert fused.fit is not None
    heading = np.interp(keyframes_ns, samples.stamps_ns, np.cumsum(rate) / RATE_HZ)
    return odometry, fused.odometry, fused.fit, np.diff(heading)


def likeliest(odometry: SegmentOdometry, sigmas: FloatArray) -> FloatArray:
    """The calibration (P,) by the differences and the priors alone."""
    differences, gyro = odometry.differences, Gyro()
    assert differences is not None
    n_nodes = len(differences.walk_rows) + 1
    prior = np.array([*sigmas, gyro.scale_sigma, gyro.time_offset_s_sigma, *[gyro.bias_rad_s_sigma] * n_nodes])
    rows = np.concatenate([differences.rows, differences.walk_rows, np.diag(1.0 / prior)])
    values = np.concatenate([differences.values, np.zeros(len(rows) - len(differences.values))])
    return np.asarray(-np.linalg.lstsq(rows, values, rcond=None)[0])


def test_turns_are_the_integral_of_the_rate_less_the_bias() -> None:
    stamps_ns = np.array([0, 1, 2, 4]) * S
    samples = GyroSamples(stamps_ns, np.array([0.0, 1.0, 1.0, 0.0]))
    turns = samples.turns(np.array([0, 1, 4]) * S, np.array([0, 4]) * S)
    np.testing.assert_allclose(turns.turn_rad, [0.5, 2.0])
    np.testing.assert_allclose(turns.jacobian[:, 0], turns.turn_rad)
    # A stamp that is late by dt sees the rate of before, the mean over 0.1 s: 0.0125, 0.9875 and 0.00625 rad/s.
    np.testing.assert_allclose(turns.jacobian[:, 1], [0.975, -0.98125])
    np.testing.assert_allclose(turns.jacobian[:, 2:].sum(axis=1), [-1.0, -3.0])  # a bias at all nodes
    np.testing.assert_allclose(turns.jacobian[0, 2:], [-0.875, -0.125])


def test_turns_across_a_gap_or_beyond_the_samples_are_not_known() -> None:
    at_s = np.concatenate([np.arange(0.0, 1.0, 0.01), np.arange(3.0, 4.0, 0.01)])
    samples = GyroSamples((at_s * S).astype(np.int64), np.zeros(len(at_s)))
    turns = samples.turns((np.array([-0.5, 0.2, 0.8, 1.5, 3.2, 3.8, 4.5]) * S).astype(np.int64), np.array([0, 4]) * S)
    assert turns.is_known.tolist() == [False, True, False, False, True, False]


def test_yaw_rates_are_means_without_the_bias_and_the_wheels_where_there_are_no_samples() -> None:
    """The bias is the median difference from the wheels, unless it is given."""
    at_s = np.concatenate([np.arange(0.0, 1.0, 0.01), np.arange(3.0, 4.0, 0.01)])
    disturbed = np.where(np.arange(len(at_s)) % 2 == 0, 0.3, -0.3)
    samples = GyroSamples((at_s * S).astype(np.int64), 0.5 + 0.02 + disturbed)
    stamps_ns, by_wheels = (np.array([0.3, 0.6, 2.0, 3.5]) * S).astype(np.int64), np.array([0.5, 0.4, 0.1, 0.5])
    np.testing.assert_allclose(samples.yaw_rates(stamps_ns, by_wheels), [0.5, 0.5, 0.1, 0.5], atol=1e-9)
    np.testing.assert_allclose(samples.yaw_rates(stamps_ns, by_wheels, 0.12), [0.4, 0.4, 0.1, 0.4], atol=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_headings_are_those_of_the_gyro_once_its_calibration_is_known(seed: int) -> None:
    wheels, both, _, true = fuse_drive(seed)
    c = likeliest(both, SIGMAS)
    assert c[3] == pytest.approx(0.01, abs=0.015)
    assert c[5] == pytest.approx(0.02, abs=5e-4)
    motion = se2.compose(both.motion, se2.exp(both.jacobian @ c))
    error, by_wheels = (np.abs(np.cumsum(each[:, 2] - true)).max() for each in (motion, wheels.motion))
    # The drive swings by 1.7 rad, and how much of that the gyro's scale makes is known to 1.5 % without tags.
    assert error < 3.0 * 0.015 * 1.7
    assert error < 0.5 * by_wheels
    assert np.linalg.eigvalsh(both.covariance).min() > 0.0
    assert (both.covariance[:, 2, 2] <= wheels.covariance[:, 2, 2] * (1.0 + 1e-9)).all()


def test_the_noise_of_the_wheels_is_found() -> None:
    heading = np.mean([fuse_drive(seed)[2].heading_sigmas for seed in range(4)], axis=0)
    assert heading[0] == pytest.approx(NoiseParameters().sigma_heading_rad_per_sqrt_m, rel=0.3)


def test_an_unknown_track_does_not_shrink_turns() -> None:
    """Scaling what both measured would scale their noise, down to a robot that does not turn."""
    wide = np.array([0.05, 0.02, 0.3])
    for seed in range(3):
        _, both, _, _ = fuse_drive(seed, track_scale=0.2, sigmas=wide)
        c = likeliest(both, wide)
        assert c[2] == pytest.approx(-1.0 / 6.0, abs=0.05)
        assert c[3] == pytest.approx(0.0, abs=0.025)


def test_slipping_wheels_get_less_weight() -> None:
    rng = np.random.default_rng(0)
    wheels, rate, keyframes_ns = weaving(rng)
    slipped = wheels.right_m.copy()
    slipped[3000:] += 0.1
    odometry = compose_odometry(replace(wheels, right_m=slipped), keyframes_ns, TRACK_M, NoiseParameters())
    fused = with_gyro(odometry, samples_of(rate, rng), keyframes_ns, Gyro(), SIGMAS, NoiseParameters(), "a")
    both, fit, _, _ = fused
    assert fit is not None
    (step,) = np.flatnonzero(fit.extra_variance > 0.05**2)
    assert keyframes_ns[step] <= wheels.stamps_ns[3000] <= keyframes_ns[step + 1]
    true = np.diff(np.interp(keyframes_ns, wheels.stamps_ns, np.cumsum(rate) / RATE_HZ))
    assert both.motion[step, 2] == pytest.approx(true[step], abs=0.01)
    (sentence,) = fused.warnings
    assert re.match(r"the wheels slipped in 1 motion: their turn differs by up to 1[12] degrees", sentence)
    assert fuse_drive(0)[2].slip_warnings == []


def test_headings_between_samples_are_as_uncertain_as_the_wheels_noise_makes_them() -> None:
    rng, fine_s, speed_m_s = np.random.default_rng(0), 2.5e-4, 0.5
    noise = NoiseParameters()
    step_rad = noise.sigma_heading_rad_per_sqrt_m * np.sqrt(speed_m_s * fine_s) * rng.standard_normal(240_000)
    heading_rad = np.append(0.0, np.cumsum(step_rad))
    samples = GyroSamples(np.arange(5, 60_000, 10) * S // 1000, np.diff(heading_rad[::40]) / 0.01)
    keyframes_ns = 250_000 * np.cumsum(rng.integers(240, 560, 500))
    along_m = np.asarray(speed_m_s * 0.01 * np.arange(6_000), dtype=np.float64)
    wheels = WheelSegment(np.arange(6_000) * (S // 100), along_m, along_m)
    odometry = compose_odometry(wheels, keyframes_ns, TRACK_M, noise)
    fused = with_gyro(odometry, samples, keyframes_ns, Gyro(), SIGMAS, noise, "a")
    turns = samples.turns(keyframes_ns, keyframes_ns[[0, -1]])
    error_rad = turns.turn_rad - np.diff(heading_rad[keyframes_ns // 250_000])
    # The error of a turn is the difference of those of two headings.
    assert error_rad.std() == pytest.approx(np.sqrt(2.0) * fused.heading_jitter_rad.mean(), rel=0.15)
    assert np.corrcoef(error_rad[1:], error_rad[:-1])[0, 1] == pytest.approx(-0.5, abs=0.1)


def test_headings_that_only_wheels_tell_have_no_jitter() -> None:
    rng = np.random.default_rng(0)
    wheels, rate, keyframes_ns = weaving(rng)
    samples = samples_of(rate, rng)
    kept = (samples.stamps_ns < 20 * S) | (samples.stamps_ns > 30 * S)
    samples = GyroSamples(samples.stamps_ns[kept], samples.yaw_rate_rad_s[kept])
    odometry = compose_odometry(wheels, keyframes_ns, TRACK_M, NoiseParameters())
    jitter_rad = with_gyro(odometry, samples, keyframes_ns, Gyro(), SIGMAS, NoiseParameters(), "a").heading_jitter_rad
    in_gap = (keyframes_ns > 20.2 * S) & (keyframes_ns < 29.8 * S)
    moving = (keyframes_ns > 5 * S) & (keyframes_ns < 15 * S)
    assert (jitter_rad[in_gap | (keyframes_ns < 3 * S)] == 0.0).all()
    assert (jitter_rad[moving] > 1e-4).all()


@pytest.mark.parametrize("times", [-1.0, 57.3, 0.1])
def test_a_gyro_of_another_sign_axis_or_unit_is_left_out(times: float) -> None:
    rng = np.random.default_rng(0)
    wheels, rate, keyframes_ns = weaving(rng)
    odometry = compose_odometry(wheels, keyframes_ns, TRACK_M, NoiseParameters())
    samples = samples_of(times * rate, rng, bias=0.02)
    found = with_gyro(odometry, samples, keyframes_ns, Gyro(), SIGMAS, NoiseParameters(), "a")
    assert found.odometry is odometry
    assert found.fit is None
    assert re.match(
        r"the gyro turns -?[\d.]+ times as far as the wheels, so it is not used; check the axis, sign and unit",
        found.warnings[0],
    )


def test_a_track_half_as_wide_as_it_acts_does_not_reject_the_gyro() -> None:
    assert fuse_drive(0, track_scale=-0.45, sigmas=np.array([0.05, 0.02, 0.3]))[2].gyro.noise_rad_per_sqrt_s > 0.0


def test_a_frozen_gyro_is_left_out_while_it_is() -> None:
    rng = np.random.default_rng(0)
    rates = 0.1 * rng.standard_normal(600)
    rates[200:400] = 0.3
    readings = [(i * S // 100, float(rate)) for i, rate in enumerate(rates)]
    samples, warnings = gyro_samples(readings, make_robot("a"), "log: /gyro")
    assert samples is not None
    assert len(samples.stamps_ns) == 400
    assert warnings == ["200 gyro readings of one value for a second or longer; left out"]


def test_parts_keep_the_differences_of_their_motions() -> None:
    _, both, _, _ = fuse_drive(0)
    part = both.part(10, 20)
    assert part.differences is not None
    assert both.differences is not None
    assert part.differences.step.tolist() == list(range(10))
    np.testing.assert_array_equal(part.differences.rows, both.differences.rows[10:20])


def test_nodes_of_the_bias_are_closer_with_a_larger_random_walk() -> None:
    gyro = Gyro()
    restless = gyro.model_copy(update={"bias_walk_rad_s_per_sqrt_s": 30.0 * gyro.bias_walk_rad_s_per_sqrt_s})
    assert len(bias_nodes(0, 240 * S, gyro)) == 2
    assert len(bias_nodes(0, 240 * S, restless)) == 17


def test_a_file_corrects_scale_and_stamps() -> None:
    robot = make_robot("a").model_copy(update={"gyro": Gyro(scale=0.1, time_offset_s=0.5)})
    samples, warnings = gyro_samples([(i * S, 1.0 + i) for i in range(1, 20)], robot, "log: /gyro")
    assert samples is not None
    assert warnings == []
    assert samples.stamps_ns[0] == S // 2
    np.testing.assert_allclose(samples.yaw_rate_rad_s, 1.1 * (1.0 + np.arange(1, 20)))


@pytest.mark.parametrize("rate", [60.0, float("nan"), float("inf")])
def test_rates_that_no_robot_turns_at_are_refused(rate: float) -> None:
    readings = [(i * S, rate if i == 5 else 0.1 * i) for i in range(20)]
    with pytest.raises(OfflineError, match=r"/gyro: yaw_rate_rad_s is .* in reading 6, must be a number below 50"):
        gyro_samples(readings, make_robot("a"), "log: /gyro")


def test_too_few_readings_and_readings_out_of_order_are_reported() -> None:
    robot: Robot = make_robot("a")
    assert gyro_samples([], robot, "log: /gyro") == (None, [])
    samples, warnings = gyro_samples([(i * S, 0.1 * i) for i in range(3)], robot, "log: /gyro")
    assert samples is None
    assert "3 readings, too few" in warnings[0]
    samples, warnings = gyro_samples([(i * S, 0.1 * i) for i in [*range(20), 4, 5]], robot, "log: /gyro")
    assert samples is not None
    assert warnings == ["2 gyro readings not later than the one before; left out"]
