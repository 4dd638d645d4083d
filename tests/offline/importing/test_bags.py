"""Bags of ROS 1 and ROS 2 become logs that give the map of the log they were made from."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from groundsbot.calib.camera.model import CameraModel
from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.offline.importing.bags.importer import import_bag
from groundsbot.offline.importing.bags.topics import BagOptions
from groundsbot.offline.importing.robot import ImportOptions
from groundsbot.offline.importing.run_writer import ImportReport
from groundsbot.offline.mapping.inputs import read_runs
from groundsbot.offline.mapping.pipeline import build_map
from groundsbot.offline.maps.result import MapResult
from groundsbot.offline.measurements.run import RobotFile, load_run
from groundsbot.onboard.detection.tag_detector import TagDetector
from groundsbot.onboard.log.messages import PlanarOdometry, RunInfo, TagDetections, TagObservation, TagObservations
from groundsbot.onboard.log.reading.reader import read_log
from groundsbot.onboard.log.writing.writer import LogWriter
from tests.support.data.drives import HALL, PINHOLE, START_NS, S, make_drive, make_robot, picture_stamps, write_drive
from tests.support.data.importing.bags import BagOfLog
from tests.support.data.importing.ros_messages import without_definitions
from tests.support.data.odometry_steps import accumulate, covariances_of_steps
from tests.support.tag_pictures import draw_tag

TAGS = [HALL[i] for i in (0, 1, 2, 4, 6, 7)]
DRIVE = make_drive(
    [1.0, 1.5, 0.3], [(0.4, 0.4, 2.0), (0.5, 0.3, 2.0), (-0.3, 0.3, 4.0), (0.3, 0.5, 1.0)], step_ns=S // 50
)
SHORT = make_drive([1.0, 1.5, 0.3], [(0.4, 0.4, 1.0)])
PICTURES = CameraModel("c", 640, 480, 600.0, 601.0, 320.5, 239.5, "plumb_bob", (-0.18, 0.07, 0.0006, -0.0004, 0.0))
OPTIONS = ImportOptions(run_id="one", robot_id="carl", track_width_m=0.5)
SIZED = BagOptions(tag_size_m=0.15)
NOISE = NoiseParameters()  # given: how noise is fitted is no matter of bags


@pytest.fixture(scope="module")
def corner_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A drive past tags in pixels, with noise."""
    folder = tmp_path_factory.mktemp("corners")
    return write_drive(folder, DRIVE, TAGS, camera=PINHOLE, corner_sigma_px=0.2)


@pytest.fixture(scope="module")
def position_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same drive with positions in metres, every other with a covariance."""
    return _position_log(tmp_path_factory.mktemp("positions"))


@pytest.fixture(scope="module")
def bare_position_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Positions without covariances."""
    return _position_log(tmp_path_factory.mktemp("bare"), with_covariances=False)


@pytest.fixture(scope="module")
def corner_map(corner_log: Path) -> MapResult:
    return build_map(read_runs([corner_log]), noise=NOISE)


@pytest.fixture(scope="module")
def position_map(position_log: Path) -> MapResult:
    return build_map(read_runs([position_log]), noise=NOISE)


def _position_log(folder: Path, *, with_covariances: bool = True) -> Path:
    robot, rng = make_robot(), np.random.default_rng(3)
    plain = write_drive(folder, DRIVE, [], robot, camera=None)
    run = next(iter(read_log(plain))).message
    assert isinstance(run, RunInfo)
    eye = robot.mount.T_base_camera
    turn = Rotation.from_euler("z", -robot.mount.yaw_rad)
    stamps_ns = picture_stamps(DRIVE)
    messages: list[TagObservations] = []
    for stamp_ns, (x, y, theta) in zip(stamps_ns.tolist(), DRIVE.at(stamps_ns).tolist(), strict=True):
        message = TagObservations(stamp_ns=stamp_ns, frame="camera_planar")
        for number, tag in enumerate(TAGS):
            in_base = Rotation.from_euler("z", -theta).apply(np.array(tag.position_m) - [x, y, 0.0])
            place = turn.apply(in_base - eye.as_components()[0])
            if place[0] < 0.5:
                continue
            covariance = np.array([[0.02, 0.004], [0.004, 0.005]]) * 0.1
            place[:2] += np.linalg.cholesky(covariance) @ rng.standard_normal(2)
            seen = TagObservation(family=tag.family, tag_id=tag.tag_id)
            seen.cartesian.x_m, seen.cartesian.y_m, seen.cartesian.z_m = place.tolist()
            if with_covariances and number % 2:
                seen.covariance.extend(covariance.ravel().tolist())
            message.observations.append(seen)
        if message.observations:
            messages.append(message)
    log = folder / "with_positions"
    entries = [(each.publish_time_ns, each.topic, each.message) for each in read_log(plain) if each.topic == "/wheels"]
    entries += [(each.stamp_ns, "/tags/observations", each) for each in messages]
    with LogWriter(log, {"/run": run}, START_NS, durable=False) as writer:
        for stamp_ns, topic, sent in sorted(entries, key=lambda entry: entry[0]):
            writer.write(topic, sent, stamp_ns, stamp_ns)
    return log


def import_run(
    bag: Path, tmp_path: Path, options: ImportOptions = OPTIONS, bag_options: BagOptions = SIZED
) -> ImportReport:
    return import_bag(bag, tmp_path / "logs", options, bag_options, lambda *_: None)


def map_of(imported_run: Path, log: Path) -> MapResult:
    """With the robot.yaml of the log that the bag was made of: the import's own leaves more open."""
    robot, of_log = load_run(imported_run).robot, load_run(log)
    np.testing.assert_allclose(robot.mount.T_base_camera.as_matrix(), of_log.robot.mount.T_base_camera.as_matrix())
    assert robot.wheels.track_m == of_log.robot.wheels.track_m
    return build_map(read_runs([imported_run], {robot.robot_id: RobotFile(of_log.robot, {})}), noise=NOISE)


def assert_same_map(a: MapResult, b: MapResult, tolerance: float = 1e-6) -> None:
    """Places within a micrometre, covariances within a millionth."""
    (one,), (other,) = a.components, b.components
    assert [tag.tag_id for tag in one.tags] == [tag.tag_id for tag in other.tags] != []
    for tag, same in zip(one.tags, other.tags, strict=True):
        assert tag.n_observations == same.n_observations
        np.testing.assert_allclose(tag.position_m[:2], same.position_m[:2], atol=tolerance)
        np.testing.assert_allclose(tag.covariance, same.covariance, rtol=tolerance * 10, atol=1e-12)
    for run, same_run in zip(one.runs, other.runs, strict=True):
        np.testing.assert_allclose(run.T_map_base, same_run.T_map_base, atol=tolerance)


@pytest.mark.parametrize("form", ["apriltag_msgs mcap", "apriltag_msgs db3", "apriltag_msgs file", "isaac", "joints"])
def test_a_bag_of_corners_gives_the_map_of_its_log(
    tmp_path: Path, corner_log: Path, corner_map: MapResult, form: str
) -> None:
    made = BagOfLog.of(corner_log).mount().camera_info()
    made = made.joints() if form == "joints" else made.odometry()
    made = made.isaac() if form == "isaac" else made.apriltag_msgs()
    bag = made.write(tmp_path / ("drive_db3" if "db3" in form else "drive"))
    if "db3" in form:
        without_definitions(bag)
    if "file" in form:
        (bag,) = bag.glob("*.mcap")
    options = replace(OPTIONS, wheel_radius_m=0.1) if form == "joints" else OPTIONS
    report = import_run(bag, tmp_path, options)
    assert_same_map(corner_map, map_of(report.run_folder, corner_log))


@pytest.mark.parametrize("form", ["apriltag_ros", "isaac"])
def test_a_bag_of_poses_gives_the_map_of_its_log(
    tmp_path: Path, position_log: Path, position_map: MapResult, form: str
) -> None:
    """Half of the readings have a covariance, the others zeros, as detectors send them."""
    made = BagOfLog.of(position_log).mount().odometry()
    made = made.apriltag_ros() if form == "apriltag_ros" else made.isaac_poses()
    bag = made.write(tmp_path / ("drive.bag" if form == "apriltag_ros" else "drive"))
    report = import_run(bag, tmp_path, bag_options=BagOptions())
    assert_same_map(position_map, map_of(report.run_folder, position_log))
    n_without = sum(not each.covariance for message in made.observations for each in message.observations)
    assert any(
        f"those of {n_without} observations of {report.n_observations} are zeros" in each for each in report.remarks
    )


def test_a_bag_with_tags_in_tf_gives_the_map_of_its_log(tmp_path: Path, bare_position_log: Path) -> None:
    bag = BagOfLog.of(bare_position_log).mount().odometry().tag_transforms().write(tmp_path / "drive")
    report = import_run(bag, tmp_path, bag_options=BagOptions())
    assert_same_map(
        build_map(read_runs([bare_position_log]), noise=NOISE), map_of(report.run_folder, bare_position_log)
    )


def test_covariances_of_odometry_come_from_the_bag(tmp_path: Path, corner_log: Path, corner_map: MapResult) -> None:
    """They grow by a known covariance with each step, and the map is that of a log which holds these."""
    made = BagOfLog.of(corner_log)
    steps = covariances_of_steps(made.poses)
    bag = made.mount().camera_info().apriltag_msgs().odometry(covariances=accumulate(made.poses, steps))
    report = import_run(bag.write(tmp_path / "drive"), tmp_path)
    assert "covariances of the odometry are used: that of a step is what it adds to the pose's" in report.remarks
    log = _with_covariances(corner_log, made.poses, steps, tmp_path / "expected")
    expected = build_map(read_runs([log]), noise=NOISE)
    found = map_of(report.run_folder, corner_log)
    assert_same_map(expected, found)
    (plain,), (given,) = corner_map.components, found.components
    assert not np.allclose(plain.tags[0].covariance, given.tags[0].covariance, rtol=0.05)


def test_a_bag_leaves_parameters_open_that_it_does_not_contain(tmp_path: Path, position_log: Path) -> None:
    """tf holds the mount; a bag holds neither time offsets nor wheels nor the source of ranges."""
    bag = BagOfLog.of(position_log).mount().odometry().isaac_poses().write(tmp_path / "drive")
    robot = load_run(import_run(bag, tmp_path, replace(OPTIONS, track_width_m=None), BagOptions()).run_folder).robot
    assert (robot.time_offset_s_sigma, robot.range_offset_m_sigma) == (0.3, 0.1)
    assert robot.wheels.track_m_sigma == pytest.approx(0.3 * robot.wheels.track_m)
    assert (robot.wheels.radii_scale_sigma, robot.wheels.radii_ratio_sigma) == (0.01, 0.02)
    assert robot.mount.x_m_sigma < 0.01


def _with_covariances(log: Path, poses: FloatArray, steps: FloatArray, folder: Path) -> Path:
    """The log with `/odometry` for its `/wheels`."""
    entries = list(read_log(log))
    head = {each.topic: each.message for each in entries if each.topic in ("/run", "/camera/calibration", "/tf")}
    readings = iter(zip(poses.tolist(), steps, strict=True))
    with LogWriter(folder, head, START_NS, durable=False) as writer:
        for each in entries:
            stamp_ns = each.publish_time_ns
            if each.topic == "/wheels":
                (x, y, theta), step = next(readings)
                pose = PlanarOdometry.PoseInOdom(x_m=x, y_m=y, theta_rad=theta)
                message = PlanarOdometry(stamp_ns=stamp_ns, pose=pose, covariance=step.ravel().tolist())
                writer.write("/odometry", message, stamp_ns, stamp_ns)
            elif each.topic == "/tags/detections":
                writer.write(each.topic, each.message, stamp_ns, stamp_ns)
    return folder


@pytest.mark.parametrize("form", ["mono8", "bgr8", "png"])
def test_pictures_of_a_bag_give_what_the_detector_finds_in_them(tmp_path: Path, form: str) -> None:
    made = BagOfLog.of(write_drive(tmp_path, SHORT, [], camera=PICTURES)).mount().odometry().camera_info()
    expected = []
    for number, stamp_ns in enumerate(picture_stamps(SHORT)[:3].tolist()):
        corners_px = np.array([[200.0, 150.0], [320.0, 160.0], [315.0, 280.0], [205.0, 270.0]]) + 20.25 * number
        drawn = draw_tag("tag36h11", 7, corners_px, (PICTURES.height_px, PICTURES.width_px))
        picture = drawn + np.random.default_rng(number).integers(0, 3, drawn.shape, np.uint8)
        made.picture(form, picture, stamp_ns)
        (found,) = TagDetector(quad_decimate=1.0, camera=PICTURES).detect(picture)
        np.testing.assert_allclose(found.corners_px, corners_px, atol=0.5)
        expected.append((stamp_ns, found.corners_px.ravel().tolist()))
    report = import_run(made.write(tmp_path / "drive"), tmp_path)
    looks = [each.message for each in read_log(report.run_folder) if isinstance(each.message, TagDetections)]
    assert [(each.stamp_ns, list(each.detections[0].corners_px)) for each in looks] == expected
    assert load_run(report.run_folder).camera == replace(PICTURES, name="camera")
