"""Keyframes that leave the window of an online drive, and a gyro's bias that walks."""

import copy

import numpy as np
import pytest

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.foundation import njit
from groundsbot.offline.localization.online import smoother as smoother_module
from groundsbot.offline.localization.online.drive import DRIVE, GyroDifference
from groundsbot.offline.localization.online.information_root import OnlineRoot
from groundsbot.offline.localization.online.kernels import Border, _let_walk
from groundsbot.offline.localization.online.localizer import OnlineLocalizer, OnlinePose
from groundsbot.offline.localization.online.marginal import Marginal
from groundsbot.offline.localization.online.prior import OnlinePrior
from groundsbot.offline.sam.parameters import parameters_of_gyro
from tests.benchmarks.accuracy.localize_study import Scene, filter_online, taken_one_by_one
from tests.support.online_drives import feed, straight_step, whole_root


@pytest.mark.parametrize("turn_rad", [0.0, -0.3])
def test_marginalised_keyframes_leave_step_and_covariance_as_they_are(online: OnlineLocalizer, turn_rad: float) -> None:
    """Also where the frame was turned since: their linearisation points move with the tags."""
    smoother, whole, middle = online._smoother, whole_root(online, online._smoother.calibration), 60
    drive, T = copy.deepcopy(smoother.drive), np.array([0.5, -0.2, turn_rad])
    root = OnlineRoot(_prior(online, is_flat=True), se2.compose(T, drive.poses[0]), held=False)
    for place_m in se2.apply(T, smoother.places_m):
        root.add_tag(place_m, None)
    turned = copy.deepcopy(drive)
    turned.poses[:] = se2.compose(T, turned.poses)
    n = int(np.searchsorted(drive.keyframe, middle, side="right"))
    while root.keyframe < middle or root.n_observations < n:
        root.advance(turned, middle)
    numbers = smoother.calibration, smoother.places_m, smoother._numbers.columns
    before = root.marginal().about(drive.poses[middle], *numbers)
    assert drive.forget(middle) == n
    assert drive.keyframe.min() > 0
    after = OnlineRoot(_prior(online), drive.poses[0], held=False, before=before)
    for tag, place_m in enumerate(smoother.places_m):
        after.add_tag(place_m, smoother.map_tags.get(tag))
    while not after.is_at_end_of(drive):
        after.advance(drive)
    np.testing.assert_allclose(straight_step(after), straight_step(whole), atol=1e-7)
    np.testing.assert_allclose(after.tags_covariance(), whole.tags_covariance(), rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(after.pose_covariance(), whole.pose_covariance(), rtol=1e-6)


def test_a_marginal_is_shifted_with_its_linearisation_points(online: OnlineLocalizer) -> None:
    """What is left after the common motion of pose and tags is a step, by which the rows' values change."""
    smoother, rng = online._smoother, np.random.default_rng(3)
    n, places_m = len(smoother.places_m), smoother.places_m
    columns = smoother._numbers.columns
    rows = rng.normal(size=(5, 4 + (columns >= 0).sum() + 2 * n))
    marginal = Marginal(rows, smoother.drive.poses[9], smoother.calibration, places_m)
    step = rng.normal(scale=1e-3, size=rows.shape[1] - 1)
    step[2] = step[3 + (columns >= 0).sum() :] = 0.0  # heading and tags stay
    calibration = smoother.calibration.copy()
    calibration[columns >= 0] += step[3 : 3 + (columns >= 0).sum()]
    point = se2.compose(marginal.point, se2.exp(step[:3]))
    moved = marginal.about(point, calibration, places_m, columns)
    np.testing.assert_allclose(moved[:, 3], rows[:, 3] - np.delete(rows, 3, axis=1) @ step, atol=1e-9)


def test_a_bias_that_walks_is_less_certain_by_just_that(scene: Scene) -> None:
    """What is known of all else stays, and so does its covariance with the bias."""
    online = OnlineLocalizer(scene.known, scene.drive.segment.run.robot, has_gyro=True)
    rng = np.random.default_rng(2)
    for k, (motion, observations) in enumerate(taken_one_by_one(scene.drive.segment)):
        if k == 40:
            break
        if motion is not None:
            row = np.append(np.zeros(3), rng.normal(size=3))
            jacobian = np.hstack([motion[2], rng.normal(size=(3, 3))])
            online.add_motion(motion[0], motion[1], jacobian, GyroDifference(row, 0.1, 0.0))
        for observation in observations:
            online.add_observation(observation)
    front = online._smoother.front
    assert front is not None
    before = front.variance_of(np.eye(3 + front.prior.n))
    parameters = [*parameters_of_gyro(scene.drive.segment.run.robot, DRIVE, 1)]
    bias = front.prior.columns[online._parameters.index(parameters[-1])]
    let_walk(front._border, front._pose, front.prior.n, bias, 0.3)
    before[3 + bias, 3 + bias] += 0.3
    np.testing.assert_allclose(front.variance_of(np.eye(3 + front.prior.n)), before, rtol=1e-6, atol=1e-9)


@njit
def let_walk(border: Border, pose: FloatArray, n: int, at: int, variance: float) -> None:
    _let_walk(border, pose, n, at, variance, np.empty(4 + n))


def test_memory_of_a_long_drive_is_bounded(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = filter_online(scene)[0]
    monkeypatch.setattr(smoother_module, "_LAG", 40)
    monkeypatch.setattr(smoother_module, "_LEAST_MARGINALISED", 8)
    online = OnlineLocalizer(scene.known, scene.drive.segment.run.robot)
    most = 0
    for taken in taken_one_by_one(scene.drive.segment):
        feed(online, [taken])
        most = max(most, len(online._smoother.drive.poses))
    assert most <= 100 < len(scene.drive.segment.stamps_ns)
    assert online.pose is not None
    assert whole.pose is not None
    assert _sigmas_off(online.pose, whole.pose) < 0.2
    np.testing.assert_allclose(online.pose.covariance, whole.pose.covariance, rtol=0.05, atol=1e-8)
    settled = online.settle()
    assert settled is not None
    assert _sigmas_off(settled, whole.pose) < 0.2


def _sigmas_off(pose: OnlinePose, other: OnlinePose) -> float:
    off = pose.T_map_base - other.T_map_base
    return float(np.sqrt(off @ np.linalg.solve(other.covariance, off)))


def _prior(online: OnlineLocalizer, *, is_flat: bool = False) -> OnlinePrior:
    return OnlinePrior(online._known, online._smoother._numbers, online._smoother.calibration, is_flat=is_flat)
