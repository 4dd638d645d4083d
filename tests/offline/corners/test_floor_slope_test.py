"""A ramp is found and said, with time, place and size; floors that are level, or rough all over, raise no word."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.fixtures.worlds.world import load_world
from groundsbot.offline.commands.map_drives import as_json
from groundsbot.offline.commands.map_summary import summary
from groundsbot.offline.mapping.pipeline import build_map
from groundsbot.offline.measurements.run import Run, load_run
from tests.support.data.drives import HALL, MadeTag, S, make_drive, make_robot, write_drive
from tests.support.data.simulated_runs import simulated_runs

WORD = "is not level with the rest"
ROUND = [(0.4, 0.4, 2.0), (0.5, 0.3, 2.0), (-0.3, 0.3, 5.0), (0.4, 0.4, 6.0), (-0.3, 0.3, 6.0), (0.4, 0.4, 5.0)]
RAMP_S = (9.0, 16.0)


def ramp_run(folder: Path, pitch_deg: float, height_m: float, tilt_deg: float) -> Run:
    """A drive in the hall of which seven seconds are on a ramp, every picture tilted at random besides."""
    drive, robot = make_drive([1.0, 1.5, 0.3], ROUND), make_robot("a")
    run = load_run(write_drive(folder, drive, HALL, robot))
    camera = run.camera
    assert camera is not None
    eye, rng, found = robot.mount.T_base_camera, np.random.default_rng(3), run.detections
    corners_px = found.corners_px.copy()
    for stamp_ns in np.unique(found.stamps_ns):
        on_ramp = RAMP_S[0] < (stamp_ns - run.wheel_segments[0].stamps_ns[0]) / S < RAMP_S[1]
        tilt = np.radians(tilt_deg) * rng.standard_normal(2) + np.radians([0.0, pitch_deg * on_ramp])
        pose = drive.at(np.array([stamp_ns]))[0]
        for i in np.flatnonzero(found.stamps_ns == stamp_ns):
            tag = HALL[run.tags[found.tag[i]].tag_id]
            in_base = tilt_view(in_level_base(tag, pose), tilt, height_m * on_ramp)
            corners_px[i] = camera.project(eye.inv().apply(in_base)) + 0.2 * rng.standard_normal((4, 2))
    seen = np.asarray(np.isfinite(corners_px).all((1, 2)))
    return replace(run, detections=replace(found.where(seen), corners_px=corners_px[seen]))


def in_level_base(tag: MadeTag, pose: FloatArray) -> FloatArray:
    corners: FloatArray = (tag.corners_m() - [pose[0], pose[1], 0.0]) @ Rotation.from_euler("z", pose[2]).as_matrix()
    return corners


def tilt_view(points: FloatArray, tilt: FloatArray, height_m: float) -> FloatArray:
    """As seen from a base that rolls and pitches and stands higher."""
    turned: FloatArray = (points - [0.0, 0.0, height_m]) @ Rotation.from_euler("xy", tilt).as_matrix()
    return turned


@pytest.mark.parametrize("tilt_deg", [0.0, 0.3])
def test_a_ramp_is_reported_with_time_place_and_size(tilt_deg: float, tmp_path: Path) -> None:
    result = build_map([ramp_run(tmp_path, 4.0, 0.08, tilt_deg)], corners=True)
    said = [warning for warning in result.warnings if WORD in warning]
    assert said, result.warnings
    begin, end = (int(word) for word in said[0].split("from ")[1].split(" s,")[0].split(" to "))
    assert begin >= RAMP_S[0] - 4.0
    assert end <= RAMP_S[1] + 4.0
    pitch_deg = float(said[0].split("pitch ")[1].split(" deg")[0])
    assert 2.0 < pitch_deg < 6.0
    floor = result.components[0].floor
    assert floor is not None
    told = json.loads(as_json(result))
    assert told["components"][0]["floor"] == {
        name: told["noise"][name] for name in ("sigma_tilt_rad", "sigma_height_m")
    }
    assert told["noise"]["sigma_tilt_rad"] == floor.sigma_tilt_rad > 0.0
    assert any(line.startswith("floor: roll and pitch vary by") for line in summary(result, tmp_path))


@pytest.mark.parametrize("tilt_deg", [0.0, 0.3])
def test_a_floor_that_is_level_in_the_mean_raises_no_word(tilt_deg: float) -> None:
    world = load_world("room")
    rough = world.noise.model_copy(update={"sigma_tilt_rad": float(np.radians(tilt_deg))})
    runs, _ = simulated_runs(world.model_copy(update={"noise": rough}), 61)
    result = build_map(runs, corners=True)
    assert not [warning for warning in result.warnings if WORD in warning]
