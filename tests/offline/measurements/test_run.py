"""One log becomes one run of measurements."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from google.protobuf.message import Message

from groundsbot.calib.camera.file import write_camera_yaml
from groundsbot.calib.geometry import se2
from groundsbot.calib.robot.robot_yaml import Robot, write_robot_yaml
from groundsbot.calib.tags.edges import outward
from groundsbot.offline.measurements.motion_model.wheel_segments import wheel_distances
from groundsbot.offline.measurements.run import RobotFile, load_run, read_robot_file
from groundsbot.offline.measurements.tags import TagKey
from groundsbot.onboard.log.head import log_head
from groundsbot.onboard.log.messages import TagObservation, TagObservations
from tests.offline.measurements.written_logs import (
    CORNERS,
    ROBOT,
    TWO_OBSERVATIONS,
    picture,
    pose_odometry,
    refusal,
    tag,
    wheel_odometry,
    wheels,
    write_log,
)
from tests.support.data.drives import CAMERA, FAMILY, START_NS, S, make_drive, make_robot


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
    assert all(track.stamps_ns.base is None for track in run.wheel_segments)  # does not keep the log's whole table
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
