"""How parameters of an imported robot are told, whose file holds no measured values."""

from dataclasses import replace
from pathlib import Path

import pytest

from groundsbot.offline.maps.parameter_results import CalibrationResult, RobotNumber
from groundsbot.offline.measurements.run import load_run
from groundsbot.offline.self_calibration.robot_table import ESTIMATED, WRONG, compare_with_files, verdict_lines
from tests.support.data.importing.csv_folders import TRACK, import_run

SPEEDS = "t_s,v_m_s,omega_rad_s\n0,0,0\n1,1,0\n2,1,0.5\n"


def rows_of(tmp_path: Path, track_width_m: float | None) -> list[RobotNumber]:
    """Parameters in the order of a solve: the time offset last."""
    options = replace(TRACK, robot_id="carl", track_width_m=track_width_m)
    run = load_run(import_run(tmp_path, SPEEDS, options=options).run_folder / "0000.core.mcap")
    names = ("wheel_scale", "track_scale", "mount_x_m", "time_offset_s")
    estimates = [CalibrationResult("carl", name, 0, 0.2, 0.001, 1.0) for name in names]
    ranges = CalibrationResult("imported tag36h11", "tag_scale", 0, 0.01, 0.02, 0.02)
    return [*compare_with_files([run], [*estimates, ranges], [])]


def test_placeholders_are_factors_and_time_offsets_come_first(tmp_path: Path) -> None:
    offset, radius, track, mount, ranges = rows_of(tmp_path, None)
    assert (offset.name, mount.name) == ("time_offset_s", "mount_x_m")
    for row, what in ((radius, "distances"), (track, "turns")):
        assert what in row.what
        assert (row.in_file, row.found, row.sigma) == pytest.approx((1.0, 1.2, 0.001))
    assert [row.unit for row in (offset, radius, track, mount, ranges)] == ["s", "", "", "m", ""]
    assert ranges.to_do == "give a measured --distance: odometry and ranges can be scaled together"
    assert {row.to_do for row in (offset, radius, track, mount)} == {""}


def test_a_given_track_is_a_length(tmp_path: Path) -> None:
    track = rows_of(tmp_path, 0.6)[2]
    assert (track.what, track.in_file, track.unit) == ("track_m", 0.6, "m")
    assert track.found == pytest.approx(0.72)


def test_what_had_no_value_was_found_and_does_not_differ() -> None:
    found, differs = (RobotNumber("carl", "x", 0, "x", 0.0, 1.0, 0.1, each, "") for each in (ESTIMATED, WRONG))
    assert verdict_lines([found, differs, found, found], most=2) == [
        "robot parameters found from the drives (assumed -> estimate, sigma; the report lists all):",
        "  carl  x    0.0000 ->   1.0000  0.1000",
        "  carl  x    0.0000 ->   1.0000  0.1000",
        "  and 1 more",
        "robot parameters that differ (robot.yaml -> estimate, sigma; the report lists all):",
        "  carl  x    0.0000 ->   1.0000  0.1000  robot.yaml is wrong",
    ]
