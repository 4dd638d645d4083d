"""CSV folders become logs that say the same."""

from collections import Counter
from dataclasses import replace
from math import cos, radians, sin
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from groundsbot.calib.errors import GroundsbotError
from groundsbot.calib.geometry import se2, wheels
from groundsbot.calib.robot.robot_yaml import parse_robot_yaml
from groundsbot.offline.importing.csv.importer import import_folder
from groundsbot.offline.importing.csv.odometry import read_odometry
from groundsbot.offline.importing.robot import ImportOptions, WheelScale
from groundsbot.offline.measurements.run import load_run
from groundsbot.onboard.log.reading.decoder import LogMessage
from groundsbot.onboard.log.reading.reader import read_log
from tests.support.data.importing.csv_folders import (
    OBSERVATIONS,
    ODOMETRY,
    PAPER,
    TRACK,
    folder_with,
    import_run,
    observations_of,
    odometry_of,
    run_of,
)
from tests.support.paper_recordings import RECORDINGS, needs_recordings


def test_speeds_become_cumulative_distances(tmp_path: Path) -> None:
    report = import_run(tmp_path)
    assert report.run_folder == tmp_path / "logs" / "drive"
    assert [file.name for file in report.run_folder.iterdir()] == ["0000.core.mcap"]
    readings = odometry_of(report.run_folder)
    assert [r.stamp_ns for r in readings] == [0, 1_000_000_000, 2_000_000_000]
    assert [(r.wheels.left_m, r.wheels.right_m) for r in readings] == [(0, 0), (1, 1), (1.5, 2)]
    assert report.distance_m == pytest.approx(1.75)


def test_tags_of_one_time_are_one_message(tmp_path: Path) -> None:
    report = import_run(tmp_path)
    first, second = observations_of(report.run_folder)
    assert (first.frame, first.stamp_ns) == ("camera_planar", 500_000_000)
    assert [(o.family, o.tag_id) for o in second.observations] == [("tag36h11", 7), ("tag36h11", 9)]
    assert [(o.cartesian.x_m, o.cartesian.y_m) for o in second.observations] == [(2, 1), (4, -1)]
    assert not second.observations[0].cartesian.has_z
    assert list(second.observations[0].covariance) == []
    assert (report.n_observations, report.n_tags) == (3, 2)


def test_a_gyro_beside_the_pair_is_in_the_log_and_in_the_run(tmp_path: Path) -> None:
    rows = "".join(f"{0.1 * i:.1f},{0.01 * i}\n" for i in range(21))
    files = {"odometry.csv": ODOMETRY, "observations.csv": OBSERVATIONS, "gyro.csv": f"t_s,omega_rad_s\n{rows}"}
    report = import_folder(folder_with(tmp_path, files), tmp_path / "logs", TRACK)
    assert "gyro.csv: 21 readings of the yaw rate" in report.remarks
    run = load_run(report.run_folder)
    assert run.gyro is not None
    np.testing.assert_allclose(run.gyro.yaw_rate_rad_s, 0.01 * np.arange(21))
    assert run.gyro.stamps_ns.tolist() == [round(1e8 * i) for i in range(21)]


def test_the_log_is_in_order_of_time_with_the_run_first(tmp_path: Path) -> None:
    entries: list[LogMessage] = list(read_log(import_run(tmp_path).run_folder))
    assert entries[0].topic == "/run"
    assert [entry.log_time_ns for entry in entries] == sorted(entry.log_time_ns for entry in entries)
    assert all(entry.log_time_ns == entry.publish_time_ns for entry in entries)


def test_ranges_bearings_and_sigmas_are_kept(tmp_path: Path) -> None:
    text = "t_s,tag_id,range_m,bearing_rad,sigma_range_m,sigma_bearing_rad\n1,4,3.5,-0.25,0.1,0.02\n"
    (message,) = observations_of(import_run(tmp_path, observations=text).run_folder)
    (seen,) = message.observations
    assert (seen.polar.range_m, seen.polar.bearing_rad) == (3.5, -0.25)
    assert list(seen.covariance) == pytest.approx([0.01, 0, 0, 0.0004])


def test_seconds_keep_their_nanoseconds(tmp_path: Path) -> None:
    odometry = "t_s,left_m_s,right_m_s\n1800000000.123456789,0,0\n1800000001.123456789,0,0\n"
    observations = "t_ns,tag_id,x_m,y_m\n1800000000123456790,1,2,0\n"
    log = import_run(tmp_path, odometry, observations).run_folder
    assert odometry_of(log)[0].stamp_ns == 1_800_000_000_123_456_789
    assert observations_of(log)[0].stamp_ns == 1_800_000_000_123_456_790


def test_ticks_become_metres_from_zero_on(tmp_path: Path) -> None:
    odometry = "t_s,left_ticks,right_ticks\n0,1000,-500\n1,1500,0\n2,1400,500\n"
    options = ImportOptions(track_width_m=0.5, wheel_radius_m=0.1, ticks_per_turn=1000)
    log = import_run(tmp_path, odometry, options=options).run_folder
    turn_m = 2 * np.pi * 0.1
    distances = [(r.wheels.left_m, r.wheels.right_m) for r in odometry_of(log)]
    np.testing.assert_allclose(distances, np.array([(0, 0), (0.5, 0.5), (0.4, 1.0)]) * turn_m, rtol=1e-12)
    robot = parse_robot_yaml(run_of(log).robot_yaml, "log")
    assert (robot.wheels.radius_left_m, robot.wheels.ticks_per_turn, robot.wheels.track_m) == (0.1, 1000, 0.5)


@pytest.mark.parametrize(
    "odometry",
    ["t_s,left_m_s,right_m_s\n0,0,0\n1,1,1\n", "t_s,v_m_s,omega_rad_s\n0,0,0\n1,1,0\n"],
    ids=["wheel speeds", "twists"],
)
@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"wheel_radius_m": 0.1}, "--wheel-radius-m"),
        ({"ticks_per_turn": 100.0}, "--ticks-per-turn"),
        ({"wheel_radius_m": 0.1, "ticks_per_turn": 100.0}, "--wheel-radius-m and --ticks-per-turn"),
    ],
)
def test_options_about_ticks_are_refused_where_there_are_none(
    tmp_path: Path, odometry: str, options: dict[str, Any], named: str
) -> None:
    with pytest.raises(GroundsbotError, match=rf"odometry\.csv: holds no ticks, so {named} would have no effect"):
        import_run(tmp_path, odometry, options=ImportOptions(track_width_m=0.5, **options))
    assert not (tmp_path / "logs").exists()


def test_options_about_ticks_are_refused_for_the_papers_form(tmp_path: Path) -> None:
    folder = tmp_path / "drive"
    folder.mkdir()
    (folder / "odom.csv").write_text("0.1,0.1\n")
    (folder / "landmarks.csv").write_text("")
    options = ImportOptions(track_width_m=0.5, state_rate_hz=4.2, ticks_per_turn=100.0)
    with pytest.raises(GroundsbotError, match=r"odom\.csv: holds no ticks, so --ticks-per-turn would have no effect"):
        import_folder(folder, tmp_path / "logs", options)


def test_wheels_and_mount_come_from_robot_yaml_and_options_win(tmp_path: Path) -> None:
    robot_yaml = tmp_path / "robot.yaml"
    wheels_section = {"radius_left_m": 0.1, "radius_right_m": 0.2, "track_m": 0.4, "ticks_per_turn": 100}
    mount = {"x_m": 0.3, "y_m": 0.2, "y_m_sigma": 0.0001, "yaw_rad": 0.1, "yaw_rad_sigma": 0.001}
    tags = [{"family": "tag36h11", "default_size_m": 0.15, "sizes_m": {5: 0.2}}]
    robot_yaml.write_text(yaml.safe_dump({"robot_id": "carl", "wheels": wheels_section, "mount": mount, "tags": tags}))
    odometry = "t_s,left_ticks,right_ticks\n0,0,0\n1,100,100\n"
    options = ImportOptions(robot=robot_yaml, track_width_m=0.45, camera_y_m=-0.05)
    report = import_run(tmp_path, odometry, options=options)
    last = odometry_of(report.run_folder)[-1]
    assert (last.wheels.left_m, last.wheels.right_m) == pytest.approx((0.2 * np.pi, 0.4 * np.pi))
    robot = parse_robot_yaml(run_of(report.run_folder).robot_yaml, "log")
    assert report.robot_id == robot.robot_id == "carl"
    assert robot.wheels.track_m == 0.45
    assert robot.wheels.track_m_sigma == pytest.approx(0.0045)  # a sigma belongs to its value
    assert (robot.mount.x_m, robot.mount.y_m, robot.mount.yaw_rad, robot.mount.yaw_rad_sigma) == (0.3, -0.05, 0.1, 1e-3)
    assert robot.mount.y_m_sigma == pytest.approx(0.005)
    assert robot.tag_size_m("tag36h11", 5)[0] == 0.2


@given(st.lists(st.tuples(st.floats(-1, 1), st.floats(-2, 2)), min_size=1, max_size=6))
@settings(max_examples=25)
def test_turning_speeds_give_back_the_exact_arc(
    tmp_path_factory: pytest.TempPathFactory, speeds: list[tuple[float, float]]
) -> None:
    path = tmp_path_factory.mktemp("speeds") / "odometry.csv"
    rows = [f"{0.5 * k},{v!r},{omega!r}" for k, (v, omega) in enumerate([(0.0, 0.0), *speeds])]
    path.write_text("t_s,v_m_s,omega_rad_s\n" + "\n".join(rows))
    path_of_wheels, _ = read_odometry(path, WheelScale(0.5, None, None))
    T = np.zeros(3)
    for left_m, right_m in zip(np.diff(path_of_wheels.left_m), np.diff(path_of_wheels.right_m), strict=True):
        T = se2.compose(T, wheels.advance(left_m, right_m, 0.5))
    wanted = np.zeros(3)
    for v, omega in speeds:  # the integral of the circle itself
        turn = 0.5 * omega
        arc = (0.5 * v, 0.0) if abs(turn) < 1e-9 else (v / omega * sin(turn), v / omega * (1 - cos(turn)))
        wanted = se2.compose(wanted, [*arc, turn])
    np.testing.assert_allclose(se2.between(wanted, T), 0, atol=1e-7)


def test_the_papers_form_counts_states_and_turns_y_to_the_left(tmp_path: Path) -> None:
    files = {"odom.csv": "1,0,0\n2,0.42,0.84\n", "landmarks.csv": "0,5,1,0.5,0\n2,6,2,-0.25,0\n2,6,2,-0.26,0\n"}
    report = import_folder(folder_with(tmp_path, files), tmp_path / "logs", PAPER)
    readings = odometry_of(report.run_folder)
    assert report.n_odometry == 2
    assert [r.stamp_ns for r in readings] == [0, 238_095_238, 476_190_476]  # the start, then a state every 1 / 4.2 s
    assert [r.wheels.left_m for r in readings] == pytest.approx([0, 0, 0.1])
    assert [r.wheels.right_m for r in readings] == pytest.approx([0, 0, 0.2])
    first, second = observations_of(report.run_folder)
    assert first.frame == second.frame == "camera_planar"
    assert (first.stamp_ns, second.stamp_ns) == (0, 476_190_476)
    assert first.observations[0].cartesian.y_m == -0.5
    assert [o.cartesian.y_m for o in second.observations] == [0.25, 0.26]


def test_an_unknown_mount_is_zero_with_a_wide_sigma_and_reported(tmp_path: Path) -> None:
    files = {"odom.csv": "1,0,0\n", "landmarks.csv": "1,5,1,0.5,0\n"}
    folder = folder_with(tmp_path, files)
    unknown = import_folder(folder, tmp_path / "a", PAPER)
    said = "not given, so assumed to be 0 with a wide sigma: x (sigma 0.5 m), y (sigma 0.5 m), yaw (sigma 8 deg)"
    assert any(said in line for line in unknown.lines())
    mount = parse_robot_yaml(run_of(unknown.run_folder).robot_yaml, "log").mount
    assert (mount.x_m, mount.y_m, mount.yaw_rad) == (0, 0, 0)
    assert (mount.x_m_sigma, mount.y_m_sigma, mount.yaw_rad_sigma) == pytest.approx((0.5, 0.5, radians(8)))
    options = ImportOptions(track_width_m=0.5, state_rate_hz=4, camera_x_m=0.3, camera_y_m=0, camera_yaw_deg=90)
    known = import_folder(folder, tmp_path / "b", options)
    assert not any("not given" in line for line in known.lines())
    mount = parse_robot_yaml(run_of(known.run_folder).robot_yaml, "log").mount
    assert (mount.x_m, mount.yaw_rad) == pytest.approx((0.3, radians(90)))
    assert mount.x_m_sigma < 0.01


def test_of_a_mount_given_in_part_the_rest_is_open(tmp_path: Path) -> None:
    log = import_run(tmp_path, options=ImportOptions(track_width_m=0.5, camera_x_m=0.3)).run_folder
    mount = parse_robot_yaml(run_of(log).robot_yaml, "log").mount
    assert (mount.x_m, mount.y_m, mount.y_m_sigma) == (0.3, 0, 0.5)
    assert mount.x_m_sigma < 0.01


FRAMES = [
    ({}, False, "camera_planar", "the frame of the camera (or other sensor)"),
    ({"camera_x_m": 0.2}, False, "camera_planar", "the frame of the camera (or other sensor)"),
    ({"camera_x_m": 0.2}, True, "camera_planar", "the frame of the camera (or other sensor)"),
    ({}, True, "base", "base (--robot without --camera options)"),
]


@pytest.mark.parametrize(("options", "with_robot", "frame", "said"), FRAMES)
def test_observations_are_in_base_only_where_a_robot_yaml_is_given_and_no_camera_option(
    tmp_path: Path, options: dict[str, Any], with_robot: bool, frame: str, said: str
) -> None:
    robot = robot_yaml_in(tmp_path) if with_robot else None
    report = import_run(tmp_path, options=ImportOptions(robot=robot, track_width_m=0.5, **options))
    assert {message.frame for message in observations_of(report.run_folder)} == {frame}
    assert any(f"observations.csv: assumed to be in {said}" in line for line in report.lines())


def robot_yaml_in(folder: Path) -> Path:
    path = folder / "robot.yaml"
    wheels_section = {"radius_left_m": 0.1, "radius_right_m": 0.1, "track_m": 0.4, "ticks_per_turn": 100}
    path.write_text(yaml.safe_dump({"robot_id": "carl", "wheels": wheels_section, "time_offset_s_sigma": 0.001}))
    return path


TWISTS = "t_s,v_m_s,omega_rad_s\n0,0,0\n1,1,0.5\n"


def test_unmeasured_parameters_are_left_open(tmp_path: Path) -> None:
    """A mount, a clock, a track and offsets of ranges: unlike the defaults, which a person's own robot.yaml has."""
    robot = parse_robot_yaml(run_of(import_run(tmp_path).run_folder).robot_yaml, "log")
    assert (robot.time_offset_s, robot.time_offset_s_sigma) == (0.0, 0.3)
    assert (robot.range_offset_m, robot.range_offset_m_sigma) == (0.0, 0.1)
    assert (robot.mount.x_m_sigma, robot.mount.y_m_sigma) == (0.5, 0.5)
    assert robot.mount.yaw_rad_sigma == pytest.approx(radians(8))
    assert robot.wheels.track_m == 0.5
    assert robot.wheels.track_m_sigma == pytest.approx(0.3 * 0.5)
    assert robot.wheels.radii_ratio_sigma == 0.02


@pytest.mark.parametrize(
    ("files", "options", "wheels_sigma", "ranges_sigma"),
    [
        ({"odometry.csv": ODOMETRY, "observations.csv": OBSERVATIONS}, TRACK, 0.01, 0.02),
        ({"odometry.csv": TWISTS, "observations.csv": OBSERVATIONS}, TRACK, 0.05, 0.02),
        ({"odom.csv": "1,0,0\n", "landmarks.csv": "1,5,1,0.5,0\n"}, PAPER, 0.01, 0.15),
    ],
    ids=["encoders", "speeds of the robot", "paper"],
)
def test_the_sigma_of_the_scale_depends_on_the_form(
    tmp_path: Path, files: dict[str, str], options: ImportOptions, wheels_sigma: float, ranges_sigma: float
) -> None:
    report = import_folder(folder_with(tmp_path, files), tmp_path / "logs", options)
    robot = parse_robot_yaml(run_of(report.run_folder).robot_yaml, "log")
    assert robot.wheels.radii_scale_sigma == wheels_sigma
    assert robot.imported_tag_scale_sigma == ranges_sigma


def test_a_robot_yaml_that_is_given_keeps_its_sigmas(tmp_path: Path) -> None:
    options = ImportOptions(robot=robot_yaml_in(tmp_path))
    robot = parse_robot_yaml(run_of(import_run(tmp_path, options=options).run_folder).robot_yaml, "log")
    assert (robot.time_offset_s_sigma, robot.range_offset_m_sigma) == (0.001, 0.0)
    assert robot.wheels.track_m_sigma == pytest.approx(0.004)
    assert (robot.wheels.radii_scale_sigma, robot.imported_tag_scale_sigma) == (None, 0.005)


def test_turning_speeds_need_no_track_width(tmp_path: Path) -> None:
    """Whatever track stands in robot.yaml, the log's wheels turn by it as the file says."""
    report = import_run(tmp_path, TWISTS, options=ImportOptions())
    robot = parse_robot_yaml(run_of(report.run_folder).robot_yaml, "log")
    last = odometry_of(report.run_folder)[-1].wheels
    moved = wheels.advance(np.array(last.left_m), np.array(last.right_m), robot.wheels.track_m)
    np.testing.assert_allclose(moved, se2.exp(np.array([1.0, 0.0, 0.5])), atol=1e-12)
    assert robot.wheels.track_m_sigma == pytest.approx(0.3 * robot.wheels.track_m)


def test_a_drive_without_tags_is_imported(tmp_path: Path) -> None:
    report = import_run(tmp_path, observations="t_s,tag_id,x_m,y_m\n")
    assert (report.n_observations, report.n_tags) == (0, 0)
    assert len(odometry_of(report.run_folder)) == 3


def test_the_same_folder_gives_the_same_bytes(tmp_path: Path) -> None:
    folder = folder_with(tmp_path, {"odometry.csv": ODOMETRY, "observations.csv": OBSERVATIONS})
    logs = [import_folder(folder, tmp_path / name, TRACK).run_folder / "0000.core.mcap" for name in "ab"]
    assert logs[0].read_bytes() == logs[1].read_bytes()


def test_two_folders_become_two_runs_beside_each_other(tmp_path: Path) -> None:
    names = []
    for name in ("hall way", "loop"):
        folder = folder_with(tmp_path, {"odometry.csv": ODOMETRY, "observations.csv": OBSERVATIONS}, name)
        report = import_folder(folder, tmp_path / "logs", TRACK)
        info = run_of(report.run_folder)
        names.append((info.robot_id, info.run_id, report.run_folder.name))
    assert names == [("hall-way", "hall-way", "hall-way"), ("loop", "loop", "loop")]


def test_names_can_be_given(tmp_path: Path) -> None:
    report = import_run(tmp_path, options=ImportOptions(track_width_m=0.5, run_id="monday", robot_id="carl"))
    info = run_of(report.run_folder)
    assert (info.run_id, info.robot_id, report.run_folder.name) == ("monday", "carl", "monday")
    with pytest.raises(GroundsbotError, match=r"--run-id is 'a/b'"):
        ImportOptions(run_id="a/b")


def test_observations_outside_the_odometrys_time_are_reported(tmp_path: Path) -> None:
    report = import_run(tmp_path, observations="t_s,tag_id,x_m,y_m\n1,1,2,0\n2.5,1,2,0\n")
    assert any(line.strip().startswith("1 observation outside the odometry's time") for line in report.lines())


@needs_recordings
def test_the_papers_recordings_are_imported_whole(tmp_path: Path) -> None:
    reports = {name: import_folder(RECORDINGS / name, tmp_path, PAPER) for name in ("hallway", "loop")}
    counts = {name: (r.n_odometry, r.n_observations, r.n_tags) for name, r in reports.items()}
    assert counts == {"hallway": (489, 539, 31), "loop": (500, 584, 24)}
    seen = {
        name: Counter(o.tag_id for message in observations_of(r.run_folder) for o in message.observations)
        for name, r in reports.items()
    }
    assert len(seen["hallway"].keys() & seen["loop"].keys()) == 12
    assert seen["hallway"].total() == 539
    first = observations_of(reports["hallway"].run_folder)[0].observations[0]
    assert (first.tag_id, first.cartesian.x_m, first.cartesian.y_m) == (12, 3.58798, -0.603938)


def test_drives_of_one_robot_get_a_hint_how_to_share_a_calibration(tmp_path: Path) -> None:
    said = "the robot is named after the recording; with one --robot-id the drives of one robot share a calibration"
    folder = folder_with(tmp_path, {"odometry.csv": ODOMETRY, "observations.csv": OBSERVATIONS})
    assert said in import_folder(folder, tmp_path / "logs", TRACK).remarks
    named = import_folder(folder, tmp_path / "others", replace(TRACK, robot_id="carl"))
    assert said not in named.remarks
