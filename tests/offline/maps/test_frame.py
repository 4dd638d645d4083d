"""A change of frame: everything moves as one, and covariances are those of errors relative to the new frame."""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.maps.archive import ArchivedCalibration
from groundsbot.offline.maps.datum import DatumKind, TagDatum
from groundsbot.offline.maps.frame import (
    CrossCovariances,
    move_to_start,
    move_to_tags,
    relative_to_tags,
    start_vectors,
    tags_own_axes,
)
from groundsbot.offline.maps.result import Component, TagPose
from tests.support.data.maps import make_component

N_TAGS, N_STARTS, N_NUMBERS = 3, 6, 2
N_PLACES = N_STARTS + 2 * N_TAGS
ATTITUDES = slice(N_PLACES, N_PLACES + 4 * N_TAGS)
NUMBERS = slice(N_PLACES + 4 * N_TAGS, N_PLACES + 4 * N_TAGS + N_NUMBERS)
WEIGHTS = np.array([1.0, 0.0, 0.25])
T_NEW_MAP = np.array([30.0, -4.0, 2.5])


class Whole(NamedTuple):
    """A component of corners with the joint covariance of starts, places, attitudes and calibration, of which each
    figure of the component is a part."""

    component: Component
    covariance: FloatArray
    cross: CrossCovariances


@pytest.fixture(scope="module")
def whole() -> Whole:
    made = make_component()
    n = NUMBERS.stop
    root = 0.02 * np.random.default_rng(6).normal(size=(n, n)) + 0.03 * np.eye(n)
    root[:3] = 0.0  # the first start is the frame
    covariance = root @ root.T
    tags = []
    for i, tag in enumerate(made.tags):
        own = np.array([*range(N_STARTS + 2 * i, N_STARTS + 2 * i + 2), *range(N_PLACES + 4 * i, N_PLACES + 4 * i + 4)])
        quaternion = Rotation.from_euler("xyz", [1.3, 0.2 * i, 0.7 * i]).as_quat(canonical=True)
        pose = TagPose(0.4 + 0.1 * i, quaternion, covariance[np.ix_(own, own)])
        tags.append(replace(tag, pose=pose, covariance=pose.covariance[:2, :2]))
    calibration = ArchivedCalibration(
        ("red",) * N_NUMBERS,
        ("wheel_scale", "track_scale"),
        np.full((N_NUMBERS, 4), np.nan),
        np.zeros(N_NUMBERS),
        covariance[NUMBERS, NUMBERS],
        covariance[NUMBERS, N_STARTS:N_PLACES],
    )
    component = replace(
        made,
        tags=tuple(tags),
        joint_covariance=covariance[:N_PLACES, :N_PLACES],
        start_to_start=start_vectors(made.runs, covariance[:N_PLACES, :N_PLACES]),
        calibration=calibration,
    )
    attitudes = covariance[ATTITUDES, :N_PLACES].reshape(N_TAGS, 4, N_PLACES)
    return Whole(component, covariance, CrossCovariances(covariance[NUMBERS, :N_STARTS], attitudes))


Frame = Callable[[FloatArray, FloatArray], FloatArray]


def coordinates(component: Component, error: FloatArray, frame: Frame) -> FloatArray:
    """Starts, places, attitudes (height, and rotation from the estimate) and calibration of a component that is off by
    an error, in a frame made of its starts and places."""
    starts = np.array([run.T_map_start for run in component.runs])
    places = np.array([tag.position_m for tag in component.tags])
    unmoved = Rotation.from_rotvec([0.0, 0.0, frame(starts, places)[2]])
    starts, places = starts + error[:N_STARTS].reshape(-1, 3), places + error[N_STARTS:N_PLACES].reshape(-1, 2)
    T = frame(starts, places)
    turned, attitudes = Rotation.from_rotvec([0.0, 0.0, T[2]]), []
    for tag, (height, *turn) in zip(component.tags, error[ATTITUDES].reshape(-1, 4), strict=True):
        assert tag.pose is not None
        estimate = Rotation.from_quat(tag.pose.quaternion_xyzw)
        off = turned * Rotation.from_rotvec(turn) * estimate * (unmoved * estimate).inv()
        attitudes += [tag.pose.height_m + height, *off.as_rotvec()]
    return np.concatenate([*se2.compose(T, starts), *se2.apply(T, places), attitudes, error[NUMBERS]])


def assert_transformed(moved: Component, whole: Whole, frame: Frame) -> None:
    """All covariances of a component are those that finite differences of its new coordinates give."""
    n, step = NUMBERS.stop, 1e-5
    errors = step * np.eye(n)
    J = np.array([coordinates(whole.component, e, frame) - coordinates(whole.component, -e, frame) for e in errors]).T
    wanted = J @ whole.covariance @ J.T / (2.0 * step) ** 2
    np.testing.assert_allclose(moved.joint_covariance, wanted[:N_PLACES, :N_PLACES], atol=1e-9)
    for i, tag in enumerate(moved.tags):
        own = np.array([*range(N_STARTS + 2 * i, N_STARTS + 2 * i + 2), *range(N_PLACES + 4 * i, N_PLACES + 4 * i + 4)])
        assert tag.pose is not None
        np.testing.assert_allclose(tag.pose.covariance, wanted[np.ix_(own, own)], atol=1e-9)
        np.testing.assert_allclose(tag.covariance, tag.pose.covariance[:2, :2], atol=1e-12)
    for i, run in enumerate(moved.runs):
        np.testing.assert_allclose(run.covariance, wanted[3 * i : 3 * i + 3, 3 * i : 3 * i + 3], atol=1e-9)
    assert moved.calibration is not None
    np.testing.assert_allclose(moved.calibration.with_tags, wanted[NUMBERS, N_STARTS:N_PLACES], atol=1e-9)
    (vector,) = moved.start_to_start
    between = np.hstack([-np.eye(2), np.zeros((2, 1)), np.eye(2), np.zeros((2, 1))])
    np.testing.assert_allclose(vector.covariance, between @ wanted[:6, :6] @ between.T, atol=1e-9)


def test_in_a_frame_that_tags_hold_covariances_are_relative_to_them(whole: Whole) -> None:
    moved = move_to_tags(whole.component, TagDatum(DatumKind.SURVEY, WEIGHTS), T_NEW_MAP, whole.cross)
    held = se2.apply(T_NEW_MAP, np.array([tag.position_m for tag in whole.component.tags]))

    def frame(_starts: FloatArray, places: FloatArray) -> FloatArray:
        return se2.fit_transform(held, places, WEIGHTS)

    assert (moved.frame_run, moved.frame_name) == (None, "the survey's frame")
    assert_transformed(moved, whole, frame)


def test_in_the_frame_of_another_start_covariances_are_relative_to_it(whole: Whole) -> None:
    moved = move_to_start(whole.component, "blue_two", whole.cross)

    def frame(starts: FloatArray, _places: FloatArray) -> FloatArray:
        return se2.inverse(starts[1])

    assert (moved.frame_run, moved.frame_name) == ("blue_two", "the start of blue_two")
    assert not moved.joint_covariance[3:6].any()
    assert_transformed(moved, whole, frame)


def test_everything_moves_as_one(whole: Whole) -> None:
    before = whole.component
    moved = move_to_tags(before, TagDatum(DatumKind.TAGS, np.ones(3)), T_NEW_MAP, whole.cross)
    for old, new in zip(before.runs, moved.runs, strict=True):
        np.testing.assert_allclose(new.T_map_base, se2.compose(T_NEW_MAP, old.T_map_base), atol=1e-12)
        np.testing.assert_allclose(new.T_map_start, se2.compose(T_NEW_MAP, old.T_map_start), atol=1e-12)
    for a, b in zip(before.tags, moved.tags, strict=True):
        np.testing.assert_allclose(b.position_m, se2.apply(T_NEW_MAP, a.position_m), atol=1e-12)
        assert a.pose is not None
        assert b.pose is not None
        assert b.pose.height_m == a.pose.height_m
        assert se2.wrap_angle(b.pose.yaw_rad - a.pose.yaw_rad - T_NEW_MAP[2]) == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_allclose(moved.start_to_start[0].sigma_m, before.start_to_start[0].sigma_m, rtol=1e-9)


def test_the_tags_own_axes_have_the_least_trace(whole: Whole) -> None:
    least = np.trace(relative_to_tags(whole.component, np.ones(3))[N_STARTS:, N_STARTS:])
    rng = np.random.default_rng(8)
    for _ in range(50):
        assert np.trace(relative_to_tags(whole.component, rng.uniform(0.1, 1.0, 3))[N_STARTS:, N_STARTS:]) > least
    assert np.trace(whole.component.tag_covariance) > least
    at_other = move_to_start(whole.component, "blue_two", whole.cross)
    assert np.trace(at_other.tag_covariance) > least


def test_the_way_there_does_not_matter(whole: Whole) -> None:
    """By another start, or at once; and back, what the frame took out is there again."""
    datum = TagDatum(DatumKind.TAGS, np.ones(3))
    at_once = move_to_tags(whole.component, datum, T_NEW_MAP, whole.cross)
    other = move_to_start(whole.component, "blue_two", whole.cross)
    assert other.calibration is not None
    T_new_other = se2.compose(T_NEW_MAP, whole.component.runs[1].T_map_start)
    around = move_to_tags(other, datum, T_new_other, CrossCovariances(np.zeros((N_NUMBERS, N_STARTS)), None))
    np.testing.assert_allclose(around.joint_covariance, at_once.joint_covariance, atol=1e-12)
    back = move_to_start(at_once, "red_one", CrossCovariances(np.zeros((N_NUMBERS, N_STARTS)), None))
    np.testing.assert_allclose(back.joint_covariance, whole.component.joint_covariance, atol=1e-12)


def test_own_axes_are_at_the_mean_along_the_largest_extent(whole: Whole) -> None:
    places = np.array([[1.0, 5.0], [2.0, 3.0], [3.0, 1.0], [2.0, 3.0]])  # along (1, -2)
    tags = tuple(replace(whole.component.tags[0], position_m=place) for place in places)
    moved = se2.apply(tags_own_axes(replace(whole.component, tags=tags)), places)
    np.testing.assert_allclose(moved, [[-np.sqrt(5), 0], [0, 0], [np.sqrt(5), 0], [0, 0]], atol=1e-12)
