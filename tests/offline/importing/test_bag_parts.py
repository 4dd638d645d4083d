"""How parts of bags are read: topics, times, frames, pictures, covariances."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from groundsbot.calib.camera.file import write_camera_yaml
from groundsbot.calib.errors import GroundsbotError
from groundsbot.calib.robot.camera_section import Mount
from groundsbot.calib.robot.robot_yaml import write_robot_yaml
from groundsbot.offline.importing.bags.frames import FixedFrames, mount_of
from groundsbot.offline.importing.bags.importer import import_bag
from groundsbot.offline.importing.bags.pictures import picture_of
from groundsbot.offline.importing.bags.positions import planar_covariance
from groundsbot.offline.importing.bags.reader import BagTopic, open_bag
from groundsbot.offline.importing.bags.tags import BagTag, read_picture
from groundsbot.offline.importing.bags.topics import APRILTAG_MSGS, IMAGE, BagOptions, choose_topics, only_camera_info
from groundsbot.offline.importing.robot import ImportOptions
from groundsbot.offline.importing.run_writer import ImportReport
from groundsbot.offline.measurements.run import Run, load_run
from groundsbot.offline.measurements.tags import TagKey
from tests.support.data.drives import CAMERA as LENS
from tests.support.data.drives import HALL, PINHOLE, make_drive, make_robot, write_drive
from tests.support.data.importing.bags import BagOfLog, good
from tests.support.data.importing.ros_messages import BASE, CAMERA, STORE2, Sent, header, make_message, write_bag
from tests.support.programs import Run as Program

DRIVE = make_drive([1.0, 1.5, 0.3], [(0.4, 0.3, 1.0)], step_ns=20_000_000)
SIZED = BagOptions(tag_size_m=0.15)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_drive(tmp_path_factory.mktemp("log"), DRIVE, HALL[:2], camera=PINHOLE)


def import_run(
    messages: Sequence[Sent], folder: Path, bag_options: BagOptions = SIZED, **options: Any
) -> tuple[ImportReport, Run]:
    bag = write_bag(folder / "drive", messages)
    report = import_bag(bag, folder / "logs", ImportOptions(**options), bag_options, lambda *_: None)
    return report, load_run(report.run_folder)


def test_names_of_run_and_robot_come_from_the_bag_and_its_track_need_not_be_known(tmp_path: Path, log: Path) -> None:
    report, run = import_run(good(log).sent, tmp_path)
    assert (report.run_id, report.robot_id, run.name) == ("drive", "drive", "drive_drive")
    assert report.distance_m == pytest.approx(0.35)


def test_times_of_receiving_are_used_where_asked_for(tmp_path: Path, log: Path) -> None:
    made = good(log)
    bare = [
        s._replace(fields=s.fields | ({"header": header(0, CAMERA)} if "header" in s.fields else {})) for s in made.sent
    ]
    bare = [s._replace(fields=s.fields | {"child_frame_id": BASE}) if s.topic == "/odom" else s for s in bare]
    report, run = import_run(bare, tmp_path, replace(SIZED, receive_times=True))
    np.testing.assert_array_equal(run.picture_stamps_ns, made.run.picture_stamps_ns + 90_000_000)
    assert run.wheel_segments[0].stamps_ns[0] == made.track.stamps_ns[0] + 5_000_000
    assert "times are those at which the bag received the messages" in report.remarks


def test_messages_out_of_order_twice_or_without_a_time_do_no_harm(tmp_path: Path, log: Path) -> None:
    made = good(log)
    swapped = [each._replace(received_ns=2 * made.sent[1].received_ns - each.received_ns) for each in made.sent[1:]]
    nameless = made.sent[5]._replace(fields=made.sent[5].fields | {"header": header(0, "odom")})
    messages = [made.sent[0], *swapped, made.sent[7]._replace(received_ns=made.sent[7].received_ns + 99), nameless]
    report, run = import_run(messages, tmp_path)
    np.testing.assert_array_equal(run.wheel_segments[0].stamps_ns, made.track.stamps_ns)
    np.testing.assert_array_equal(run.detections.stamps_ns, made.run.detections.stamps_ns)
    assert "/odom: 1 message left out: other messages have the same times" in report.remarks
    assert "/odom: 1 message left out: their header stamps are 0" in report.remarks


def test_options_choose_among_several_topics(tmp_path: Path, log: Path) -> None:
    made = good(log).odometry("/other").apriltag_msgs("/rear/detections", "rear").camera_info("/rear/camera_info")
    choice = BagOptions(
        odometry_topic="/other", tags_topic="detections", tag_size_m=0.15, camera_info_topic="/camera/camera_info"
    )
    report, _ = import_run(made.sent, tmp_path, choice)
    assert report.remarks[:3] == (
        "odometry: /other (nav_msgs/Odometry)",
        "tags: /detections (apriltag_msgs/AprilTagDetectionArray)",
        "camera: /camera/camera_info, for rectified pictures",
    )


def test_odometry_goes_before_joints_and_detections_before_pictures(log: Path) -> None:
    names = {
        "/joint_states": "sensor_msgs/msg/JointState",
        "/odom": "nav_msgs/msg/Odometry",
        "/a/image_raw": IMAGE,
        "/b/image_raw": IMAGE,
        "/a/camera_info": "sensor_msgs/msg/CameraInfo",
        "/b/camera_info": "sensor_msgs/msg/CameraInfo",
        "/tags": APRILTAG_MSGS,
    }
    topics = [BagTopic(name, msgtype, 3) for name, msgtype in names.items()]
    chosen = choose_topics(log, topics, BagOptions())
    assert (chosen.odometry.name, chosen.tags.name) == ("/odom", "/tags")
    with pytest.raises(GroundsbotError, match=r"2 topics fit: /a/camera_info .*; choose one with --camera-info-topic"):
        only_camera_info(log, chosen)
    chosen = choose_topics(log, topics, BagOptions(odometry_topic="/joint_states", image_topic="/b/image_raw"))
    assert (chosen.odometry.name, chosen.tags.name) == ("/joint_states", "/b/image_raw")
    camera_info = only_camera_info(log, chosen)
    assert camera_info is not None
    assert camera_info.name == "/b/camera_info"


def test_detections_are_in_rectified_pixels(tmp_path: Path, log: Path) -> None:
    """K and D are of the raw pictures; the detectors of ROS see those that P describes."""
    made = good(log).without("/camera/camera_info").camera_info(camera=LENS)
    (info,) = [each for each in made.sent if each.topic == "/camera/camera_info"]
    p = [800.0, 0.0, 640.5, 0.0, 0.0, 801.0, 360.5, 0.0, 0.0, 0.0, 1.0, 0.0]
    changed = [each._replace(fields=each.fields | {"p": p}) if each is info else each for each in made.sent]
    _, run = import_run(changed, tmp_path)
    assert run.camera is not None
    assert (run.camera.fx_px, run.camera.fy_px, run.camera.cx_px, run.camera.cy_px) == (800.0, 801.0, 640.5, 360.5)
    assert run.camera.distortion == (0.0,) * 5


def test_robot_yaml_gives_sizes_mount_and_camera(tmp_path: Path, log: Path) -> None:
    robot = make_robot("dora", mount={"x_m": 0.3}, tags=[{"default_size_m": 0.2}])
    write_robot_yaml(robot, tmp_path / "robot.yaml")
    write_camera_yaml(LENS, tmp_path / "camera.yaml")
    _, run = import_run(good(log).without("/tf_static").sent, tmp_path, BagOptions(), robot=tmp_path / "robot.yaml")
    assert (run.robot_id, run.robot.mount.x_m, run.robot.tag_size_m("tag36h11", 1)[0]) == ("dora", 0.3, 0.2)
    assert run.camera == replace(LENS, name="camera")


def test_options_go_before_tf(tmp_path: Path, log: Path) -> None:
    _, run = import_run(good(log).sent, tmp_path, camera_x_m=0.25)
    mount, by_tf = run.robot.mount, make_robot().mount
    assert mount.x_m == 0.25
    np.testing.assert_allclose(
        [mount.y_m, mount.yaw_rad, mount.pitch_rad, mount.roll_rad],
        [by_tf.y_m, by_tf.yaw_rad, by_tf.pitch_rad, by_tf.roll_rad],
        atol=1e-12,
    )


@pytest.mark.parametrize("starts_over", [False, True])
def test_joints_may_be_named_and_start_over_after_a_turn(tmp_path: Path, log: Path, starts_over: bool) -> None:
    made = BagOfLog.of(log).mount().camera_info().apriltag_msgs().joints(names=("a", "b"))
    sent = []
    for each in made.sent:
        if each.topic == "/joint_states" and starts_over:
            wrapped = (np.array(each.fields["position"]) + 2.0 + np.pi) % (2 * np.pi) - np.pi  # the left one passes pi
            each = each._replace(fields=each.fields | {"position": wrapped})
        sent.append(each)
    options = BagOptions(left_joint="a", right_joint="b", tag_size_m=0.15)
    _, run = import_run(sent, tmp_path, options, wheel_radius_m=0.1, track_width_m=0.5)
    np.testing.assert_allclose(run.wheel_segments[0].left_m, made.track.left_m, atol=1e-9)
    np.testing.assert_allclose(run.wheel_segments[0].right_m, made.track.right_m, atol=1e-9)


@pytest.mark.parametrize("late_ns", [0, 7_000_000])
def test_each_joint_may_come_in_messages_of_its_own(tmp_path: Path, log: Path, late_ns: int) -> None:
    """At the same times as the other, or between them; the wheels roll evenly, so that a line between two is right."""
    made = BagOfLog.of(log).mount().camera_info().apriltag_msgs().joints()
    sent = []
    for each in made.sent:
        if each.topic != "/joint_states":
            sent.append(each)
            continue
        for i, late in ((0, 0), (2, late_ns)):
            stamp = each.fields["header"]["stamp"]
            own = {
                "header": header(stamp["sec"] * 10**9 + stamp["nanosec"] + late, ""),
                "name": [each.fields["name"][i]],
                "position": [each.fields["position"][i]],
            }
            sent.append(each._replace(fields=each.fields | own))
    _, run = import_run(sent, tmp_path, SIZED, wheel_radius_m=0.1, track_width_m=0.5)
    (track,) = run.wheel_segments
    (whole,) = made.run.wheel_segments
    there = whole.at(track.stamps_ns)
    assert len(track.stamps_ns) == len(whole.stamps_ns) - (late_ns > 0)
    np.testing.assert_allclose(np.diff(track.left_m), np.diff(there[0]), atol=1e-9)
    np.testing.assert_allclose(np.diff(track.right_m), np.diff(there[1]), atol=1e-9)


def test_joints_of_different_times_are_no_wheels(tmp_path: Path, log: Path) -> None:
    made = BagOfLog.of(log).mount().camera_info().apriltag_msgs().joints()
    middle_ns = int(np.median(made.track.stamps_ns))
    sent = []
    for each in made.sent:
        if each.topic == "/joint_states":
            i = 0 if each.received_ns < middle_ns else 2
            own = {name: [each.fields[name][i]] for name in ("name", "position")}
            each = each._replace(fields=each.fields | own)
        sent.append(each)
    with pytest.raises(GroundsbotError, match="wheel_left and wheel_right were not published at the same time"):
        import_run(sent, tmp_path, SIZED, wheel_radius_m=0.1, track_width_m=0.5)


def test_a_list_shorter_than_its_type_is_an_error_of_one_line(tmp_path: Path, log: Path) -> None:
    bag = good(log).write(tmp_path / "drive")
    with pytest.raises(GroundsbotError, match="not as its type should be: list index out of range"), open_bag(bag):
        raise IndexError("list index out of range")


def test_poses_about_the_base_need_no_camera(tmp_path: Path, log: Path) -> None:
    made = BagOfLog.of(log).odometry()
    pose = {"pose": {"pose": {"position": {"x": 3.0, "y": -1.0, "z": 0.4}}}}
    stamp_ns = int(made.track.stamps_ns[3])
    detection = {"family": "36h11", "id": 5, "pose": pose}
    fields = {"header": header(stamp_ns, BASE), "detections": [detection]}
    made.add("/tags", "isaac_ros_apriltag_interfaces/msg/AprilTagDetectionArray", stamp_ns, fields)
    _, run = import_run(made.sent, tmp_path, BagOptions())
    np.testing.assert_allclose(run.positions.value, [[3.0, -1.0]])
    assert not run.positions.in_camera.any()
    assert run.tags == (TagKey("tag36h11", 5),)


def test_corners_of_the_older_definition_are_eight_numbers() -> None:
    """apriltag_msgs had `float64[8] corners` once; bags with definitions say so."""
    corners = np.array([10.0, 40.0, 40.0, 41.0, 41.0, 11.0, 11.0, 10.0])
    detection = SimpleNamespace(family="tag36h11", id=3, hamming=1, decision_margin=9.0, corners=corners)
    unknown = SimpleNamespace(**{**vars(detection), "family": "tagStandard41h12"})
    beyond = SimpleNamespace(**{**vars(detection), "id": 587})
    content = SimpleNamespace(header=SimpleNamespace(frame_id="/cam"), detections=[detection, unknown, beyond, beyond])
    look, left_out = read_picture(APRILTAG_MSGS, content, 5, "tag36h11")
    (seen,) = look.tags
    assert seen.corners_px is not None
    assert (look.stamp_ns, look.frame, seen.tag_id, seen.hamming) == (5, "cam", 3, 1)
    np.testing.assert_allclose(seen.corners_px, [[10.5, 9.5], [40.5, 10.5], [39.5, 40.5], [9.5, 39.5]])
    assert left_out == {"family 'tagStandard41h12' is unknown": 1, "tag36h11 has no tag 587": 2}


def fixed_frames(*links: tuple[str, str, Sequence[float]]) -> FixedFrames:
    """Links without turns, one message each."""
    frames = FixedFrames("bag")
    for parent, child, (x, y, z) in links:
        transform = {"translation": {"x": x, "y": y, "z": z}, "rotation": {"w": 1.0}}
        fields = {"transforms": [{"header": header(0, parent), "child_frame_id": child, "transform": transform}]}
        frames.add(make_message(STORE2, "tf2_msgs/msg/TFMessage", fields))
    return frames


def test_frames_are_joined_through_their_common_parent() -> None:
    frames = fixed_frames(
        ("base_footprint", "base_link", (0, 0, 0.1)),
        ("base_link", "/mast", (0.2, 0, 0)),
        ("mast", "camera", (0, 0.05, 0.3)),
        ("odom", "base_footprint", (1, 0, 0)),
        ("odom", "base_footprint", (2, 0, 0)),
    )
    assert frames.are_connected("base_footprint", "camera")
    assert frames.are_connected("camera", "base_link")
    np.testing.assert_allclose(frames.transform("base_link", "camera").apply([0, 0, 1]), [0.2, 0.05, 1.3])
    assert not frames.are_connected("odom", "camera")
    assert frames.moving_root("camera") == "base_footprint"


def test_frames_in_a_circle_come_to_an_end() -> None:
    frames = fixed_frames(("a", "b", (0, 0, 1)), ("b", "a", (0, 0, 1)))
    assert not frames.are_connected("a", "camera")


def test_a_mount_is_the_transform_it_came_from() -> None:
    mount = Mount(x_m=0.2, y_m=-0.1, z_m=0.4, yaw_rad=2.0, pitch_rad=-0.6, roll_rad=0.3)
    found = mount_of(mount.T_base_camera)
    np.testing.assert_allclose(found.T_base_camera.as_matrix(), mount.T_base_camera.as_matrix(), atol=1e-12)
    with pytest.raises(GroundsbotError, match="the camera is 11 m from its base, limit 10 m"):
        mount_of(RigidTransform.from_components([0.0, 11.0, 0.0], Rotation.identity()))


@pytest.mark.parametrize(
    ("covariance", "is_sane"),
    [
        (np.diag([0.01, 0.02, 0.03]), True),
        (np.array([[0.02, 0.005, 0.0], [0.005, 0.02, 0.0], [0.0, 0.0, 1.0]]), True),
        (np.zeros((3, 3)), False),
        (np.diag([0.01, 0.02, 0.0]), False),
        (np.diag([0.01, -0.02, 0.03]), False),
        (np.array([[0.02, 0.005, 0.0], [0.001, 0.02, 0.0], [0.0, 0.0, 0.1]]), False),
        (np.full((3, 3), np.nan), False),
        (np.diag([1e-12, 1e-12, 1e-12]), False),
        (np.eye(3) * 1e4, False),
    ],
)
def test_covariances_are_used_where_they_are_some(covariance: np.ndarray, is_sane: bool) -> None:
    seen = BagTag("tag36h11", 1, position_m=np.array([0.1, 0.2, 4.0]), covariance=covariance)
    planar = planar_covariance(seen, Rotation.from_matrix([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]))
    assert (planar is not None) == is_sane
    if planar is not None:  # forward is the camera's z, left its -x
        np.testing.assert_allclose(np.diag(planar), [covariance[2, 2], covariance[0, 0]])


GREY = np.add.outer(np.arange(40), np.arange(60)).astype(np.uint8)


def encode(encoding: str) -> np.ndarray:
    colour = cv2.cvtColor(GREY, cv2.COLOR_GRAY2BGR)
    wide = GREY.astype(np.uint16) * 256 + 255
    forms = {
        "mono16": wide.astype("<u2").view(np.uint8),
        "rgb8": colour.reshape(40, -1),
        "bgra8": cv2.cvtColor(colour, cv2.COLOR_BGR2BGRA).reshape(40, -1),
        "bayer_grbg8": GREY,
        "yuv422": np.stack([np.full_like(GREY, 128), GREY], axis=-1).reshape(40, -1),
        "yuv422_yuy2": np.stack([GREY, np.full_like(GREY, 128)], axis=-1).reshape(40, -1),
    }
    return forms[encoding]


@pytest.mark.parametrize("encoding", ["mono16", "rgb8", "bgra8", "bayer_grbg8", "yuv422", "yuv422_yuy2"])
def test_pictures_of_many_encodings_become_grey(encoding: str) -> None:
    rows = np.pad(encode(encoding), ((0, 0), (0, 3)))
    fields = {"height": 40, "width": 60, "encoding": encoding, "step": rows.shape[1], "data": rows.ravel()}
    picture = picture_of("bag", IMAGE, make_message(STORE2, IMAGE, fields))
    assert isinstance(picture, np.ndarray)
    assert picture.shape == GREY.shape
    inner = (slice(2, -2), slice(2, -2))  # Bayer's edges are made up
    np.testing.assert_allclose(picture[inner].astype(int), GREY[inner].astype(int), atol=2)
    with pytest.raises(GroundsbotError, match="a picture of 60x41 in"):
        picture_of("bag", IMAGE, make_message(STORE2, IMAGE, fields | {"height": 41}))


def test_options_of_bags_are_refused_for_csv(tmp_path: Path, run: Program) -> None:
    (tmp_path / "odometry.csv").write_text("t_s,left_m_s,right_m_s\n0,0,0\n1,1,1\n")
    (tmp_path / "observations.csv").write_text("t_s,tag_id,x_m,y_m\n")
    outcome = run(
        "import", tmp_path, "-o", tmp_path / "logs", "--track-width-m", 0.5, "--tag-size-m", 0.1, "--receive-times"
    )
    assert outcome.code == 1
    assert "is not a bag, so --tag-size-m and --receive-times would have no effect" in outcome.err
