"""Tags known to be upright: smaller, consistent covariances, and a leaning one is named."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from groundsbot.calib.geometry import se2
from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.offline.corners.factors import SpatialColumns, SpatialState
from groundsbot.offline.corners.upright_prior import UprightFactors
from groundsbot.offline.mapping.pipeline import build_map
from groundsbot.offline.maps.model import MapModel
from groundsbot.offline.maps.result import MapResult
from groundsbot.offline.measurements.run import Run, load_run
from tests.offline.global_map.test_tag_joins import seeing
from tests.support.data.drives import HALL, MadeTag, make_drive, make_robot, write_drive
from tests.support.programs import Run as Program

START = [1.0, 1.5, 0.3]
# 3 is rolled, 0 and 1 are seen squarely from afar, so that a few pictures allow two poses; 5 is upside down.
TAGS = [tag for tag in HALL if tag.tag_id not in (0, 1, 3)]
SIGMA_RAD = float(np.radians(0.2))
FEW = {tag.tag_id: 3 for tag in TAGS}


@pytest.fixture(scope="module")
def run_past(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Three looks at each tag, none quite upright."""
    rng = np.random.default_rng(2)
    mounted = [
        replace(tag, pitch_rad=rng.normal() * SIGMA_RAD, roll_rad=tag.roll_rad + rng.normal() * SIGMA_RAD)
        for tag in TAGS
    ]
    drive = make_drive(START, [(0.4, 0.4, 2.0), (0.5, 0.3, 2.0), (-0.3, 0.3, 5.0)])
    log = write_drive(tmp_path_factory.mktemp("drive"), drive, mounted, make_robot("a"), corner_sigma_px=0.2)
    run = load_run(log)
    return seeing(run, *FEW, looks=FEW)


def turn_of(tag: MadeTag) -> Rotation:
    """R_world_tag."""
    top_left, top_right, bottom_right, _ = tag.corners_m()
    x, y = top_right - top_left, top_right - bottom_right
    axes = np.stack([x, y, np.cross(x, y) / np.linalg.norm(x)], axis=1)
    return Rotation.from_matrix(axes / np.linalg.norm(axes, axis=0))


def test_upright_tags_have_smaller_and_consistent_covariances(run_past: Run) -> None:
    free = build_map([run_past], NoiseParameters(), corners=True)
    held = build_map([run_past], NoiseParameters(), corners=True, upright_sigma_rad=SIGMA_RAD)
    assert held.components[0].model is MapModel.CORNERS
    assert not any("upright" in warning for warning in held.warnings)
    sharper = []
    for before, after in zip(free.components[0].tags, held.components[0].tags, strict=True):
        assert before.pose is not None
        assert after.pose is not None
        sharper.append(np.linalg.slogdet(before.pose.covariance)[1] - np.linalg.slogdet(after.pose.covariance)[1])
        # The worst that a face leans or rolls is what was said, or what looks say.
        assert np.linalg.eigvalsh(after.pose.covariance[3:5, 3:5]).max() < 1.01 * SIGMA_RAD**2
    assert min(sharper) > 0.0
    assert np.mean(sharper) > 2.0 * np.log(2.0)  # each of two tilts twice as well known
    assert_honest(held)


def assert_honest(result: MapResult) -> None:
    made = {tag.tag_id: tag for tag in TAGS}
    for tag in result.components[0].tags:
        assert tag.pose is not None
        true = made[tag.tag_id]
        place = se2.apply(se2.inverse(START), np.array(true.position_m[:2]))
        turn = Rotation.from_euler("z", -START[2]) * turn_of(true)
        off = (Rotation.from_quat(tag.pose.quaternion_xyzw) * turn.inv()).as_rotvec()
        error = np.concatenate([tag.position_m - place, [tag.pose.height_m - true.position_m[2]], off])
        # The world's tags lean by a sigma of their own beside those of the list.
        covariance = tag.pose.covariance + np.diag([0, 0, 0, 1, 1, 1]) * SIGMA_RAD**2
        assert error @ np.linalg.solve(covariance, error) < chi2.isf(1e-4, 6)


def test_a_tag_that_leans_is_named(tmp_path: Path) -> None:
    leaning = [replace(tag, pitch_rad=0.2 * (tag.tag_id == 4)) for tag in TAGS]
    drive = make_drive(START, [(0.4, 0.4, 2.0), (0.5, 0.3, 2.0), (-0.3, 0.3, 5.0)])
    run = load_run(write_drive(tmp_path, drive, leaning, make_robot("a"), corner_sigma_px=0.2))
    result = build_map([run], NoiseParameters(), corners=True, upright_sigma_rad=SIGMA_RAD)
    said = [warning for warning in result.warnings if "--upright-deg" in warning]
    assert len(said) == 1
    assert "tag 4 is not mounted upright to 0.2 deg" in said[0]


@pytest.mark.parametrize("roll_rad", [0.1, 1.5, -1.6, 3.0])
def test_derivatives(roll_rad: float) -> None:
    turns = Rotation.from_euler("ZYZ", [[0.3, -1.4, roll_rad], [2.0, -1.7, roll_rad]]).as_matrix()
    state = SpatialState(np.zeros((1, 3)), np.zeros((2, 2)), np.zeros(1), np.zeros(2), turns)
    none = np.zeros((0, 3), dtype=np.int64)
    columns = SpatialColumns(none, none, none[0:0, 0], 6, none[0:0, 0], np.arange(6).reshape(2, 3))
    factors = UprightFactors(np.array([0, 1]), 0.01)
    ((own, jacobian),) = factors.linearise(state, columns).blocks
    np.testing.assert_array_equal(own, columns.turns)
    for i in range(3):
        step = np.zeros((2, 3))
        step[:, i] = 1e-6
        ahead, behind = (
            factors.residual(replace(state, turns=turns @ Rotation.from_rotvec(sign * step).as_matrix()))
            for sign in (1.0, -1.0)
        )
        np.testing.assert_allclose((ahead - behind) / 2e-6, jacobian[:, :, i], atol=1e-4)


def test_what_cannot_be_held_upright_is_refused(run: Program, run_past: Run, tmp_path: Path) -> None:
    floor = run("map", run_past.log, "-o", tmp_path / "map", "--upright-deg", "0.3")
    assert floor.code == 1
    assert "give --model corners too, or leave it out" in floor.err
    wide = run("map", run_past.log, "-o", tmp_path / "map", "--model", "corners", "--upright-deg", "30")
    assert wide.code == 1
    assert "must be from 0.01 to 10" in wide.err
    assert not (tmp_path / "map").exists()
