"""Robots that also move sideways: mecanum, swerve and omni drives."""

from dataclasses import replace

import numpy as np
import pytest

from groundsbot.calib.foundation.arrays import FloatArray, IntArray
from groundsbot.calib.geometry import se2
from groundsbot.calib.geometry.se2 import chain_motions
from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.offline.measurements.motion_model.motion_model import WheelSegment, compose_odometry
from groundsbot.offline.measurements.motion_model.wheel_segments import wheel_distances
from tests.support.data.drives import START_NS, S

TRACK_M = 0.5
NOISE = NoiseParameters()
SCALE, RATIO, TRACK = range(3)


def twists(seed: int = 0, n: int = 40) -> FloatArray:
    """(n, 3) from observation to observation: forward, to the left, turn."""
    return np.random.default_rng(seed).normal([0.05, 0.02, 0.01], [0.02, 0.03, 0.05], (n, 3))


def segment_of(moved: FloatArray) -> WheelSegment:
    forward, left, turn = np.concatenate([np.zeros((1, 3)), np.cumsum(moved, axis=0)]).T
    half = 0.5 * TRACK_M * turn
    return WheelSegment(stamps(len(forward)), forward - half, forward + half, lateral_m=left)


def stamps(n: int) -> IntArray:
    return START_NS + np.arange(n) * (S // 20)


def test_poses_become_the_twists_that_join_them() -> None:
    moved = twists()
    left_m, right_m, lateral_m = wheel_distances(chain_motions(se2.exp(moved), np.array([3.0, -2.0, 2.5])), TRACK_M)
    wanted = segment_of(moved)
    assert wanted.lateral_m is not None
    np.testing.assert_allclose(left_m, wanted.left_m, atol=1e-12)
    np.testing.assert_allclose(right_m, wanted.right_m, atol=1e-12)
    np.testing.assert_allclose(lateral_m, wanted.lateral_m, atol=1e-12)


def test_motions_between_keyframes_are_those_of_the_twists() -> None:
    moved = twists()
    keyframes = stamps(41)[::8]
    odometry = compose_odometry(segment_of(moved), keyframes, TRACK_M, NOISE)
    poses = chain_motions(se2.exp(moved), np.zeros(3))[::8]
    np.testing.assert_allclose(odometry.motion, se2.between(poses[:-1], poses[1:]), atol=1e-12)
    ways_m = np.hypot(moved[:, 0], moved[:, 1]).reshape(-1, 8).sum(axis=1)
    np.testing.assert_allclose(odometry.distance_m, ways_m, atol=1e-12)


def test_derivatives_by_the_calibration_are_those_of_the_motions() -> None:
    moved, keyframes, h = twists(1), stamps(41)[::8], 1e-6

    def changed(parameter: int, by: float) -> FloatArray:
        """A scale of all lengths, a ratio of right to left, or a track that is another one."""
        forward, left, turn = moved.T
        if parameter == SCALE:
            return moved * (1.0 + by)
        if parameter == RATIO:
            return np.stack([forward + 0.25 * by * TRACK_M * turn, left, turn + by * forward / TRACK_M], axis=-1)
        return np.stack([forward, left, turn / (1.0 + by)], axis=-1)

    nominal = compose_odometry(segment_of(moved), keyframes, TRACK_M, NOISE)
    for parameter in (SCALE, RATIO, TRACK):
        ends = [compose_odometry(segment_of(changed(parameter, s * h)), keyframes, TRACK_M, NOISE) for s in (1, -1)]
        high, low = (se2.log(se2.between(nominal.motion, each.motion)) for each in ends)
        np.testing.assert_allclose(nominal.jacobian[:, :, parameter], (high - low) / (2.0 * h), atol=1e-7)


def test_covariances_are_what_noise_along_the_way_scatters_by() -> None:
    """Distance noise along the motion, lateral noise across it, and headings that carry on, drawn step by step."""
    n, n_draws = 50, 20_000
    step = np.array([0.01, 0.02, 0.005])
    moved = np.tile(step, (n, 1))
    model = compose_odometry(segment_of(moved), stamps(n + 1)[[0, n]], TRACK_M, NOISE).covariance[0]
    way_m, turn_rad = float(np.hypot(*step[:2])), abs(float(step[2]))
    along = step[:2] / way_m
    sigmas = np.sqrt(way_m) * np.array([NOISE.sigma_distance_m_per_sqrt_m, NOISE.sigma_lateral_m_per_sqrt_m])
    heading = np.hypot(
        NOISE.sigma_heading_rad_per_sqrt_m * np.sqrt(way_m), NOISE.sigma_heading_rad_per_sqrt_rad * np.sqrt(turn_rad)
    )
    drawn = np.random.default_rng(0).standard_normal((n, n_draws, 3)) * [*sigmas, heading]
    pose = np.zeros((n_draws, 3))
    for each in drawn:
        error = np.column_stack([each[:, :2] @ np.stack([along, [-along[1], along[0]]]), each[:, 2]])
        pose = se2.compose(se2.compose(pose, se2.exp(step)), se2.exp(error))
    scatter = se2.log(se2.between(chain_motions(se2.exp(moved), np.zeros(3))[-1], pose))
    np.testing.assert_allclose(np.cov(scatter.T), model, rtol=0.06, atol=0.03 * float(model[0, 0]))


def test_a_drive_that_goes_ahead_only_is_the_same_with_and_without_motion_to_the_left() -> None:
    moved = twists(2) * [1.0, 0.0, 1.0]
    wide = segment_of(moved)
    arcs = compose_odometry(replace(wide, lateral_m=None), stamps(41)[::8], TRACK_M, NOISE)
    twisted = compose_odometry(wide, stamps(41)[::8], TRACK_M, NOISE)
    for name in ("motion", "covariance", "jacobian", "distance_m"):
        np.testing.assert_allclose(getattr(twisted, name), getattr(arcs, name), atol=1e-12)


@pytest.mark.parametrize("lateral", [True, False])
def test_velocities_and_motions_within_a_step(lateral: bool) -> None:
    step = np.array([0.05, 0.03 if lateral else 0.0, 0.02])
    segment = segment_of(np.tile(step, (20, 1)))
    segment = segment if lateral else replace(segment, lateral_m=None)
    middle = stamps(21)[10:11]
    np.testing.assert_allclose(segment.twist_at(middle, TRACK_M)[0], 20.0 * step, rtol=1e-9)
    moved = segment.motions(middle, middle + S // 40, TRACK_M)
    np.testing.assert_allclose(moved[0], se2.exp(0.5 * step), atol=1e-9)
