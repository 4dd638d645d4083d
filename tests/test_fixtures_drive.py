"""Drives: where they lead, what the wheels tell of them, how the floor errs."""

from typing import Any

import numpy as np
import pytest

from groundsbot.calib.geometry import se2
from groundsbot.calib.geometry.wheels import advance
from groundsbot.fixtures.drives.driver import DEAD_TIME_S
from groundsbot.fixtures.drives.true_motion import Drive, drive, longest_drive_s
from groundsbot.fixtures.errors import FixturesError
from groundsbot.fixtures.worlds.route import pieces_of
from groundsbot.fixtures.worlds.world import World, WorldRobot

TRACK_M = 0.4
STILL = {
    "sigma_distance_m_per_sqrt_m": 0.0,
    "sigma_lateral_m_per_sqrt_m": 0.0,
    "sigma_heading_rad_per_sqrt_m": 0.0,
    "sigma_heading_rad_per_sqrt_rad": 0.0,
}


def made_world(waypoints: list[dict[str, float]], **more: Any) -> World:
    route = {"start": {"x_m": 0.0, "y_m": 0.0, "yaw_deg": 0.0}, "waypoints": waypoints, **more.pop("route", {})}
    robot = {"id": "a", "robot": {}, "route": route}
    return World.model_validate({"name": "made", "robots": [robot], "noise": STILL, **more})


def driven(world: World, seed: int = 0) -> Drive:
    robot: WorldRobot = world.robots[0]
    times = np.arange(int(longest_drive_s(robot) * 100)) * 10_000_000
    return drive(world, robot, TRACK_M, seed, times)


def test_a_square_with_arcs_and_a_turn_on_the_spot_ends_where_it_should() -> None:
    world = made_world(
        [
            {"x_m": 3.0, "y_m": 0.0, "corner_radius_m": 0.5},
            {"x_m": 3.0, "y_m": 3.0, "stop_s": 2.0},
            {"x_m": 0.0, "y_m": 3.0},
        ],
        route={"final_yaw_deg": 90.0},
    )
    done = driven(world)
    np.testing.assert_allclose(done.T_world_base[-1], [0.0, 3.0, np.pi / 2], atol=0.02)
    # Two quarter pieces of line are replaced by an arc of 0.5 m: 9 - 2 * 0.5 + pi / 4.
    assert done.distance_m == pytest.approx(9.0 - 1.0 + np.pi / 4, abs=0.03)
    speed = np.hypot(*np.diff(done.T_world_base[:, :2], axis=0).T) / 0.01
    assert speed.max() <= world.robots[0].route.speed_m_s + 1e-9
    assert np.abs(np.diff(speed)).max() / 0.01 < 4.0  # m/s^2: the last creep's halt is the hardest
    standing = np.hypot(*(done.T_world_base[:, :2] - [3.0, 3.0]).T) < 0.02
    assert 2.0 < standing.sum() * 0.01 < 6.0  # the stop, and turning there


def test_the_wheels_alone_describe_the_drive_exactly_when_the_floor_does_not_err() -> None:
    done = driven(made_world([{"x_m": 4.0, "y_m": 0.0, "corner_radius_m": 0.8}, {"x_m": 4.0, "y_m": -3.0}]))
    steps = advance(np.diff(done.left_m), np.diff(done.right_m), TRACK_M)
    pose = done.T_world_base[0]
    for step in steps:
        pose = se2.compose(pose, step)
    np.testing.assert_allclose(pose, done.T_world_base[-1], atol=1e-9)
    # Between readings the truth is on the arc of constant twist, that is of constant wheel speeds.
    half = done.at((done.stamps_ns[:-1] + done.stamps_ns[1:]) // 2)
    left, right = np.diff(done.left_m) / 2, np.diff(done.right_m) / 2
    expected = se2.compose(done.T_world_base[:-1], advance(left, right, TRACK_M))
    np.testing.assert_allclose(half, expected, atol=1e-9)


def test_the_floor_errs_as_its_sigmas_say() -> None:
    noise = {
        "sigma_distance_m_per_sqrt_m": 0.02,
        "sigma_lateral_m_per_sqrt_m": 0.01,
        "sigma_heading_rad_per_sqrt_m": 0.03,
        "sigma_heading_rad_per_sqrt_rad": 0.05,
    }
    world = made_world([{"x_m": 40.0, "y_m": 0.0}, {"x_m": 0.0, "y_m": 0.0}], noise=noise)
    found = []
    for seed in range(4):
        done = driven(world, seed)
        wheels = advance(np.diff(done.left_m), np.diff(done.right_m), TRACK_M)
        motion = se2.between(done.T_world_base[:-1], done.T_world_base[1:])
        left_over = se2.log(se2.between(wheels, motion))
        distance = np.abs(np.diff(done.left_m) + np.diff(done.right_m))[:, np.newaxis] / 2
        turn = np.abs(wheels[:, 2:])
        variance = np.hstack([distance * 0.02**2, distance * 0.01**2, distance * 0.03**2 + turn * 0.05**2])
        moving = variance[:, 2] > 0
        found.append(left_over[moving] / np.sqrt(np.maximum(variance[moving], 1e-30)))
    scaled = np.concatenate(found)
    rolling = np.abs(scaled[:, 0]) > 0  # on the spot only the heading errs
    assert len(scaled) > 20_000
    np.testing.assert_allclose(scaled[rolling].std(axis=0), 1.0, atol=0.03)
    np.testing.assert_allclose(scaled.mean(axis=0), 0.0, atol=0.03)


def test_what_the_floor_does_is_answered_after_the_dead_time_and_not_before() -> None:
    waypoints = [{"x_m": 4.0, "y_m": 0.0, "corner_radius_m": 0.5}, {"x_m": 4.0, "y_m": 3.0}]
    firm, erring = driven(made_world(waypoints)), driven(made_world(waypoints, noise={}))
    first_err = np.flatnonzero((firm.T_world_base[: len(erring.stamps_ns)] != erring.T_world_base).any(axis=1))[0]
    told = [np.diff([each.left_m, each.right_m], axis=1)[:, : 2 * first_err] for each in (firm, erring)]
    unlike = np.abs(told[0] - told[1]).max(axis=0) > 1e-9
    # The step that begins when the pose after the first err has been seen is the first that can be another one.
    assert np.flatnonzero(unlike)[0] == first_err + round(DEAD_TIME_S / 0.01)


@pytest.mark.parametrize("speed_m_s", [0.3, 3.0])
def test_eyes_that_are_late_make_no_robot_swing(speed_m_s: float) -> None:
    world = made_world([{"x_m": 60.0, "y_m": 0.0}], noise={}, route={"speed_m_s": speed_m_s})
    assert np.abs(driven(world).T_world_base[:, 1]).max() < 0.05


def test_a_slipping_wheel_turns_further_than_it_rolls() -> None:
    waypoints = [{"x_m": 30.0, "y_m": 0.0}]
    firm = driven(made_world(waypoints))
    slipping = driven(made_world(waypoints, slips={"events_per_m": 1.0, "sigma_m": 0.05}))
    np.testing.assert_array_equal(firm.T_world_base, slipping.T_world_base)
    extra = np.array([slipping.left_m[-1] - firm.left_m[-1], slipping.right_m[-1] - firm.right_m[-1]])
    # 30 events of 0.05 m * sqrt(2 / pi), shared by two wheels.
    assert 0.6 < extra.sum() < 1.8
    assert (extra > 0.1).all()


@pytest.mark.parametrize(
    ("waypoints", "expected"),
    [
        ([{"x_m": 0.0, "y_m": 0.0}], "is the point before it again"),
        ([{"x_m": 1.0, "y_m": 0.0, "corner_radius_m": 2.0}, {"x_m": 1.0, "y_m": 1.0}], "lower corner_radius_m"),
    ],
)
def test_routes_that_cannot_be_are_refused(waypoints: list[dict[str, float]], expected: str) -> None:
    with pytest.raises(FixturesError, match=expected):
        pieces_of(made_world(waypoints).robots[0])
