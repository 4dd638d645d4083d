"""Simulation as a whole, without pictures: what is written, that it repeats, that it tells the truth."""

import hashlib
import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.calib.geometry.wheels import advance
from groundsbot.calib.robot.robot import read_robot_yaml
from groundsbot.calib.tags.edges import moved_out
from groundsbot.fixtures.drives.calibration import camera_model, nominal_robot, true_robot, true_tag_sizes_m
from groundsbot.fixtures.errors import FixturesError
from groundsbot.fixtures.simulate import simulate
from groundsbot.fixtures.worlds.world import World, load_world
from groundsbot.onboard.log.messages import TagDetections, WheelEncoders
from groundsbot.onboard.log.reading.reader import read_log
from tests.programs import on_terminal


def digests(folder: Path) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def wheels_in(log: Path) -> list[WheelEncoders]:
    return [each.message for each in read_log(log, ["/wheels"]) if isinstance(each.message, WheelEncoders)]


def detections_in(log: Path) -> list[TagDetections]:
    return [each.message for each in read_log(log, ["/tags/detections"]) if isinstance(each.message, TagDetections)]


def exact_world() -> World:
    """Room without any error but what the ticks round away."""
    world = load_world("room").model_dump()
    world["noise"] = dict.fromkeys(world["noise"], 0.0)
    world["wheel_link"] |= {
        "clock_drift_ppm_sigma": 0.0,
        "sampling_jitter_s": 0.0,
        "delay_s": 0.0,
        "delay_jitter_s": 0.0,
        "start_of_count": False,
    }
    for robot in world["robots"]:
        robot["robot"] = {**robot["robot"], "wheels": {**robot["robot"]["wheels"], "ticks_per_turn": 1e8}}
    return World.model_validate(world)


@pytest.mark.parametrize("render", [False, pytest.param(True, id="rendered")])
def test_the_same_seed_gives_the_same_bytes_whoever_else_drives(tmp_path: Path, render: bool) -> None:
    options: dict[str, Any] = {"render": render, "picture_rate_hz": 1.0 if render else None, "frame_rate_hz": 3.0}
    together = ["a", "b"] if render else None
    simulate("room", 3, tmp_path / "both", together, **options)
    simulate("room", 3, tmp_path / "alone", ["a"], **options)
    both, alone = digests(tmp_path / "both"), digests(tmp_path / "alone")
    assert "a/seed3/0000.core.mcap" in alone
    assert {name for name in alone if name.endswith(".mcap")} == {
        name for name in both if name.endswith(".mcap") and name.startswith("a/")
    }
    assert all(both[name] == digest for name, digest in alone.items() if name != "truth.json")
    truths = [json.loads((tmp_path / folder / "truth.json").read_text()) for folder in ("both", "alone")]
    assert truths[0]["runs"]["a_seed3"] == truths[1]["runs"]["a_seed3"]
    assert truths[0]["tags"] == truths[1]["tags"]


def test_another_seed_is_another_drive(tmp_path: Path) -> None:
    first = simulate("room", 0, tmp_path / "first", ["a"], render=False).runs["a_seed0"]
    second = simulate("room", 1, tmp_path / "second", ["a"], render=False).runs["a_seed1"]
    assert first.robot.wheels.radius_left_m != second.robot.wheels.radius_left_m
    assert first.stamps_ns[0] != second.stamps_ns[0]


def test_a_folder_that_is_not_empty_is_refused_and_left_alone(tmp_path: Path) -> None:
    (tmp_path / "kept.txt").write_text("mine")
    with pytest.raises(FixturesError, match="output folder is not empty"):
        simulate("room", 0, tmp_path, render=False)
    assert list(digests(tmp_path)) == ["kept.txt"]


def test_keeping_pictures_that_nobody_renders_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FixturesError, match="--picture-rate-hz is 2, but --no-render makes no pictures"):
        simulate("room", 0, tmp_path / "out", render=False, picture_rate_hz=2.0)
    assert not (tmp_path / "out").exists()


def test_a_terminal_shows_how_far_each_robot_is(tmp_path: Path) -> None:
    command = ["-m", "fixtures", "simulate", "--world", "room", "--robots", "a,c", "--no-render"]
    code, shown, printed = on_terminal(*command, "--output", tmp_path / "out")
    assert code == 0
    assert "recording a" in shown
    done, total = re.findall(r"recording c.* (\d+)/(\d+)", re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", shown))[-1]
    assert done == total != "0"
    assert "recording" not in printed


def test_nothing_is_left_behind_when_a_robot_cannot_drive(tmp_path: Path) -> None:
    world = load_world("room").model_dump()
    world["boxes"].append({"centre_m": [5.2, 2.6], "size_m": [0.3, 0.3, 0.2]})  # in the way of c, the last one
    world["robots"][2]["route"]["waypoints"][1]["x_m"] = 5.2
    world["robots"][2]["route"]["waypoints"][2]["x_m"] = 5.2
    with pytest.raises(FixturesError, match=r"robot c: comes within 0\.\d\d m of a wall or box at"):
        simulate(World.model_validate(world), 0, tmp_path / "new" / "folder", render=False)
    assert not (tmp_path / "new" / "folder").exists()
    (tmp_path / "empty").mkdir()
    with pytest.raises(FixturesError, match=r"no robot 'z'; use one of a, b, c"):
        simulate("room", 0, tmp_path / "empty", ["z"], render=False)
    assert (tmp_path / "empty").is_dir()
    assert list((tmp_path / "empty").iterdir()) == []


def test_an_exact_log_gives_back_the_truth(tmp_path: Path) -> None:
    truth = simulate(exact_world(), 5, tmp_path / "out", ["a"], render=False, exact_calibration=True)
    run, robot = truth.runs["a_seed5"], read_robot_yaml(tmp_path / "out" / "a" / "robot.yaml")
    readings = wheels_in(tmp_path / "out" / "a" / "seed5")
    stamps = np.array([reading.stamp_ns for reading in readings])
    ticks = np.array([[reading.ticks_left, reading.ticks_right] for reading in readings], dtype=np.float64)
    rolled = np.diff(ticks, axis=0) * robot.wheels.metres_per_tick
    pose, poses = run.T_world_base[0], [run.T_world_base[0]]
    for step in advance(rolled[:, 0], rolled[:, 1], robot.wheels.track_m):
        pose = se2.compose(pose, step)
        poses.append(pose)
    np.testing.assert_allclose(run.at(stamps)[::5], np.array(poses)[::5], atol=1e-6)


def test_detections_are_projections_of_the_true_corners(tmp_path: Path) -> None:
    truth = simulate(exact_world(), 6, tmp_path / "out", ["b"], render=False)  # calibration is drawn
    run = truth.runs["b_seed6"]
    mount, index = run.robot.mount.T_base_camera, {int(tag): row for row, tag in enumerate(truth.tags.tag_id)}
    camera = load_world("room").robot("b").camera
    assert camera is not None
    model = camera_model(camera, "b")
    seen = 0
    assert abs(run.robot.edge_shift_px) > 0.01
    for message in detections_in(tmp_path / "out" / "b" / "seed6"):
        x, y, theta = run.at(np.array(message.stamp_ns - round(run.robot.time_offset_s * 1e9)))
        turn = np.array([[np.cos(theta), -np.sin(theta), 0], [np.sin(theta), np.cos(theta), 0], [0, 0, 1]])
        for found in message.detections:
            in_base = (truth.tags.corners_m[index[found.tag_id]] - [x, y, 0.0]) @ turn
            expected = moved_out(model.project(mount.inv().apply(in_base)), run.robot.edge_shift_px)
            np.testing.assert_allclose(np.array(found.corners_px).reshape(4, 2), expected, atol=1e-3)
            seen += 1
    assert seen > 100


def test_a_floor_tilts_whole_pictures_and_a_rolling_shutter_takes_each_row_at_its_time(tmp_path: Path) -> None:
    """Three numbers a picture explain all its corners, each where the robot was when its row was read."""
    world, sigma_rad, sigma_m, readout_s = exact_world(), math.radians(0.3), 0.004, 0.02
    noise = world.noise.model_copy(update={"sigma_tilt_rad": sigma_rad, "sigma_height_m": sigma_m})
    robots = [each.model_copy(update={"robot": {**each.robot, "readout_s": readout_s}}) for each in world.robots]
    truth = simulate(
        world.model_copy(update={"noise": noise, "robots": robots}), 6, tmp_path / "out", ["b"], render=False
    )
    run, camera = truth.runs["b_seed6"], world.robot("b").camera
    assert camera is not None
    model, mount = camera_model(camera, "b"), run.robot.mount.T_base_camera
    corner_of = dict(zip(truth.tags.tag_id.tolist(), truth.tags.corners_m, strict=True))
    found = []
    for message in [each for each in detections_in(tmp_path / "out" / "b" / "seed6") if len(each.detections) > 1]:
        as_seen = np.array([each.corners_px for each in message.detections]).reshape(-1, 4, 2)
        pixels = moved_out(as_seen, -run.robot.edge_shift_px).reshape(-1, 2)
        points = np.concatenate([corner_of[each.tag_id] for each in message.detections])
        late_s = readout_s * (pixels[:, 1] / (model.height_px - 1) - 0.5) - run.robot.time_offset_s
        T_world_base = run.at(message.stamp_ns + np.rint(late_s * 1e9).astype(np.int64))
        turn = Rotation.from_euler("z", T_world_base[:, 2:])
        level = turn.inv().apply(points - np.column_stack([T_world_base[:, :2], np.zeros(len(points))]))

        def missed_px(sway: FloatArray, level: FloatArray = level, pixels: FloatArray = pixels) -> FloatArray:
            in_base = Rotation.from_rotvec([*sway[:2], 0.0]).inv().apply(level - [0.0, 0.0, sway[2]])
            return np.asarray((model.project(mount.inv().apply(in_base)) - pixels).ravel())

        solved = least_squares(missed_px, np.zeros(3))
        assert np.abs(solved.fun).max() < 5e-3
        found.append(solved.x)
    assert len(found) > 30
    spread = np.std(found, axis=0) / [sigma_rad, sigma_rad, sigma_m]
    np.testing.assert_allclose(spread, 1.0, atol=4.0 / np.sqrt(2 * len(found)))


def test_a_floor_that_tilts_is_not_rendered(tmp_path: Path) -> None:
    room = load_world("room")
    tilted = room.model_copy(update={"noise": room.noise.model_copy(update={"sigma_tilt_rad": 0.005})})
    with pytest.raises(FixturesError, match=r"sigma_tilt_rad is 0\.005 .* give --no-render"):
        simulate(tilted, 0, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_truth_holds_every_picture_and_twenty_poses_a_second(tmp_path: Path) -> None:
    simulate("room", 2, tmp_path / "out", ["c"], render=False, exact_calibration=True)
    truth = json.loads((tmp_path / "out" / "truth.json").read_text())
    stamps = np.array([pose[0] for pose in truth["runs"]["c_seed2"]["poses"]])
    assert np.diff(stamps).min() > 0
    assert np.diff(stamps).max() < 52_000_000
    pictures = [message.stamp_ns for message in detections_in(tmp_path / "out" / "c" / "seed2")]
    assert np.abs(stamps[np.searchsorted(stamps, pictures)] - pictures).max() <= 1
    wheels = [message.stamp_ns for message in wheels_in(tmp_path / "out" / "c" / "seed2")]
    assert abs(stamps[0] - wheels[0]) < 1_000_000
    assert len(truth["tags"]) == 8
    assert set(truth["tags"][0]) >= {"family", "tag_id", "position_m", "quaternion_xyzw", "size_m"}


def test_wheel_stamps_are_true_whatever_the_clocks_do(tmp_path: Path) -> None:
    truth = simulate("room", 4, tmp_path / "out", ["c"], render=False, exact_calibration=True)
    run, robot = truth.runs["c_seed4"], truth.runs["c_seed4"].robot
    readings = wheels_in(tmp_path / "out" / "c" / "seed4")
    stamps = np.array([reading.stamp_ns for reading in readings])
    assert np.diff(stamps).min() > 0
    assert np.std(np.diff(stamps)) < 300_000  # arrivals jitter by more
    turned = (readings[-1].ticks_left - readings[0].ticks_left) * robot.wheels.metres_per_tick[0]
    assert turned == pytest.approx(run.distance_m, abs=1.5)


def test_calibration_is_drawn_from_the_priors() -> None:
    world = load_world("room")
    nominal = nominal_robot(world, world.robots[0])
    drawn = [true_robot(nominal, seed, exact=False) for seed in range(400)]
    for section, name in (("wheels", "radius_left_m"), ("wheels", "radius_right_m"), ("mount", "yaw_rad")):
        values = np.array([getattr(getattr(robot, section), name) for robot in drawn])
        sigma = getattr(getattr(nominal, section), f"{name}_sigma")
        scaled = (values - getattr(getattr(nominal, section), name)) / sigma
        assert abs(scaled.mean()) < 0.2, name
        assert 0.88 < scaled.std() < 1.12, name
    left, right = ([getattr(robot.wheels, f"radius_{side}_m") for robot in drawn] for side in ("left", "right"))
    assert abs(np.corrcoef(left, right)[0, 1]) < 0.2
    sizes = np.array([true_tag_sizes_m(world, seed, exact=False) for seed in range(400)])
    assert np.ptp(sizes, axis=1).max() < 1e-12  # one scale for the batch
    assert 0.88 < (sizes[:, 0] / 0.15 - 1.0).std() / 0.005 < 1.12
    assert (true_tag_sizes_m(world, 0, exact=True) == 0.15).all()
    assert true_robot(nominal, 0, exact=True) == nominal
