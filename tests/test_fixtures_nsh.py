"""World nsh against the recordings that it follows. docs/worlds.md holds the figures."""

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.fixtures.drives.calibration import nominal_robot, true_tag_sizes_m
from groundsbot.fixtures.pictures.render import Renderer
from groundsbot.fixtures.pictures.visibility import sightings
from groundsbot.fixtures.recording.session import Options, Picture, Session, prepare
from groundsbot.fixtures.worlds.scene import tags_of
from groundsbot.fixtures.worlds.world import World, load_world
from groundsbot.onboard.detection.tag_detector import TagDetector

SEEDS = range(3)
ROBOTS = ("hallway", "loop")


@cache
def world() -> World:
    return load_world("nsh")


@cache
def driven(robot: str, seed: int) -> Session:
    tags = tags_of(world().tags, true_tag_sizes_m(world(), seed, exact=False))
    return prepare(world(), world().robot(robot), tags, Options(seed))


@dataclass(frozen=True)
class Seen:
    """What the pictures of a run show, without rendering."""

    tags: frozenset[int]
    ranges_m: FloatArray
    n_tags: FloatArray  # in each picture
    T_world_base: FloatArray  # at each picture


@cache
def seen(robot: str, seed: int) -> Seen:
    session = driven(robot, seed)
    eye = session.eye
    assert eye is not None
    middles = np.array([picture.middle_ns for picture in session.pictures()])
    found = sightings(world(), session.tags, session.faces, eye, session.drive, middles, np.random.default_rng(seed))
    poses = session.drive.at(middles)
    ranges = np.linalg.norm(session.tags.centre_m[found.tag, :2] - poses[found.picture, :2], axis=1)
    counts = np.bincount(found.picture, minlength=len(middles))
    return Seen(frozenset(session.tags.tag_id[found.tag].tolist()), ranges, counts.astype(np.float64), poses)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("robot", ROBOTS)
def test_a_run_resembles_its_recording(robot: str, seed: int) -> None:
    run = seen(robot, seed)
    assert 24 <= len(run.tags) <= 32
    assert 3.0 <= np.median(run.ranges_m) <= 5.0
    assert run.ranges_m.max() < 10.3
    steps = np.hypot(*np.diff(run.T_world_base[:, :2], axis=0).T)
    driven_m = np.concatenate([[0.0], np.cumsum(steps)])
    keyframes = np.unique(np.searchsorted(driven_m, np.arange(0.0, driven_m[-1], 0.25)))
    assert 0.40 <= (run.n_tags == 0).mean() <= 0.50
    assert 0.40 <= (run.n_tags[keyframes] == 0).mean() <= 0.50


@pytest.mark.parametrize("seed", SEEDS)
def test_the_two_runs_share_as_many_tags_as_the_recordings(seed: int) -> None:
    assert 10 <= len(seen("hallway", seed).tags & seen("loop", seed).tags) <= 14


def test_the_runs_start_where_the_tape_measure_says_and_stop_for_ten_seconds() -> None:
    starts = [driven(robot, 0).drive.T_world_base[0, :2] for robot in ROBOTS]
    assert math.dist(*starts) == pytest.approx(38.05, abs=1e-9)
    for robot in ROBOTS:
        drive = driven(robot, 0).drive
        still = np.all(np.diff(drive.T_world_base, axis=0) == 0.0, axis=1)
        edges = np.flatnonzero(np.diff(np.concatenate([[0], still.astype(int), [0]])))
        longest = np.diff(edges.reshape(-1, 2), axis=1).max() * 0.01
        assert longest == pytest.approx(10.0, abs=0.3)


def test_the_floor_and_the_robot_are_those_of_the_paper() -> None:
    assert len({tag.tag_id for tag in world().tags}) == 50
    assert {(tag.family, tag.size_m) for tag in world().tags} == {("tag36h11", 0.15)}
    # Along the corridors: the loop's and the hallway's middle lines run along x and y.
    along = 0
    for tag in world().tags:
        corridor_deg = 0.0 if abs(tag.position_m[1]) < 1.3 or abs(tag.position_m[1] - 20) < 1.3 else 90.0
        along += abs(math.cos(math.radians(tag.yaw_deg - corridor_deg))) > 0.9
    assert along >= 40
    noise, pictures = world().noise, world().pictures
    assert noise.sigma_distance_m_per_sqrt_m == 0.01
    assert noise.sigma_heading_rad_per_sqrt_m == pytest.approx(math.radians(0.6))
    assert noise.sigma_heading_rad_per_sqrt_rad == 0.02
    assert (pictures.rate_hz, pictures.exposure_s) == (15.0, 0.008)
    for robot in world().robots:
        nominal = nominal_robot(world(), robot)
        wheels, camera = nominal.wheels, robot.camera
        assert wheels.radius_left_m_sigma / wheels.radius_left_m == pytest.approx(0.005)
        assert wheels.radius_right_m_sigma / wheels.radius_right_m == pytest.approx(0.005)
        assert wheels.track_m_sigma / wheels.track_m == pytest.approx(0.01)
        assert nominal.mount.yaw_rad_sigma == pytest.approx(math.radians(0.5), rel=1e-3)
        assert camera is not None
        assert (camera.width_px, camera.height_px) == (1280, 720)
        assert camera.fx_px == pytest.approx(900.0, rel=0.01)
        assert any(camera.distortion)


@pytest.mark.parametrize("robot", ROBOTS)
def test_rendered_pictures_show_the_tags_that_are_reported_without_rendering(robot: str) -> None:
    session = driven(robot, 0)
    eye = session.eye
    assert eye is not None
    pictures: list[Picture] = session.pictures()[7::20]
    middles = np.array([picture.middle_ns for picture in pictures])
    projected = sightings(world(), session.tags, session.faces, eye, session.drive, middles, np.random.default_rng(0))
    expected = {
        (picture, int(session.tags.tag_id[tag])): corners
        for picture, tag, corners in zip(
            projected.picture.tolist(), projected.tag.tolist(), projected.corners_px, strict=True
        )
    }
    renderer = Renderer(world().pictures, world().ceiling_height_m, session.tags, session.faces, eye)
    detector = TagDetector()
    found = {
        (index, each.tag_id): each.corners_px
        for index, picture in enumerate(pictures)
        for each in detector.detect(renderer.picture(session.drive, picture.middle_ns, np.random.default_rng(index)))
    }
    both = found.keys() & expected.keys()
    assert len(expected) >= 70
    assert len(both) >= 0.9 * len(expected)
    assert len(both) >= 0.9 * len(found)
    errors = np.array([found[key] - expected[key] for key in both])
    assert np.median(np.abs(errors)) < 0.3
