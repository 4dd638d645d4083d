"""A gap between wheel readings in a curve is told as what it is, and the map goes on across it."""

from pathlib import Path

import numpy as np
import pytest

from groundsbot.calib.geometry import se2
from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.offline.mapping.inputs import read_runs
from groundsbot.offline.mapping.pipeline import build_map
from groundsbot.offline.measurements.keyframes import candidate_stamps
from groundsbot.offline.measurements.motion_model.motion_model import compose_odometry
from groundsbot.offline.measurements.run import load_run
from groundsbot.onboard.log.messages import WheelEncoders
from tests.support.data.drives import HALL, START_NS, S, make_drive, make_robot, write_drive
from tests.support.data.map_cases import rewritten

# Ahead, then round on the spot and ahead again: no arc between the readings before and after is near this path.
LEGS = [
    (0.4, 0.4, 3.0), (0.5, 0.3, 4.0), (-0.2, 0.2, 5.0), (0.4, 0.4, 2.5), (-0.3, 0.3, 2.6), (0.4, 0.4, 1.0),
    (0.2, -0.2, 8.0), (0.4, 0.3, 4.0), (0.3, 0.3, 2.0), (-0.2, 0.2, 8.0),
]  # fmt: skip
GAP_S = (13.0, 17.5)
START = [1.0, 1.5, 0.3]


def gap_log(folder: Path, gap_s: tuple[float, float] = GAP_S) -> Path:
    log = write_drive(folder / "whole", make_drive(START, LEGS), HALL, make_robot("a"), corner_sigma_px=0.2)

    def is_kept(message: object) -> bool:
        in_gap = isinstance(message, WheelEncoders) and gap_s[0] * S < message.stamp_ns - START_NS < gap_s[1] * S
        return not in_gap

    return rewritten(log, folder / "gap", is_kept)


def test_the_gap_is_named_and_nothing_else(tmp_path: Path) -> None:
    result = build_map(read_runs([gap_log(tmp_path)]))
    (warning,) = result.warnings
    assert "wheel readings are missing 1 time while the robot drove, at the longest 4.5 s" in warning
    assert "from 13.0 s" in warning
    assert "lifted" not in warning
    assert result.outliers == ()
    (component,) = result.components
    for tag, true in zip(component.tags, HALL, strict=True):
        np.testing.assert_allclose(se2.apply(np.array(START), tag.position_m), true.position_m[:2], atol=0.03)


def test_no_picture_of_the_gap_becomes_a_keyframe(tmp_path: Path) -> None:
    run = load_run(gap_log(tmp_path))
    (segment,) = run.wheel_segments
    np.testing.assert_allclose((segment.gaps_ns - START_NS) * 1e-9, [GAP_S], atol=0.02)
    stamps_s = (candidate_stamps(run, segment) - START_NS) * 1e-9
    assert not ((stamps_s > GAP_S[0] + 0.02) & (stamps_s < GAP_S[1] - 0.02)).any()
    assert (stamps_s < GAP_S[0]).any()
    assert (stamps_s > GAP_S[1]).any()


def test_the_path_of_a_curve_is_as_uncertain_as_its_turn_makes_it(tmp_path: Path) -> None:
    """The turn may have come at any time: the sigma is that of a point uniformly on the line between the extremes."""
    (segment,) = load_run(gap_log(tmp_path)).wheel_segments
    before_ns, after_ns = segment.gaps_ns[0]
    odometry = compose_odometry(segment, np.array([before_ns, after_ns]), 0.5, NoiseParameters())
    turn_rad, distance_m = odometry.motion[0, 2], odometry.distance_m[0]
    spread_m = distance_m * abs(np.exp(1j * turn_rad) - 1.0) / np.sqrt(12.0)
    sigma_m = np.sqrt(np.diag(odometry.covariance[0]))[:2]
    assert (sigma_m > spread_m).all()
    assert (sigma_m < 1.3 * np.hypot(spread_m, 0.1 * distance_m)).all()


@pytest.mark.parametrize("gap_s", [(7.1, 7.5), (30.0, 30.0)])
def test_a_short_gap_is_none(tmp_path: Path, gap_s: tuple[float, float]) -> None:
    run = load_run(gap_log(tmp_path, gap_s))
    assert run.warnings == ()
    assert len(run.wheel_segments[0].gaps_ns) == 0
