"""A fisheye (equidistant) all the way: rendered, detected, mapped, with errors as large as the covariances say."""

import json
from pathlib import Path

from scipy.stats import chi2

from groundsbot.fixtures.simulate import simulate
from groundsbot.fixtures.worlds.world import load_world
from tests.support.programs import Run

FISHEYE = {
    "width_px": 640, "height_px": 480, "fx_px": 260.0, "fy_px": 260.5, "cx_px": 322.0, "cy_px": 237.0,
    "distortion_model": "equidistant", "distortion": [0.02, -0.005, 0.001, 0.0],
}  # fmt: skip


def test_a_drive_with_a_fisheye_is_mapped_within_its_sigmas(run: Run, tmp_path: Path) -> None:
    room = load_world("room")
    camera = type(room.robots[0].camera).model_validate(FISHEYE)  # type: ignore[union-attr]
    robot = room.robots[0].model_copy(update={"camera": camera})
    world = room.model_copy(update={"robots": [robot]})
    simulate(world, 3, tmp_path / "drive", render=True, frame_rate_hz=3.0)
    outcome = run("map", tmp_path / "drive", "-o", tmp_path / "map")
    assert outcome.code == 0, outcome.err
    outcome = run("compare", tmp_path / "map", "--truth", tmp_path / "drive" / "truth.json", "--json")
    figures = json.loads(outcome.out)
    tags = json.loads((tmp_path / "map" / "map.json").read_text())["tags"]
    assert len(tags) >= 5
    degrees = 2 * len(tags)
    assert figures["nees_tags_per_dim"] < chi2.ppf(0.999, degrees) / degrees
    assert figures["tags_rmse_m"] < 0.2
