"""Speeds to the left, steering angles and poses in odometry.csv become the drives that they are of."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from groundsbot.calib.geometry import se2
from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.calib.robot.robot_yaml import parse_robot_yaml
from groundsbot.offline.importing.bags.importer import import_bag
from groundsbot.offline.importing.bags.topics import BagOptions
from groundsbot.offline.importing.csv.importer import import_folder
from groundsbot.offline.importing.robot import ImportOptions
from groundsbot.offline.mapping.pipeline import build_map
from groundsbot.offline.measurements.run import load_run
from tests.benchmarks.accuracy.drive_study import study_seed
from tests.support.data.any_drive import DRIVES, WHEELBASE_M, Drive, make_any_drive, write_csv
from tests.support.data.importing.bags import BagOfLog
from tests.support.data.importing.csv_folders import OBSERVATIONS, folder_with, import_run, odometry_of, run_of


def test_speeds_to_the_left_become_poses(tmp_path: Path) -> None:
    report = import_run(
        tmp_path, "t_s,vx_m_s,vy_m_s,omega_rad_s\n0,9,9,9\n1,1,0.5,0\n3,0,1,0.25\n", options=ImportOptions()
    )
    pose = odometry_of(report.run_folder)[-1].pose
    expected = se2.compose(se2.exp([1.0, 0.5, 0.0]), se2.exp([0.0, 2.0, 0.5]))
    np.testing.assert_allclose([pose.x_m, pose.y_m, pose.theta_rad], expected, atol=1e-12)
    assert (
        "odometry.csv: speeds forward, to the left and of turning, each the mean since the row before" in report.remarks
    )
    assert parse_robot_yaml(run_of(report.run_folder).robot_yaml, "log").wheels.radii_scale_sigma == 0.05


def test_poses_are_kept_as_they_are(tmp_path: Path) -> None:
    report = import_run(tmp_path, "t_s,x_m,y_m,theta_rad\n0,1,2,3\n1,1,2.5,-3\n", options=ImportOptions())
    poses = [(r.pose.x_m, r.pose.y_m, r.pose.theta_rad) for r in odometry_of(report.run_folder)]
    assert poses == [(1, 2, 3), (1, 2.5, -3)]
    assert report.distance_m == 0.5
    (segment,) = load_run(report.run_folder).wheel_segments
    assert segment.lateral_m is not None
    assert segment.lateral_m[-1] != 0.0


def test_a_steered_robot_turns_about_its_rear_axle(tmp_path: Path) -> None:
    """A quarter of a circle of radius 2 m: wheelbase over the tangent of the angle."""
    angle = float(np.arctan(0.8 / 2.0))
    text = f"t_s,v_m_s,steering_rad\n0,0,0\n1,{np.pi!r},{angle!r}\n"
    report = import_run(tmp_path, text, options=ImportOptions(wheelbase_m=0.8, track_width_m=0.6))
    (segment,) = load_run(report.run_folder).wheel_segments
    moved = segment.motions(segment.stamps_ns[:1], segment.stamps_ns[1:], 0.6)[0]
    np.testing.assert_allclose(moved, [2.0, 2.0, np.pi / 2], atol=1e-9)


def test_velocities_poses_and_a_bag_are_one_drive(tmp_path: Path) -> None:
    drive = make_any_drive("swerve", 3, seconds=40.0)
    robot = tmp_path / "robot.yaml"
    robot.write_text(
        "robot_id: omni\nwheels: {radius_left_m: 0.1, radius_right_m: 0.1, track_m: 0.5, ticks_per_turn: 1000}\n"
    )
    options = ImportOptions(robot=robot, camera_x_m=0.2)
    logs = []
    for form in ("velocities", "poses"):
        folder = write_csv(tmp_path / form, drive, form)
        logs.append(import_folder(folder, tmp_path / "logs", options).run_folder)
    bag = BagOfLog.of(logs[-1]).mount().odometry().tag_transforms().write(tmp_path / "bag")
    of_bag = import_bag(bag, tmp_path / "logs", replace(options, run_id="bag"), BagOptions(), lambda *_: None)
    # A fit of the noise ends within its tolerance, which moves tags by some micrometres.
    maps = [build_map([load_run(each)], NoiseParameters()).components[0] for each in (*logs, of_bag.run_folder)]
    places_m = [np.array([tag.position_m for tag in each.tags]) for each in maps]
    assert len(places_m[0]) > 20
    for other in places_m[1:]:
        np.testing.assert_allclose(other, places_m[0], atol=1e-6)


@pytest.mark.parametrize("kind", DRIVES)
def test_maps_of_other_drives_are_right_and_know_how_well(kind: Drive) -> None:
    """20 seeds of longer drives each are in docs/accuracy.md."""
    rows = np.array([study_seed(kind, seed, seconds=90.0) for seed in range(3)])
    assert rows[:, 0].max() < 0.1
    assert 0.4 < rows[:, 1].mean() < 1.7


def test_a_wheelbase_that_nothing_uses_is_refused(tmp_path: Path) -> None:
    files = {"odometry.csv": "t_s,v_m_s,omega_rad_s\n0,0,0\n1,1,0\n", "observations.csv": OBSERVATIONS}
    with pytest.raises(Exception, match="holds no steering_rad, so --wheelbase-m would have no effect"):
        import_folder(folder_with(tmp_path, files), tmp_path / "logs", ImportOptions(wheelbase_m=WHEELBASE_M))
    with pytest.raises(Exception, match=r"--wheelbase-m is 0\.0, must be above 0"):
        ImportOptions(wheelbase_m=0.0)
