"""Composed odometry: no observation lost, its covariance and Jacobian as the noise model and the wheels have them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.geometry import se2, wheels
from groundsbot.calib.geometry.se2 import chain_motions
from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.offline.measurements.motion_model.motion_model import SegmentOdometry, WheelSegment, compose_odometry
from tests.support.data.drives import START_NS, MadeDrive, S, make_drive

TRACK_M = 0.5
NOISE = NoiseParameters()
WINDING = [(0.5, 0.6, 2.0), (0.8, 0.4, 1.5), (-0.3, 0.3, 1.0), (0.7, 0.7, 2.0), (-0.4, -0.5, 1.0)]


def drive(step_ns: int = S // 100) -> MadeDrive:
    return make_drive([0.0, 0.0, 0.0], WINDING, TRACK_M, step_ns)


def odometry(made: MadeDrive, stamps_ns: object, noise: NoiseParameters = NOISE) -> SegmentOdometry:
    return compose_odometry(made.track, np.asarray(stamps_ns, dtype=np.int64), TRACK_M, noise)


@given(st.lists(st.integers(0, 7_500_000_000), min_size=2, max_size=12, unique=True))
def test_motions_over_any_keyframes_lead_where_all_arcs_lead(after_ns: list[int]) -> None:
    made = drive()
    stamps = START_NS + np.sort(np.array(after_ns, dtype=np.int64))
    found = odometry(made, stamps)
    true = made.at(stamps)
    np.testing.assert_allclose(found.motion, se2.between(true[:-1], true[1:]), atol=1e-9)
    np.testing.assert_allclose(found.dead_reckon(start=true[0])[:, :2], true[:, :2], atol=1e-9)


def test_how_finely_observations_are_spaced_makes_no_difference() -> None:
    """Neither to the motion nor to its covariance, so that a faster controller is no better and no worse."""
    stamps = START_NS + np.array([0, 1.03, 2.5, 4.41, 6.2, 7.5]) * 1e9
    coarse, fine = odometry(drive(S // 20), stamps), odometry(drive(S // 200), stamps)
    np.testing.assert_allclose(coarse.motion, fine.motion, atol=1e-12)
    np.testing.assert_allclose(coarse.jacobian, fine.jacobian, atol=1e-9)
    np.testing.assert_allclose(coarse.distance_m, fine.distance_m, atol=1e-12)
    # Noise is taken along each piece's chord: a few percent where the robot turns on the spot or sharply.
    scale = np.sqrt(np.einsum("nii->ni", fine.covariance))
    np.testing.assert_allclose(
        (coarse.covariance - fine.covariance) / scale[:, :, None] / scale[:, None, :], 0, atol=0.03
    )


@pytest.mark.parametrize("leg", [(0.5, 0.5), (0.3, 0.7), (-0.4, -0.2)])
def test_covariance_is_that_of_the_noise_model(leg: tuple[float, float]) -> None:
    """Against 4000 drives with the noise that groundsbot.calib.robot.noise describes, small step by small step."""
    made = make_drive([0.0, 0.0, 0.0], [(*leg, 2.0)], TRACK_M, S // 20)
    # Sideways noise beyond what robots have, so that it counts beside what the heading does.
    noise = NoiseParameters(sigma_lateral_m_per_sqrt_m=0.02)
    found = odometry(made, made.stamps_ns[[0, -1]], noise)
    rng = np.random.default_rng(7)
    left_m, right_m = np.diff(made.left_m), np.diff(made.right_m)
    steps = wheels.advance(left_m, right_m, TRACK_M)
    pose = np.zeros((4000, 3))
    for step, sigma in zip(steps, _step_sigmas(left_m, right_m, noise), strict=True):
        pose = se2.compose(se2.compose(pose, step), se2.exp(sigma * rng.standard_normal((4000, 3))))
    errors = se2.log(se2.between(found.motion[0], pose))
    whitened = np.linalg.solve(np.linalg.cholesky(found.covariance[0]), errors.T)
    # An entry of the covariance of 4000 samples is off by 0.022, on the diagonal by 0.016 sqrt(2).
    np.testing.assert_allclose(np.cov(whitened), np.eye(3), atol=0.1)


def _step_sigmas(left_m: FloatArray, right_m: FloatArray, noise: NoiseParameters) -> FloatArray:
    distance_m, turn_rad = np.abs(left_m + right_m) / 2, np.abs(right_m - left_m) / TRACK_M
    return np.sqrt(
        np.stack(
            [
                noise.sigma_distance_m_per_sqrt_m**2 * distance_m,
                noise.sigma_lateral_m_per_sqrt_m**2 * distance_m,
                noise.sigma_heading_rad_per_sqrt_m**2 * distance_m + noise.sigma_heading_rad_per_sqrt_rad**2 * turn_rad,
            ],
            axis=-1,
        )
    )


def test_covariance_of_a_segment_does_not_depend_on_where_it_is_cut() -> None:
    """Two steps composed are as uncertain as one, but for the ticks that each end is read to."""
    made = make_drive([0.0, 0.0, 0.0], [(0.3, 0.7, 3.0)])
    whole = odometry(made, made.stamps_ns[[0, 300]])
    cut = odometry(made, made.stamps_ns[[0, 140, 300]])
    to_end = se2.adjoint(se2.inverse(cut.motion[1]))
    joined = to_end @ cut.covariance[0] @ to_end.T + cut.covariance[1]
    np.testing.assert_allclose(joined, whole.covariance[0], atol=1e-7)
    jacobian = to_end @ cut.jacobian[0] + cut.jacobian[1]
    np.testing.assert_allclose(jacobian, whole.jacobian[0], atol=1e-9)


def test_dead_reckoning_takes_a_calibration() -> None:
    made = drive()
    truly_left_m, truly_right_m = made.left_m * 1.01 * 0.999, made.right_m * 1.01 * 1.001
    steps = wheels.advance(np.diff(truly_left_m), np.diff(truly_right_m), TRACK_M * 1.005)
    true = chain_motions(steps, np.array([1.0, 2.0, 0.5]))
    found = odometry(made, made.stamps_ns[::10]).dead_reckon(np.array([0.01, 0.002, 0.005]), true[0])
    np.testing.assert_allclose(found[:, :2], true[::10, :2], atol=2e-3)
    assert np.linalg.norm(odometry(made, made.stamps_ns[::10]).dead_reckon(start=true[0])[-1, :2] - true[-1, :2]) > 0.01


def test_a_gap_keeps_the_motion_and_widens_its_covariance() -> None:
    """Counts bridge a gap: how far and how much turned is known, the path between is not."""
    made = make_drive([0.0, 0.0, 0.0], [(0.5, 0.6, 6.0)])
    kept = np.r_[0:200, 300:601]  # a second without observations
    with_gap = WheelSegment(made.stamps_ns[kept], made.left_m[kept], made.right_m[kept])
    stamps = made.stamps_ns[[0, 150, 350, 600]]
    found, whole = compose_odometry(with_gap, stamps, TRACK_M, NOISE), odometry(made, stamps)
    np.testing.assert_allclose(found.motion, whole.motion, atol=1e-9)  # speeds were constant: nothing was missed
    sigma, sigma_whole = (np.sqrt(np.einsum("nii->ni", each.covariance)) for each in (found, whole))
    np.testing.assert_allclose(sigma[[0, 2]], sigma_whole[[0, 2]], rtol=1e-9)
    assert (sigma[1, :2] > 2.0 * sigma_whole[1, :2]).all()


def test_half_a_second_without_observations_is_no_gap_yet() -> None:
    made = make_drive([0.0, 0.0, 0.0], [(0.5, 0.5, 4.0)])
    kept = np.r_[0:200, 249:401]
    track = WheelSegment(made.stamps_ns[kept], made.left_m[kept], made.right_m[kept])
    stamps = made.stamps_ns[[0, 400]]
    found, whole = compose_odometry(track, stamps, TRACK_M, NOISE), odometry(made, stamps)
    np.testing.assert_allclose(found.covariance, whole.covariance, rtol=0.05, atol=1e-7)


def test_one_keyframe_has_no_motion() -> None:
    found = odometry(drive(), [START_NS])
    assert len(found) == 0
    assert found.covariance.shape == (0, 3, 3)
    np.testing.assert_array_equal(found.dead_reckon(start=np.array([1.0, 2.0, 3.0])), [[1.0, 2.0, 3.0]])


def test_a_robot_that_stands_still_is_certain_but_not_infinitely() -> None:
    made = make_drive([0.0, 0.0, 0.0], [(0.0, 0.0, 2.0)])
    found = odometry(made, made.stamps_ns[[0, 100, 200]])
    np.testing.assert_array_equal(found.motion, np.zeros((2, 3)))
    assert np.isfinite(np.linalg.inv(found.covariance)).all()
    assert (np.sqrt(np.einsum("nii->ni", found.covariance)) < 1e-3).all()


def test_ticks_that_jump_between_wheels_do_not_add_up_to_a_turn() -> None:
    """Coarse counts read one by one show turns that never were; they must not add to the heading's noise."""
    made = make_drive([0.0, 0.0, 0.0], [(0.5, 0.5, 2.0)])
    tick_m = 0.02
    left_m, right_m = (np.floor((made.left_m + begin) / tick_m) * tick_m for begin in (0.0, 0.01))
    coarse = WheelSegment(made.stamps_ns, left_m, right_m, tick_m)
    stamps = made.stamps_ns[[0, 200]]
    heading_sigma = np.sqrt(compose_odometry(coarse, stamps, TRACK_M, NOISE).covariance[0, 2, 2])
    ticks_sigma = np.sqrt(2 / 6) * tick_m / TRACK_M  # both ends of both wheels, evenly within a tick
    expected = np.hypot(np.radians(0.6), ticks_sigma)
    assert heading_sigma == pytest.approx(expected, rel=0.1)
