"""Covariances given for the steps of odometry: used in place of the noise model where they are plausible."""

from collections.abc import Callable

import numpy as np
import pytest

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.offline.measurements.motion_model.motion_model import WheelSegment, compose_odometry
from groundsbot.offline.measurements.motion_model.step_covariance import given_covariances, growth
from tests.support.data.drives import S, make_drive
from tests.support.data.odometry_steps import accumulate, covariances_of_steps

POSES = make_drive([1.0, 2.0, 2.0], [(0.4, 0.3, 3.0), (0.0, 0.0, 1.0), (-0.2, 0.2, 2.0), (0.5, 0.5, 3.0)]).T_world_base


def test_what_a_poses_covariance_grows_by_is_that_of_the_step() -> None:
    steps = covariances_of_steps(POSES)
    found, told = growth(POSES, accumulate(POSES, steps))
    assert found is not None, told
    np.testing.assert_allclose(found, steps, atol=1e-13)


def test_a_pose_is_as_far_off_as_its_covariance_says() -> None:
    """What carries a covariance on is the derivative of composing poses: checked by drawing."""
    rng, steps = np.random.default_rng(1), covariances_of_steps(POSES[:200])
    motions = se2.between(POSES[:199], POSES[1:200])
    roots = np.linalg.cholesky(steps[1:])
    drawn = np.tile(POSES[0], (4000, 1))
    for motion, root in zip(motions, roots, strict=True):
        drawn = se2.compose(drawn, se2.compose(motion, se2.exp(rng.standard_normal((4000, 3)) @ root.T)))
    error = drawn - POSES[199]
    expected = accumulate(POSES[:200], steps)[-1]
    np.testing.assert_allclose(np.cov(error.T), expected, atol=0.08 * float(np.abs(expected).max()))


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (lambda c: 0.0 * c, "are zeros"),
        (lambda c: 0.0 * c + np.diag([1e-3, 1e-3, 1e-2]), "do not grow along the path"),
        (lambda c: 0.0 * c + np.diag([1e-3, 1e-3, 0.0]), "do not grow along the path"),
        (lambda c: c[::-1], "do not grow along the path"),
        (lambda c: np.where(np.arange(len(c))[:, None, None] == 7, np.nan, c), "are invalid"),
        (lambda c: c + np.triu(c, 1), "are invalid"),
        (lambda c: c * 1e5, "are too large"),
        (lambda c: c * np.outer([1, 1, 0], [1, 1, 0]), "do not grow along the path"),
    ],
    ids=[
        "zeros",
        "constant",
        "constant without a turn",
        "shrinking",
        "no numbers",
        "not symmetric",
        "large",
        "no turn",
    ],
)
def test_covariances_that_no_path_has_are_not_used(spoil: Callable[[FloatArray], FloatArray], told: str) -> None:
    found, said = growth(POSES, spoil(accumulate(POSES, covariances_of_steps(POSES))))
    assert found is None
    assert said.startswith(told)


def test_a_logs_covariances_are_checked_one_by_one() -> None:
    good, other = np.diag([1e-4, 1e-4, 1e-5]).ravel().tolist(), np.diag([1e-4, -1e-4, 1e-5]).ravel().tolist()
    given: list[list[float]] = [
        [],
        good,
        other,
        [*good[:8], float("nan")],
        good[:4],
        np.eye(3).ravel().tolist(),
        (2 * np.eye(3)).ravel().tolist(),
    ]
    found, n_bad = given_covariances(given)
    assert found is not None
    assert np.isfinite(found).all((-1, -2)).tolist() == [False, True, False, False, False, True, False]
    assert n_bad == 4
    assert given_covariances([(), ()]) == (None, 0)


def covariance_over(covariance: FloatArray | None, at_s: list[float]) -> FloatArray:
    """Of the motion between times on a straight drive of 1 m/s with an observation each second."""
    stamps_ns = np.arange(4) * S
    track = WheelSegment(stamps_ns, np.arange(4.0), np.arange(4.0), covariance=covariance)
    return compose_odometry(track, (np.array(at_s) * S).astype(np.int64), 0.5, NoiseParameters()).covariance


def test_given_covariances_are_carried_to_the_keyframe_instead_of_the_noise_models() -> None:
    """By hand: a turn in the first step moves the end of the second sideways by its length."""
    step = np.diag([0.01, 0.02, 0.03])
    found = covariance_over(np.tile(step, (4, 1, 1)), [0.0, 2.0, 3.0])
    two = 2 * step
    two[1, 1] += 0.03
    two[1, 2] = two[2, 1] = 0.03
    # Observations a second apart are a gap, over which the path is not known; a tick is at least 0.1 mm.
    gap = np.diag([0.01, 0.01, 0.0])
    np.testing.assert_allclose(found, [two + 2 * gap, step + gap], atol=1e-6)


def test_a_part_of_a_step_has_its_share() -> None:
    step = np.diag([0.04, 0.02, 0.0])
    whole, part = (covariance_over(np.tile(step, (4, 1, 1)), [1.0, end]) for end in (2.0, 1.25))
    np.testing.assert_allclose(whole[0] - np.diag([0.01, 0.01, 0.0]), step, atol=1e-6)
    np.testing.assert_allclose(part[0], step / 4, atol=1e-6)


def test_the_noise_model_is_used_where_no_covariance_is_given() -> None:
    some = np.full((4, 3, 3), np.nan)
    some[3] = np.eye(3)
    found, model = covariance_over(some, [0.0, 2.0, 3.0]), covariance_over(None, [0.0, 2.0, 3.0])
    np.testing.assert_array_equal(found[0], model[0])
    assert found[1, 2, 2] == pytest.approx(1.0, abs=1e-3)
