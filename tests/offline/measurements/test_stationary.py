"""A robot that stands, and one whose controller restarts: neither may make sigmas too small."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

from groundsbot.fixtures.simulate import TRUTH_FILE, simulate
from groundsbot.fixtures.worlds.world import World
from groundsbot.offline.evaluation.against_truth import evaluate
from groundsbot.offline.evaluation.truth import read_truth
from groundsbot.offline.mapping.inputs import read_runs
from groundsbot.offline.mapping.pipeline import build_map
from groundsbot.offline.maps.result import Component
from groundsbot.offline.measurements.run import load_run
from groundsbot.onboard.log.reading.reader import find_logs
from tests.support.data.drives import MadeDrive, MadeTag, make_drive, make_robot, write_drive

HALL = [
    MadeTag(0, (6.0, 1.0, 0.5), np.pi),
    MadeTag(1, (6.0, 3.0, 0.4), np.pi + 0.2),
    MadeTag(2, (0.0, 1.2, 0.45), 0.1),
    MadeTag(3, (0.0, 2.9, 0.6), -0.1),
    MadeTag(4, (2.0, 0.0, 0.4), np.pi / 2),
    MadeTag(5, (4.5, 0.0, 0.5), np.pi / 2),
    MadeTag(6, (1.8, 4.0, 0.45), -np.pi / 2),
    MadeTag(7, (4.3, 4.0, 0.35), -np.pi / 2),
]
BEFORE = [(0.3, 0.3, 4.0), (0.2, 0.4, 8.0), (-0.2, 0.2, 4.0)]
MEANWHILE = [(0.15, 0.35, 20.0)]  # 5 m
AFTER = [(0.3, 0.3, 3.0), (0.4, 0.2, 8.0), (-0.2, 0.2, 5.0)]


def past_five_tags(stop_s: float) -> World:
    """A drive of 2.4 m towards five tags on a wall, with a stop on the way."""
    return World.model_validate(
        {
            "name": "stop",
            "ceiling_height_m": 2.6,
            "walls": [{"line_m": [[0.0, 0.0], [6.0, 0.0], [6.0, 4.0], [0.0, 4.0], [0.0, 0.0]], "brightness": 0.6}],
            "tags": [
                {"tag_id": i, "position_m": [5.998, 0.6 + 0.7 * i, 0.4], "yaw_deg": 180.0, "size_m": 0.15}
                for i in range(5)
            ],
            "robots": [
                {
                    "id": "a",
                    "robot": {
                        "wheels": {"radius_left_m": 0.1, "radius_right_m": 0.1, "track_m": 0.4, "ticks_per_turn": 4096},
                        "mount": {"x_m": 0.1, "z_m": 0.4},
                        "tags": [{"family": "tag36h11", "default_size_m": 0.15}],
                    },
                    "camera": {
                        "width_px": 640,
                        "height_px": 480,
                        "fx_px": 500,
                        "fy_px": 500,
                        "cx_px": 322,
                        "cy_px": 238,
                    },
                    "route": {
                        "start": {"x_m": 1.0, "y_m": 2.0, "yaw_deg": 0.0},
                        "speed_m_s": 0.5,
                        "waypoints": [{"x_m": 2.3, "y_m": 2.1, "stop_s": stop_s}, {"x_m": 3.4, "y_m": 1.9}],
                    },
                }
            ],
        }
    )


def stop(folder: Path, stop_s: float) -> tuple[Component, float]:
    """The map of a rendered drive, and its tags NEES per dimension."""
    simulate(past_five_tags(stop_s), 1, folder, frame_rate_hz=2.0)
    result = build_map(read_runs(find_logs([folder])))
    (component,) = result.components
    nees = evaluate(result, read_truth(folder / TRUTH_FILE)).components[0].nees_tags_per_dim
    assert nees is not None
    return component, nees


def test_a_stop_of_a_minute_makes_no_sigma_smaller(tmp_path: Path) -> None:
    """More than a hundred pictures from one place repeat one error as often."""
    short, _ = stop(tmp_path / "short", 1.0)
    long, nees = stop(tmp_path / "long", 60.0)
    assert [tag.tag_id for tag in short.tags] == [tag.tag_id for tag in long.tags] == [0, 1, 2, 3, 4]
    sigmas = [np.sqrt([np.diag(tag.covariance) for tag in each.tags]) for each in (short, long)]
    np.testing.assert_allclose(sigmas[1], sigmas[0], rtol=0.1)
    lowest, highest = (chi2(10).ppf(quantile) / 10 for quantile in (0.0005, 0.9995))
    assert lowest < nees < highest


def test_a_controller_reset_of_twenty_seconds_gives_the_map_of_two_runs(tmp_path: Path) -> None:
    """Five metres of which nothing is known: a segment joined by tags, and the map that two logs would have given."""
    drive = make_drive([1.5, 1.5, 0.3], [*BEFORE, *MEANWHILE, *AFTER])
    n_before, n_meanwhile = (round(100 * sum(leg[2] for leg in legs)) for legs in (BEFORE, MEANWHILE))
    kept = np.r_[0:n_before, n_before + n_meanwhile : len(drive.stamps_ns)]
    cut = MadeDrive(drive.stamps_ns[kept], drive.left_m[kept], drive.right_m[kept], drive.T_world_base[kept])
    boots = np.where(kept < n_before, 1, 2).tolist()
    log = write_drive(tmp_path, cut, HALL, make_robot("a"), boot_of=boots, corner_sigma_px=0.2)
    run = load_run(log)
    assert len(run.wheel_segments) == 2
    one = build_map([run])
    apart = [replace(run, name=f"a_{i}", run_id=str(i), wheel_segments=(run.wheel_segments[i],)) for i in (0, 1)]
    (as_stretches,), (as_runs,) = one.components, build_map(apart).components
    assert [each.name for each in as_stretches.runs] == ["a_one", "a_one_stretch2"]
    assert any("restarted 1 time" in warning for warning in one.warnings)
    assert len(as_stretches.tags) == len(as_runs.tags) >= 6
    for a, b in zip(as_stretches.tags, as_runs.tags, strict=True):
        np.testing.assert_allclose(a.position_m, b.position_m, atol=1e-6)
        np.testing.assert_allclose(a.covariance, b.covariance, rtol=1e-4, atol=1e-9)
    gap_m = as_stretches.start_to_start[0]
    true_m = float(np.linalg.norm(np.diff(cut.T_world_base[[0, n_before], :2], axis=0)))
    assert gap_m.distance_m == pytest.approx(true_m, abs=4.0 * gap_m.sigma_m)
