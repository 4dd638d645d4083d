"""One log becomes one run of measurements, or a refusal that names file, field, value and way out."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from google.protobuf.message import Message

from groundsbot.calib.camera.file import write_camera_yaml
from groundsbot.calib.errors import GroundsbotError
from groundsbot.calib.geometry import se2
from groundsbot.calib.robot.robot_yaml import Robot, write_robot_yaml
from groundsbot.calib.tags.edges import outward
from groundsbot.offline.measurements.motion_model.wheel_segments import wheel_distances
from groundsbot.offline.measurements.run import RobotFile, load_run, read_robot_file
from groundsbot.offline.measurements.tags import TagKey
from groundsbot.onboard.log.head import log_head
from groundsbot.onboard.log.messages import (
    CameraCalibration,
    LogHead,
    PlanarOdometry,
    RunInfo,
    TagDetection,
    TagDetections,
    TagObservation,
    TagObservations,
    WheelEncoders,
)
from groundsbot.onboard.log.writing.writer import LogWriter
from tests.support.data.drives import CAMERA, FAMILY, START_NS, S, make_drive, make_robot, write_drive

ROBOT = make_robot(wheels={"radius_left_m": 0.1, "radius_right_m": 0.11, "track_m": 0.5, "ticks_per_turn": 1000.0})
CORNERS = [100.0, 100.0, 140.0, 100.0, 140.0, 140.0, 100.0, 140.0]


def write_log(
    folder: Path,
    messages: Sequence[tuple[str, Message]],
    head: LogHead | None = None,
    run_id: str = "one",
) -> Path:
    """Messages in the order given, a millisecond apart."""
    log = folder / run_id
    heads = head or log_head(ROBOT, ROBOT.model_dump_json(), CAMERA, run_id, START_NS, 0)
    with LogWriter(log, heads, START_NS, durable=False) as writer:
        for i, (topic, message) in enumerate(messages):
            writer.write(topic, message, START_NS + 1_000_000 * i, START_NS + 1_000_000 * i)
    return log


def wheels(at_s: float, left: int, right: int, boot: int = 1) -> tuple[str, WheelEncoders]:
    stamp_ns = START_NS + round(at_s * S)
    return "/wheels", WheelEncoders(stamp_ns=stamp_ns, boot_id=boot, ticks_left=left, ticks_right=right)


def picture(at_s: float, *tags: TagDetection, size: tuple[int, int] = (1280, 720)) -> tuple[str, TagDetections]:
    stamp_ns = START_NS + round(at_s * S)
    return "/tags/detections", TagDetections(
        stamp_ns=stamp_ns, width_px=size[0], height_px=size[1], detections=list(tags)
    )


def tag(tag_id: int, family: str = FAMILY, hamming: int = 0, corners: Sequence[float] = CORNERS) -> TagDetection:
    return TagDetection(family=family, tag_id=tag_id, hamming=hamming, corners_px=corners)


def wheel_odometry(at_s: float, left_m: float, right_m: float) -> tuple[str, PlanarOdometry]:
    distances = PlanarOdometry.WheelDistances(left_m=left_m, right_m=right_m)
    return "/odometry", PlanarOdometry(stamp_ns=START_NS + round(at_s * S), wheels=distances)


def pose_odometry(at_s: float, x_m: float, y_m: float, theta_rad: float) -> tuple[str, PlanarOdometry]:
    pose = PlanarOdometry.PoseInOdom(x_m=x_m, y_m=y_m, theta_rad=theta_rad)
    return "/odometry", PlanarOdometry(stamp_ns=START_NS + round(at_s * S), pose=pose)


def refusal(log: Path, robot_files: Mapping[str, RobotFile] | None = None) -> str:
    with pytest.raises(GroundsbotError) as caught:
        load_run(log, robot_files)
    text = str(caught.value)
    assert str(log) in text
    assert "\n" not in text
    return text


TWO_OBSERVATIONS = [wheels(0.0, 1000, -50), wheels(0.1, 1010, -30)]


def test_ticks_become_metres_by_each_wheels_radius(tmp_path: Path) -> None:
    run = load_run(write_log(tmp_path, TWO_OBSERVATIONS))
    (track,) = run.wheel_segments
    assert (run.name, run.robot_id, run.run_id) == ("carl_one", "carl", "one")
    assert track.stamps_ns.tolist() == [START_NS, START_NS + S // 10]
    np.testing.assert_allclose(track.left_m, [0.0, 10 * 2 * np.pi * 0.1 / 1000])
    np.testing.assert_allclose(track.right_m, [0.0, 20 * 2 * np.pi * 0.11 / 1000])
    assert track.quantum_m == pytest.approx(2 * np.pi * 0.11 / 1000)
    assert run.warnings == ()


def test_a_controller_reset_begins_a_new_segment(tmp_path: Path) -> None:
    observations = [*TWO_OBSERVATIONS, wheels(0.2, 0, 0, boot=2), wheels(0.3, 5, 5, boot=2), wheels(0.9, 7, 7, boot=3)]
    run = load_run(write_log(tmp_path, observations))
    assert [len(track.stamps_ns) for track in run.wheel_segments] == [2, 2, 1]
    (warning,) = run.warnings
    assert "restarted 2 times" in warning
    assert "3 segments" in warning


def test_a_gap_within_one_boot_is_bridged_by_the_counts(tmp_path: Path) -> None:
    run = load_run(write_log(tmp_path, [*TWO_OBSERVATIONS, wheels(9.0, 2000, 900)]))
    (track,) = run.wheel_segments
    assert track.left_m[-1] == pytest.approx(1000 * 2 * np.pi * 0.1 / 1000)


def test_observations_that_are_not_later_are_left_out_and_reported(tmp_path: Path) -> None:
    observations = [wheels(0.0, 0, 0), wheels(0.1, 5, 5), wheels(0.1, 6, 6), wheels(0.05, 4, 4), wheels(0.2, 9, 9)]
    run = load_run(write_log(tmp_path, observations))
    assert (run.wheel_segments[0].stamps_ns - START_NS).tolist() == [0, S // 10, S // 5]
    assert "2 wheel readings not later" in run.warnings[0]


def test_detections_keep_stamp_tag_and_corners(tmp_path: Path) -> None:
    seen = [picture(0.01, tag(7), tag(3)), picture(0.02), picture(0.03, tag(3, "tag25h9"))]
    run = load_run(write_log(tmp_path, [*TWO_OBSERVATIONS, *seen]))
    assert set(run.tags) == {TagKey(FAMILY, 3), TagKey(FAMILY, 7), TagKey("tag25h9", 3)}
    named = [(run.tags[i].family, run.tags[i].tag_id) for i in run.detections.tag]
    assert named == [(FAMILY, 7), (FAMILY, 3), ("tag25h9", 3)]
    np.testing.assert_array_equal(run.detections.corners_px, np.tile(np.reshape(CORNERS, (4, 2)), (3, 1, 1)))
    assert (run.picture_stamps_ns - START_NS).tolist() == [10_000_000, 20_000_000, 30_000_000]


def test_camera_stamps_that_run_ahead_are_set_back(tmp_path: Path) -> None:
    log = write_log(tmp_path, [*TWO_OBSERVATIONS, picture(0.01, tag(7)), picture(0.02)])
    write_robot_yaml(make_robot(time_offset_s=0.004), tmp_path / "robot.yaml")
    write_camera_yaml(CAMERA, tmp_path / "camera.yaml")
    run = load_run(log, {"carl": read_robot_file(tmp_path / "robot.yaml")})
    assert (run.picture_stamps_ns - START_NS).tolist() == [6_000_000, 16_000_000]
    assert (run.detections.stamps_ns - START_NS).tolist() == [6_000_000]


def test_imported_positions_that_run_ahead_are_set_back(tmp_path: Path) -> None:
    seen = TagObservation(family=FAMILY, tag_id=4, cartesian=TagObservation.Cartesian(x_m=1.0, y_m=2.0))
    messages: list[tuple[str, Message]] = [
        (
            "/tags/observations",
            TagObservations(stamp_ns=START_NS + stamp_ns, frame=frame, observations=[seen]),
        )
        for stamp_ns, frame in ((10_000_000, "base"), (20_000_000, "camera_planar"))
    ]
    robot = make_robot(time_offset_s=0.004)
    head = log_head(robot, robot.model_dump_json(), CAMERA, "one", START_NS, 0)
    run = load_run(write_log(tmp_path, [wheel_odometry(0.0, 0.0, 0.0), *messages, wheel_odometry(0.1, 0.1, 0.1)], head))
    assert (run.positions.stamps_ns - START_NS).tolist() == [6_000_000, 16_000_000]
    assert run.wheel_segments[0].stamps_ns[0] == START_NS


def test_a_run_is_retimed_but_for_its_wheels(tmp_path: Path) -> None:
    seen = TagObservation(family=FAMILY, tag_id=4, cartesian=TagObservation.Cartesian(x_m=1.0, y_m=2.0))
    sent = TagObservations(stamp_ns=START_NS + 30_000_000, frame="base", observations=[seen])
    run = load_run(
        write_log(tmp_path, [*TWO_OBSERVATIONS, picture(0.01, tag(7)), picture(0.02), ("/tags/observations", sent)])
    )
    other = run.shift_stamps(-0.003)
    assert (other.picture_stamps_ns - run.picture_stamps_ns).tolist() == [3_000_000] * 2
    assert (other.detections.stamps_ns - run.detections.stamps_ns).tolist() == [3_000_000]
    assert (other.positions.stamps_ns - run.positions.stamps_ns).tolist() == [3_000_000]
    np.testing.assert_array_equal(other.wheel_segments[0].stamps_ns, run.wheel_segments[0].stamps_ns)


def test_sides_that_a_camera_sees_too_far_out_are_set_back(tmp_path: Path) -> None:
    log = write_log(tmp_path, [*TWO_OBSERVATIONS, picture(0.01, tag(7)), picture(0.02)])
    write_robot_yaml(make_robot(edge_shift_px=-0.25), tmp_path / "robot.yaml")
    write_camera_yaml(CAMERA, tmp_path / "camera.yaml")
    run = load_run(log, {"carl": read_robot_file(tmp_path / "robot.yaml")})
    plain = np.reshape(CORNERS, (1, 4, 2))
    np.testing.assert_allclose(run.detections.corners_px, plain + 0.25 * outward(plain))


@pytest.mark.parametrize(
    ("settings", "refined"),
    [
        (["corners=sides,lens", "corners=sides"], True),
        (["corners=sides,lens", "corners=library"], False),
        ([""], False),
        ([], False),
    ],
)
def test_whether_corners_were_refined_is_in_the_detector_settings(
    tmp_path: Path, settings: list[str], refined: bool
) -> None:
    pictures = [picture(0.01 * (i + 1), tag(7)) for i in range(len(settings))]
    for (_, message), each in zip(pictures, settings, strict=True):
        message.detector_settings = f"families={FAMILY} {each}"
    assert load_run(write_log(tmp_path, [*TWO_OBSERVATIONS, *pictures])).corners_refined is refined


def test_corrected_codes_are_phantoms(tmp_path: Path) -> None:
    seen = picture(0.01, tag(7, hamming=1), tag(8), tag(9, corners=CORNERS[:6]))
    run = load_run(write_log(tmp_path, [*TWO_OBSERVATIONS, seen]))
    assert run.tags == (TagKey(FAMILY, 8),)


def test_pictures_of_another_size_are_left_out_and_reported(tmp_path: Path) -> None:
    seen = [picture(0.01, tag(1)), picture(0.02, tag(2), size=(640, 360)), picture(0.03, tag(3))]
    run = load_run(write_log(tmp_path, [*TWO_OBSERVATIONS, *seen]))
    assert [key.tag_id for key in run.tags] == [1, 3]
    assert "1 picture of another size" in run.warnings[0]


def test_wheel_distances_and_observations_of_an_imported_log(tmp_path: Path) -> None:
    stamp_ns = START_NS + S // 20
    cartesian = TagObservation(
        family=FAMILY, tag_id=4, cartesian=TagObservation.Cartesian(x_m=1.0, y_m=2.0), covariance=[0.1, 0.0, 0.0, 0.2]
    )
    polar = TagObservation(family=FAMILY, tag_id=2, polar=TagObservation.Polar(range_m=3.0, bearing_rad=0.4))
    messages: list[tuple[str, Message]] = [
        wheel_odometry(0.0, 5.0, 6.0),
        wheel_odometry(0.1, 5.1, 6.2),
        ("/tags/observations", TagObservations(stamp_ns=stamp_ns, frame="base", observations=[cartesian])),
        ("/tags/observations", TagObservations(stamp_ns=stamp_ns, frame="camera_planar", observations=[polar])),
    ]
    run = load_run(write_log(tmp_path, messages))
    np.testing.assert_allclose(np.diff(run.wheel_segments[0].left_m), [0.1])
    np.testing.assert_allclose(np.diff(run.wheel_segments[0].right_m), [0.2])
    assert [key.tag_id for key in run.tags] == [2, 4]
    assert run.positions.tag.tolist() == [1, 0]
    assert run.positions.polar.tolist() == [False, True]
    assert run.positions.in_camera.tolist() == [False, True]
    np.testing.assert_array_equal(run.positions.value, [[1.0, 2.0], [3.0, 0.4]])
    np.testing.assert_array_equal(run.positions.covariance[0], np.diag([0.1, 0.2]))
    assert np.isnan(run.positions.covariance[1]).all()


def test_odometry_poses_become_the_wheels_that_drove_them(tmp_path: Path) -> None:
    drive = make_drive([1.0, 2.0, 3.0], [(0.5, 0.7, 1.0), (0.6, 0.2, 1.0)])
    messages = [pose_odometry(0.01 * i, *pose) for i, pose in enumerate(drive.T_world_base.tolist())]
    run = load_run(write_log(tmp_path, messages))
    np.testing.assert_allclose(run.wheel_segments[0].left_m, drive.left_m, atol=1e-9)
    np.testing.assert_allclose(run.wheel_segments[0].right_m, drive.right_m, atol=1e-9)
    assert run.warnings == ()


def test_sideways_motion_is_kept_apart() -> None:
    poses = se2.exp(np.arange(10)[:, None] * np.array([0.1, 0.02, 0.0]))
    left_m, right_m, lateral_m = wheel_distances(poses, 0.5)
    np.testing.assert_allclose([left_m[-1], right_m[-1], lateral_m[-1]], [0.9, 0.9, 0.18])


def test_a_given_robot_replaces_that_of_the_log(tmp_path: Path) -> None:
    log = write_log(tmp_path, TWO_OBSERVATIONS)
    other = make_robot(wheels={"radius_left_m": 0.2, "radius_right_m": 0.2, "track_m": 0.4, "ticks_per_turn": 1000.0})
    camera = replace(CAMERA, fx_px=500.0)
    write_robot_yaml(other, tmp_path / "robot.yaml")
    write_camera_yaml(camera, tmp_path / "camera.yaml")
    given = {"carl": read_robot_file(tmp_path / "robot.yaml")}
    run = load_run(log, given)
    assert run.robot == other
    assert run.camera is not None
    assert run.camera.fx_px == 500.0
    assert run.wheel_segments[0].left_m[-1] == pytest.approx(10 * 2 * np.pi * 0.2 / 1000)
    assert load_run(log, {"dora": given["carl"]}).robot == ROBOT


def test_a_log_without_wheels_is_refused(tmp_path: Path) -> None:
    text = refusal(write_log(tmp_path, [picture(0.0, tag(1))]))
    assert "/wheels" in text
    assert "0 messages" in text
    assert "check" in text


def test_tags_without_a_camera_are_refused(tmp_path: Path) -> None:
    head = log_head(ROBOT, ROBOT.model_dump_json(), None, "one", START_NS, 0)
    text = refusal(write_log(tmp_path, [*TWO_OBSERVATIONS, picture(0.05, tag(1))], head))
    assert "/camera/calibration" in text
    assert "--robot" in text


def test_a_camera_of_another_picture_size_is_refused(tmp_path: Path) -> None:
    text = refusal(write_log(tmp_path, [*TWO_OBSERVATIONS, picture(0.05, tag(1), size=(640, 480))]))
    for part in ("/tags/detections", "640x480", "/camera/calibration", "1280x720", "--robot"):
        assert part in text


def test_a_given_camera_of_another_picture_size_is_refused(tmp_path: Path) -> None:
    log = write_log(tmp_path, [*TWO_OBSERVATIONS, picture(0.05, tag(1))])
    text = refusal(log, {"carl": RobotFile(ROBOT, {"": CAMERA.resize(0.5)})})
    for part in ("1280x720", "--robot", "640x360"):
        assert part in text


def test_the_tags_of_all_cameras_are_read_each_by_the_numbers_of_its_own(tmp_path: Path) -> None:
    cameras = {"front": {"camera": "a.yaml"}, "left": {"camera": "b.yaml", "time_offset_s": 0.01, "edge_shift_px": 0.5}}
    robot = Robot.model_validate({"robot_id": "r", "wheels": ROBOT.wheels.model_dump(), "cameras": cameras})
    head = dict(log_head(robot, robot.model_dump_json(), dict.fromkeys(cameras, CAMERA), "one", START_NS, 0))
    seen = [(f"/tags/{name}/detections", picture(0.05, tag(1))[1]) for name in ("left", "front")]
    log = write_log(tmp_path, [*(each for each in TWO_OBSERVATIONS if "tags" not in each[0]), *seen], head)
    run = load_run(log)
    assert run.detections.camera.tolist() == [0, 1]
    front_ns, left_ns = run.detections.stamps_ns.tolist()
    assert front_ns - left_ns == 10_000_000
    front_px, left_px = run.detections.corners_px
    np.testing.assert_allclose(left_px, front_px - 0.5 * outward(front_px))
    text = refusal(log, {"r": RobotFile(ROBOT, {"": CAMERA})})
    assert "/tags/left/detections is of camera 'left', but robot.yaml describes a single camera; give the" in text


def test_a_calibration_that_is_none_is_refused(tmp_path: Path) -> None:
    head = dict(log_head(ROBOT, ROBOT.model_dump_json(), CAMERA, "one", START_NS, 0))
    for broken in (
        CameraCalibration(width=1280, height=720),
        CameraCalibration(width=1280, height=720, distortion_model="plumb_bob", K=[0.0] * 9, D=[0.0] * 5),
        CameraCalibration(width=1280, height=720, distortion_model="wavy", K=[9.0] * 9, D=[0.0] * 5),
    ):
        log = write_log(
            tmp_path, TWO_OBSERVATIONS, head | {"/camera/calibration": broken}, run_id=f"r{len(str(broken))}"
        )
        refusal(log)


def test_a_robot_that_cannot_be_is_refused_with_its_field(tmp_path: Path) -> None:
    broken = ROBOT.model_dump_json().replace('"default_size_m":0.15', '"default_size_m":-0.15')
    head = {"/run": RunInfo(run_id="one", robot_id="carl", robot_yaml=broken)}
    text = refusal(write_log(tmp_path, TWO_OBSERVATIONS, head))
    assert "default_size_m" in text
    assert "-0.15" in text


@pytest.mark.parametrize("name", ["", "../../home", "a/b", "a\\b", ".hidden", "two\nlines", "x" * 101])
def test_names_that_lead_out_of_the_output_folder_are_refused(tmp_path: Path, name: str) -> None:
    for field, run_id, robot_id in (("run_id", name, "fine"), ("robot_id", "fine", name)):
        info = RunInfo(run_id=run_id, robot_id=robot_id, robot_yaml=ROBOT.model_dump_json())
        text = refusal(write_log(tmp_path / field, TWO_OBSERVATIONS, {"/run": info}))
        assert f"/run: {field} is" in text


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e300])
@pytest.mark.parametrize("kind", ["wheels", "pose"])
def test_odometry_that_is_no_number_is_refused(tmp_path: Path, value: float, kind: str) -> None:
    good, bad = wheel_odometry(0.0, 0.0, 0.0), wheel_odometry(0.1, 0.1, value)
    if kind == "pose":
        good, bad = pose_odometry(0.0, 0.0, 0.0, 0.0), pose_odometry(0.1, 0.1, 0.0, value)
    text = refusal(write_log(tmp_path, [good, bad]))
    for part in ("/odometry", "right_m" if kind == "wheels" else "theta_rad", f"{value:g}", "reading 2"):
        assert part in text


@pytest.mark.parametrize("topic", ["/wheels", "/odometry"])
def test_times_before_zero_are_refused(tmp_path: Path, topic: str) -> None:
    observations: dict[str, list[Message]] = {
        "/wheels": [WheelEncoders(stamp_ns=at_ns, boot_id=1) for at_ns in (-1_500_000_000, 0)],
        "/odometry": [PlanarOdometry(stamp_ns=at_ns, wheels={}) for at_ns in (-1_500_000_000, 0)],
    }
    text = refusal(write_log(tmp_path, [(topic, each) for each in observations[topic]]))
    for part in (topic, "stamp_ns is -1500000000 in reading 1", "below 0"):
        assert part in text


@pytest.mark.parametrize("ticks", [10**9, -(2**62), 2**63 - 1])
def test_counts_that_no_wheel_can_have_made_are_refused(tmp_path: Path, ticks: int) -> None:
    text = refusal(write_log(tmp_path, [wheels(0.0, 0, 0), wheels(0.01, 0, ticks)]))
    for part in ("/wheels", "reading 2", "100 m/s", "--robot"):
        assert part in text


def test_a_fast_robot_is_not_refused(tmp_path: Path) -> None:
    drive = make_drive([0.0, 0.0, 0.0], [(20.0, 20.0, 1.0)], step_ns=S // 20)
    load_run(write_drive(tmp_path, drive))
