"""Observations from a floor that tilts the robot a little in each picture, and from shutters that roll meanwhile."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from groundsbot.calib.foundation.arrays import FloatArray, IntArray
from groundsbot.calib.geometry import se2
from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.fixtures.worlds.world import load_world
from groundsbot.offline.mapping.pipeline import build_map
from groundsbot.offline.measurements.sensor_model.floor_tilt import floor_tilt_rad, inflate_by_tilt, observation_by_tilt
from groundsbot.offline.measurements.sensor_model.rolling_shutter import read_at_once
from groundsbot.offline.measurements.sensor_model.sensor_model import read_detections
from groundsbot.offline.measurements.sensor_model.tag_pose import TagMeasurements, upright_observations
from groundsbot.offline.measurements.tags import Detections, TagKey
from tests.benchmarks.accuracy.against_bound import rough
from tests.support.data.drives import CAMERA, FAMILY, MadeTag, make_drive, make_robot, make_run, seen_corners_px
from tests.support.data.simulated_runs import simulated_runs

ROBOT = make_robot(mount={"x_m": 0.2, "y_m": 0.05, "z_m": 0.4})
TAGS = [MadeTag(i, (3.0, 0.5 * i - 0.8, 0.35 + 0.05 * i), np.pi + 0.2 * i) for i in range(4)]
SIGMA_PX = 0.2
N = 80
TILT_RAD = np.radians(0.3)


def tilted_corners_px(tag: MadeTag, pose: FloatArray, tilt_rad: FloatArray) -> FloatArray:
    """(4, 2) exact corners from a base that rolls and pitches by so much."""
    stands = Rotation.from_euler("z", pose[2]) * Rotation.from_rotvec(np.append(tilt_rad, 0.0))
    in_base = (tag.corners_m() - [*pose[:2], 0.0]) @ stands.as_matrix()
    return np.asarray(CAMERA.project(ROBOT.mount.T_base_camera.inv().apply(in_base)))


def driven_past(tilt_rad: float, seed: int) -> tuple[FloatArray, IntArray, IntArray]:
    """Noisy corners (M, 4, 2) of the tags from N poses two centimetres apart, with their tags and keyframes."""
    rng = np.random.default_rng(seed)
    stood = tilt_rad * rng.standard_normal((N, 2))
    poses = np.column_stack([0.02 * np.arange(N), np.zeros(N), np.zeros(N)])
    corners_px = np.array([[tilted_corners_px(tag, *at) for tag in TAGS] for at in zip(poses, stood, strict=True)])
    corners_px += SIGMA_PX * rng.standard_normal(corners_px.shape)
    return corners_px.reshape(-1, 4, 2), np.tile(np.arange(len(TAGS)), N), np.repeat(np.arange(N), len(TAGS))


def read(corners_px: FloatArray) -> TagMeasurements:
    rotation = ROBOT.mount.T_base_camera.rotation.as_matrix()
    n = len(corners_px)
    return upright_observations(corners_px, np.full(n, 0.15), CAMERA, rotation, np.full(n, SIGMA_PX))


@pytest.mark.parametrize("seed", range(5))
def test_the_tilt_of_a_floor_shows_in_the_heights_of_tags(seed: int) -> None:
    """Eighty pictures determine a sigma to a tenth, by a median to an eighth; the bound is three times that."""
    for tilt_rad in (TILT_RAD, 3.0 * TILT_RAD):
        corners_px, tag, keyframe = driven_past(tilt_rad, seed)
        found = floor_tilt_rad(read(corners_px), tag, keyframe, np.array([0.2, 0.05]), 1.0)
        assert found == pytest.approx(tilt_rad, rel=0.35)
    corners_px, tag, keyframe = driven_past(0.0, seed)
    assert floor_tilt_rad(read(corners_px), tag, keyframe, np.array([0.2, 0.05]), 1.0) == 0.0


def test_derivatives_of_observations_by_the_tilt() -> None:
    level, step = np.zeros(2), 1e-5
    exact = read(np.array([tilted_corners_px(tag, np.zeros(3), level) for tag in TAGS]))
    by_tilt = observation_by_tilt(exact, 0.4)
    for axis, tilt in enumerate(step * np.eye(2)):
        there, back = (
            read(np.array([tilted_corners_px(tag, np.zeros(3), each) for tag in TAGS])).range_bearing
            for each in (tilt, -tilt)
        )
        np.testing.assert_allclose(by_tilt[..., axis], (there - back) / (2.0 * step), rtol=1e-3, atol=2e-3)


def test_a_floor_that_tilts_leaves_no_more_over_than_its_sigma_says() -> None:
    """Near tags, by their shape: two degrees of freedom an observation, which pictures share among their four tags."""
    corners_px, _, _ = driven_past(3.0 * TILT_RAD, 3)
    near = read(corners_px[-20 * len(TAGS) :])
    assert near.chi2.mean() > 3.5
    assert inflate_by_tilt(near, 3.0 * TILT_RAD).chi2.mean() == pytest.approx(2.0, abs=0.8)


def test_a_floor_that_tilts_widens_observations_and_makes_no_tag_tilted() -> None:
    run = make_run([make_drive([0.0, 0.0, 0.0], [(0.0, 0.0, 1.0)]).track], robot=ROBOT, tags=_keys())
    covariances = []
    for tilt_rad in (0.0, TILT_RAD):
        corners_px, tag, keyframe = driven_past(tilt_rad, 1)
        detections = Detections(keyframe.astype(np.int64), tag, corners_px, np.zeros(len(tag), dtype=np.int64))
        observations, warnings = read_detections(run, detections, keyframe, np.zeros((N, 3)), NoiseParameters())
        assert warnings == []
        covariances.append(observations.covariance)
        np.testing.assert_allclose(observations.parts.under(NoiseParameters()), observations.covariance, rtol=1e-9)
    # The camera sways by 2 mm, which is 0.7 mrad of bearing to a tag three metres away; its corners determine 0.1 mrad.
    assert np.median(covariances[1][:, 1, 1]) > 9.0 * np.median(covariances[0][:, 1, 1])


@pytest.mark.parametrize("twist", [(0.5, 0.0, 0.0), (0.3, -0.2, 0.6), (0.0, 0.0, -1.0)])
def test_rows_that_are_read_late_are_put_back_where_they_were(twist: tuple[float, float, float]) -> None:
    robot = make_robot(mount=ROBOT.mount.model_dump(), readout_s=0.03)
    tags = [MadeTag(i, (3.0, 0.5 * i - 0.8, 0.4 * i - 0.4), np.pi + 0.2 * i) for i in range(4)]  # in all rows
    still = np.array([seen_corners_px(tag, np.zeros(3), robot, CAMERA) for tag in tags])
    rolled = still.copy()
    for _ in range(4):
        late_s = 0.03 * (rolled[..., 1] / (CAMERA.height_px - 1) - 0.5)
        for i, tag in enumerate(tags):
            for corner in range(4):
                pose = se2.exp(late_s[i, corner] * np.array(twist))
                rolled[i, corner] = np.asarray(seen_corners_px(tag, pose, robot, CAMERA))[corner]
    twists = np.tile(twist, (len(TAGS), 1))
    put_back = read_at_once(robot, CAMERA, rolled, np.full(len(TAGS), 0.15), twists)
    moved = np.abs(rolled - still).max()
    assert moved > 0.3
    np.testing.assert_allclose(put_back, still, atol=0.1 * moved)
    np.testing.assert_array_equal(read_at_once(ROBOT, CAMERA, rolled, np.full(len(TAGS), 0.15), twists), rolled)


def test_the_noise_of_wheels_is_not_larger_on_an_uneven_floor() -> None:
    """Each sigma within what the fit itself gives for 99 %, and 10 %: some were twice as large, by a sway of 2 mm."""
    world = rough(load_world("room"))
    result = build_map(simulated_runs(world, 1000)[0])
    assert not any("upright" in each for each in result.warnings)
    assert result.noise_fit is not None
    for each in result.noise_fit.parameters:
        true = getattr(world.noise, each.name, None)
        if true is not None and each.low is not None and each.high is not None:
            assert 0.9 * each.low < true < 1.1 * each.high, each


def _keys() -> list[TagKey]:
    return [TagKey(FAMILY, tag.tag_id) for tag in TAGS]
