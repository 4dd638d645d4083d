"""WPILib logs of FRC robots: what is in them comes out as it was driven and seen."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.importing.robot import ImportOptions
from groundsbot.offline.importing.run_writer import ImportReport
from groundsbot.offline.importing.wpilog.importer import import_wpilog
from groundsbot.offline.importing.wpilog.reader import WpiLog
from groundsbot.offline.importing.wpilog.topics import WpilogOptions
from groundsbot.onboard.log.messages import CameraCalibration, Gyro, PlanarOdometry, TagDetections, TagObservations
from groundsbot.onboard.log.reading.reader import read_log
from tests.support.data.importing.wpilogs import (
    CAMERA,
    MODULES,
    MOUNT,
    START_US,
    DataLog,
    add_limelight,
    add_modules,
    add_photon,
    add_speeds,
    good,
    pictures,
    poses,
    stamps_us,
)
from tests.support.paths import SHARED

FRC = SHARED / "data" / "frc"
AT = " ".join(f"{x},{y}" for x, y in MODULES)
needs_frc = pytest.mark.skipif(
    not FRC.is_dir(), reason="logs of FRC teams are not part of it, and not in ../shared/data"
)


def imported(
    log: DataLog, folder: Path, wpilog: WpilogOptions | None = None, options: ImportOptions | None = None
) -> ImportReport:
    return import_wpilog(log.write(folder / "drive.wpilog"), folder / "runs", options, wpilog)


def odometry(report: ImportReport) -> tuple[FloatArray, FloatArray]:
    found = [each.message for each in read_log(report.run_folder) if isinstance(each.message, PlanarOdometry)]
    return (
        np.array([each.stamp_ns for each in found]),
        np.array([[each.pose.x_m, each.pose.y_m, each.pose.theta_rad] for each in found]),
    )


def detections(report: ImportReport) -> list[TagDetections]:
    return [each.message for each in read_log(report.run_folder) if isinstance(each.message, TagDetections)]


def observations(report: ImportReport) -> list[TagObservations]:
    return [each.message for each in read_log(report.run_folder) if isinstance(each.message, TagObservations)]


def assert_path(report: ImportReport, tolerance_m: float) -> None:
    stamps, found = odometry(report)
    wanted = [np.interp(stamps, np.array(stamps_us()) * 1000, column) for column in poses().T]
    assert np.abs(found - np.column_stack(wanted)).max() < tolerance_m


def test_speeds_that_are_logged_when_they_change_hold_until_then(tmp_path: Path) -> None:
    report = imported(good(), tmp_path)
    assert report.n_odometry == 200 - 50 + 2  # the first, and one a period before the robot drives off
    assert_path(report, 1e-9)
    assert report.distance_m == pytest.approx(np.hypot(*np.diff(poses()[:, :2], axis=0).T).sum(), rel=0.02)


@pytest.mark.parametrize("kind", ["SwerveModulePosition[]", "SwerveModuleState[]"])
def test_swerve_modules_drive_as_the_chassis_does(tmp_path: Path, kind: str) -> None:
    log = good()
    add_modules(log, "/Drive/Modules", kind)
    report = imported(log, tmp_path, WpilogOptions(swerve_modules_m=AT))
    assert "/Drive/Modules" in report.remarks[0]
    assert_path(report, 1e-2 if "State" in kind else 2e-2)


def test_number_arrays_of_older_programs_are_modules_where_they_are_named(tmp_path: Path) -> None:
    log = good()
    add_modules(log, "/Drive/Swerve", "double[]")
    assert_path(imported(log, tmp_path, WpilogOptions("Drive/Swerve", swerve_modules_m=AT)), 1e-2)


def test_places_of_modules_come_from_robot_yaml_too(tmp_path: Path) -> None:
    log = good()
    add_modules(log, "/Drive/Modules", "SwerveModulePosition[]")
    robot = tmp_path / "robot.yaml"
    wheels = "{radius_left_m: 0.05, radius_right_m: 0.05, track_m: 0.5, ticks_per_turn: 1000}"
    tags = "[{family: tag36h11, default_size_m: 0.1651}]"
    places = [list(each) for each in MODULES]
    robot.write_text(f"robot_id: swerve\nwheels: {wheels}\ntags: {tags}\nswerve_modules_m: {places}\n")
    report = imported(log, tmp_path, options=ImportOptions(robot=robot))
    assert "/Drive/Modules" in report.remarks[0]
    assert_path(report, 2e-2)


def test_a_pose_is_taken_only_where_it_is_named(tmp_path: Path) -> None:
    log = DataLog()
    add_photon(log)
    for stamp, pose in zip(stamps_us(), poses().tolist(), strict=True):
        log.doubles("/Drive/Pose", "struct:Pose2d", stamp, pose)
    with pytest.raises(OfflineError, match="no odometry"):
        imported(log, tmp_path)
    assert_path(imported(log, tmp_path, WpilogOptions("/Drive/Pose")), 1e-9)


def test_field2d_publishes_degrees(tmp_path: Path) -> None:
    log = DataLog()
    add_photon(log)
    log.add("NT:/SmartDashboard/Field/.type", "string", 1, b"Field2d")
    for stamp, (x, y, theta) in zip(stamps_us(), poses().tolist(), strict=True):
        log.doubles("NT:/SmartDashboard/Field/Robot", "double[]", stamp, [x, y, np.degrees(theta)])
    assert_path(imported(log, tmp_path, WpilogOptions("SmartDashboard/Field/Robot")), 1e-9)


@pytest.mark.parametrize("new", [False, True])
def test_corners_of_photonvision_are_in_our_order_and_pixels(tmp_path: Path, new: bool) -> None:
    log = DataLog()
    add_speeds(log)
    add_photon(log, new=new)
    found = detections(imported(log, tmp_path))
    wanted = pictures()
    assert len(found) == len(wanted)
    for message, (stamp, corners, _) in zip(found, wanted, strict=True):
        assert message.stamp_ns == stamp * 1000  # the latency is taken off
        assert [each.tag_id for each in message.detections] == list(corners)
        for each in message.detections:
            assert np.allclose(np.reshape(each.corners_px, (4, 2)), corners[each.tag_id])


def test_intrinsics_of_the_log_become_its_calibration(tmp_path: Path) -> None:
    report = imported(good(), tmp_path)
    (found,) = [each.message for each in read_log(report.run_folder) if isinstance(each.message, CameraCalibration)]
    assert (found.width, found.height) == (1280, 720)
    assert list(found.K) == CAMERA.matrix.ravel().tolist()
    assert list(found.D) == list(CAMERA.distortion)


def test_places_computed_from_a_field_layout_are_no_measurements(tmp_path: Path) -> None:
    """Without intrinsics only single tags' camera-to-target is left; those of several tags are a metre off here."""
    log = DataLog()
    add_speeds(log)
    add_photon(log, camera=False)
    n_several = sum(len(corners) for _, corners, _ in pictures() if len(corners) > 1)
    report = imported(log, tmp_path, options=ImportOptions(camera_roll_deg=5.73, camera_pitch_deg=-17.19))
    assert f"{n_several} detections left out: of a picture with several tags" in "\n".join(report.remarks)
    assert n_several > 50
    for message in observations(report):
        (each,) = message.observations
        assert np.allclose(place(each), floor(message.stamp_ns, each.tag_id), atol=2e-3)


def test_a_limelight_sees_each_tag_under_the_mount_that_was_typed_in(tmp_path: Path) -> None:
    log = DataLog()
    add_speeds(log)
    add_limelight(log)
    report = imported(log, tmp_path)
    found = [(m.stamp_ns, each) for m in observations(report) for each in m.observations]
    assert len(found) == sum(len(corners) for _, corners, _ in pictures())
    for stamp_ns, each in found:
        assert np.allclose(place(each), floor(stamp_ns, each.tag_id), atol=1e-6)


def place(observation: object) -> FloatArray:
    cartesian = observation.cartesian  # type: ignore[attr-defined]
    return np.array([cartesian.x_m, cartesian.y_m])


def floor(stamp_ns: int, tag_id: int) -> FloatArray:
    """Where a tag lies from the camera, in axes of its yaw."""
    (places,) = [places for stamp, _, places in pictures() if stamp * 1000 == stamp_ns]
    level = MOUNT.model_copy(update={"yaw_rad": 0.0}).T_base_camera.rotation.as_matrix()
    ahead, left, up = places[tag_id]
    turned: FloatArray = (level @ [-left, -up, ahead])[:2]
    return turned


def test_transforms_beside_ids_are_single_tags(tmp_path: Path) -> None:
    log = DataLog()
    add_speeds(log)
    for stamp, _, places in pictures():
        log.add("/Vision/Inputs/TagIds", "int64[]", stamp, np.array(list(places), dtype="<i8").tobytes())
        rows = [[*each, 1.0, 0.0, 0.0, 0.0] for each in places.values()]
        log.doubles("/Vision/Inputs/CameraToTag", "struct:Transform3d[]", stamp, np.array(rows).ravel())
    n_single = sum(len(corners) == 1 for _, corners, _ in pictures())
    assert imported(log, tmp_path).n_observations == n_single > 5


def test_the_tilt_of_an_unmeasured_camera_comes_from_upright_tags(tmp_path: Path) -> None:
    report = imported(good(), tmp_path)
    text = "\n".join(report.remarks)
    assert f"rolled by {np.degrees(MOUNT.roll_rad):.1f} +- 2" in text
    assert f"pitched by {np.degrees(MOUNT.pitch_rad):.1f} +- 2" in text


@pytest.mark.parametrize("cameras", [("front", "back"), ("front",)])
def test_a_camera_is_chosen_where_several_saw_tags(tmp_path: Path, cameras: tuple[str, ...]) -> None:
    log = DataLog()
    add_speeds(log)
    for name in cameras:
        add_photon(log, f"/photonvision/{name}")
    log.add("/photonvision/blind/rawBytes", "rawBytes", START_US, bytes(8) + b"\0" + bytes(192))
    if len(cameras) > 1:
        with pytest.raises(OfflineError, match=r"2 topics fit: /photonvision/back/rawBytes .*; choose one with --tags"):
            imported(log, tmp_path)
    imported(log, tmp_path, WpilogOptions(tags_topic="/photonvision/front/rawBytes"))


def yaw_degrees(log: DataLog, theta: float, stamp: int) -> None:
    log.doubles("NT:/limelight-a/robot_orientation_set", "double[]", stamp, [np.degrees(theta), 0, 0, 0, 0, 0])


def yaw_rotation(log: DataLog, theta: float, stamp: int) -> None:
    log.doubles("/Gyro/Rotation", "struct:Rotation3d", stamp, [np.cos(theta / 2), 0.0, 0.0, np.sin(theta / 2)])


def yaw_wrapped(log: DataLog, theta: float, stamp: int) -> None:
    log.doubles("/Gyro/Yaw", "struct:Rotation2d", stamp, [(theta + 3.0 + np.pi) % (2 * np.pi) - np.pi])


@pytest.mark.parametrize(
    ("write", "name"),
    [
        (yaw_degrees, "NT:/limelight-a/robot_orientation_set"),
        (yaw_rotation, "Gyro/Rotation"),
        (yaw_wrapped, "/Gyro/Yaw"),
    ],
)
def test_a_yaw_becomes_a_rate(tmp_path: Path, write: Callable[[DataLog, float, int], None], name: str) -> None:
    log = good()
    for stamp, pose in zip(stamps_us(), poses(), strict=True):
        write(log, float(pose[2]), stamp)
    report = imported(log, tmp_path, WpilogOptions(imu_topic=name))
    rates = [each.message.yaw_rate_rad_s for each in read_log(report.run_folder) if isinstance(each.message, Gyro)]
    assert len(rates) > 100
    assert rates[-1] == pytest.approx((poses()[-1, 2] - poses()[-2, 2]) / 0.02)
    assert rates[0] == pytest.approx(0.0)


def test_a_robot_that_is_switched_off_leaves_a_part_of_a_record(tmp_path: Path) -> None:
    path = tmp_path / "cut.wpilog"
    content = good().content()
    path.write_bytes(content[:-1100])
    report = import_wpilog(path, tmp_path / "runs", wpilog_options=WpilogOptions())
    assert any("ends within a record" in each for each in report.remarks)
    path.write_bytes(content + bytes(5000))
    assert WpiLog(path).n_cut_bytes == 5000


@needs_frc
@pytest.mark.parametrize(
    ("name", "tags_topic", "n_tags", "n_observations"),
    [
        ("real/FRC_20240307_175915_NYSU_P6", None, 2, 1032),
        ("real/FRC_20240309_185842_NYSU_E2", "/photonvision/right/rawBytes", 2, 498),
        ("real/FRC_20240402_215158", None, 2, 667),
        ("real/team302_FRC_20240910_002841", None, 2, 1934),
        ("simulated_by_others/FRC_20240307_183038", "/photonvision/left/rawBytes", 4, 2413),
        ("simulated_by_others/FRC_20240307_192904", "/photonvision/right/rawBytes", 5, 897),
    ],
)
def test_real_logs_import(tmp_path: Path, name: str, tags_topic: str | None, n_tags: int, n_observations: int) -> None:
    report = import_wpilog(FRC / f"{name}.wpilog", tmp_path, wpilog_options=WpilogOptions(tags_topic=tags_topic))
    assert (report.n_tags, report.n_observations) == (n_tags, n_observations)
