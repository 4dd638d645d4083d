"""robot.yaml: good, with defaults, and with each thing that can be wrong; and its documentation."""

import math
import re
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import yaml
from pydantic import BaseModel

from groundsbot.calib.errors import CalibError
from groundsbot.calib.foundation.yaml_file import parse_mapping, validate
from groundsbot.calib.robot.camera_section import CameraSection, Mount
from groundsbot.calib.robot.recording_options import CameraDevice, Devices, RecorderOptions
from groundsbot.calib.robot.robot_yaml import (
    Gyro,
    Robot,
    TagBatch,
    Wheels,
    parse_robot_yaml,
    read_robot_yaml,
    write_robot_yaml,
)
from tests.support.paths import ROOT

DOCUMENTATION = ROOT / "docs" / "robot_yaml.md"
SECTIONS: dict[str, type[BaseModel]] = {
    "The robot": Robot,
    "wheels": Wheels,
    "mount": Mount,
    "cameras": CameraSection,
    "device": CameraDevice,
    "tags": TagBatch,
    "gyro": Gyro,
    "devices": Devices,
    "recorder": RecorderOptions,
}
SMALLEST = """\
robot_id: a
wheels: {radius_left_m: 0.05, radius_right_m: 0.04, track_m: 0.3, ticks_per_turn: 4096}
"""


def document(heading: str) -> str:
    """The text of one section of the documentation."""
    text = DOCUMENTATION.read_text(encoding="utf-8")
    return next(part for part in re.split(r"^## ", text, flags=re.MULTILINE) if part.startswith(f"{heading}\n"))


def example() -> str:
    found = re.search(r"```yaml\n(.*?)```", document("Example"), flags=re.DOTALL)
    assert found
    return found[1]


def test_the_documented_example_is_read() -> None:
    robot = parse_robot_yaml(example(), "robot.yaml")
    assert robot.wheels.radius_left_m_sigma == pytest.approx(0.0502 * 0.005)
    assert robot.wheels.radius_right_m_sigma == 0.0001
    assert robot.wheels.track_m_sigma == pytest.approx(0.312 * 0.01)
    assert (robot.camera, robot.mount.pitch_rad, robot.readout_s) == ("camera.yaml", -0.05, 0.016)
    assert robot.tag_size_m("tag36h11", 3) == (0.15, 0.0005, "office printer")
    for tag_id, size_m in {40: 0.298, 41: 0.2985}.items():
        found_m, sigma_m, batch = robot.tag_size_m("tag36h11", tag_id)
        assert (found_m, batch) == (size_m, "print shop")
        assert sigma_m == pytest.approx(0.001 * size_m / 0.2985)


@pytest.mark.parametrize("heading", SECTIONS)
def test_the_documentation_lists_every_field_with_its_default(heading: str) -> None:
    rows = re.findall(r"^\| `(\w+)` \| (.*?) \|.*\|$", document(heading), flags=re.MULTILINE)
    fields = SECTIONS[heading].model_fields
    assert [name for name, _ in rows] == list(fields)
    for name, default in rows:
        if fields[name].is_required():
            assert default == "required"
            continue
        share = re.fullmatch(r"(\S+) % of the \w+", default)
        if share:  # worked out on a part of size 1
            batch = TagBatch(default_size_m=1.0)
            wheels = Wheels(radius_left_m=1.0, radius_right_m=1.0, track_m=1.0, ticks_per_turn=1.0)
            assert (batch.model_dump() | wheels.model_dump())[name] == pytest.approx(float(share[1]) / 100)
            continue
        value = fields[name].get_default(call_default_factory=True)
        if isinstance(value, BaseModel):
            assert default == "as below"
        elif value is None or value in ([], {}):
            assert default == "none"
        elif isinstance(value, float):
            assert float(default) == pytest.approx(value, rel=1e-3), name
        else:
            assert yaml.safe_load(default) == value


def test_a_robot_of_wheels_alone() -> None:
    robot = parse_robot_yaml(SMALLEST, "robot.yaml")
    assert robot.camera is None
    assert robot.wheels.radius_right_m_sigma == pytest.approx(0.0002)
    assert robot.mount.yaw_rad_sigma == pytest.approx(math.radians(0.5))
    assert robot.wheels.metres_per_tick == pytest.approx((2 * math.pi * 0.05 / 4096, 2 * math.pi * 0.04 / 4096))


@pytest.mark.parametrize("text", [SMALLEST, example()], ids=["smallest", "example"])
def test_what_is_written_comes_back(text: str, tmp_path: Path) -> None:
    robot = parse_robot_yaml(text, "robot.yaml")
    write_robot_yaml(robot, tmp_path / "robot.yaml")
    assert read_robot_yaml(tmp_path / "robot.yaml") == robot


TWO_CAMERAS = """\
cameras:
  front: {camera: front.yaml, mount: {x_m: 0.1}, device: {camera: /dev/video0, camera_fps: 30}}
  left: {camera: left.yaml, mount: {yaw_rad: 1.5}, edge_shift_px: 0.1, device: {camera: /dev/video2}}
"""


def test_each_of_two_cameras_is_that_of_a_robot_with_one(tmp_path: Path) -> None:
    """By field, whatever the one and the other write; the fields at the top are the first camera's."""
    robot = parse_robot_yaml(SMALLEST + TWO_CAMERAS, "robot.yaml")
    assert (robot.camera_names, robot.camera, robot.devices.camera_fps) == (("front", "left"), "front.yaml", 30.0)
    one = SMALLEST + "camera: left.yaml\nmount: {yaw_rad: 1.5}\nedge_shift_px: 0.1\ndevices: {camera: /dev/video2}"
    single = parse_robot_yaml(one, "robot.yaml")
    assert robot.with_camera("left") == single
    assert robot.with_camera("left").model_dump_json() == single.model_dump_json()
    assert (single.camera_names, single.with_camera("")) == (("",), single)
    with pytest.raises(CalibError, match="has no camera 'rear'; choose one of its cameras: front, left"):
        robot.with_camera("rear")
    assert Robot.model_validate_json(robot.model_dump_json()) == robot
    write_robot_yaml(robot, tmp_path / "robot.yaml")
    assert read_robot_yaml(tmp_path / "robot.yaml") == robot


def test_camera_looks_ahead_and_turns_as_documented() -> None:
    ahead, up = [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]  # in the optical frame

    def turned(vector: list[float], **mount: float) -> np.ndarray:
        return np.asarray(Mount(**mount).T_base_camera.rotation.apply(vector))

    np.testing.assert_allclose(turned(ahead), [1, 0, 0], atol=1e-15)
    np.testing.assert_allclose(turned(up), [0, 0, 1], atol=1e-15)
    half = math.sqrt(0.5)
    np.testing.assert_allclose(turned(ahead, yaw_rad=math.pi / 4), [half, half, 0], atol=1e-15)  # to the left
    np.testing.assert_allclose(turned(ahead, pitch_rad=math.pi / 4), [half, 0, -half], atol=1e-15)  # down
    np.testing.assert_allclose(turned(up, roll_rad=math.pi / 4), [0, -half, half], atol=1e-15)  # to the right
    # A quarter turn left, then nose down, still looks straight down; its top looks left.
    straight_down = {"yaw_rad": math.pi / 2, "pitch_rad": math.pi / 2}
    np.testing.assert_allclose(turned(ahead, **straight_down), [0, 0, -1], atol=1e-15)
    np.testing.assert_allclose(turned(up, **straight_down), [0, 1, 0], atol=1e-15)
    mount = Mount(x_m=0.1, y_m=-0.02, z_m=0.4, yaw_rad=math.pi / 2)
    np.testing.assert_allclose(mount.T_base_camera.apply([0.0, 0.0, 2.0]), [0.1, 1.98, 0.4], atol=1e-15)


def test_a_tag_without_a_size_names_what_to_add() -> None:
    robot = parse_robot_yaml(SMALLEST + "tags: [{sizes_m: {3: 0.2}}]", "robot.yaml")
    assert robot.tag_size_m("tag36h11", 3) == (0.2, 0.005 * 0.2, "default")
    for family, tag_id in [("tag36h11", 4), ("tag25h9", 3)]:
        with pytest.raises(CalibError, match=rf"robot a: .*{family} tag {tag_id}; add default_size_m or sizes_m"):
            robot.tag_size_m(family, tag_id)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("robot_id: a", ["wheels", "missing"]),
        (SMALLEST.replace("robot_id: a", "robot_id: 7"), ["robot_id", "7", "string"]),
        (SMALLEST.replace("robot_id: a", "robot_id: a/b"), ["robot_id", "'a/b'", "letters", "rename"]),
        (SMALLEST.replace("track_m: 0.3, ", ""), ["wheels.track_m", "missing"]),
        (SMALLEST.replace("0.05", "-0.05"), ["wheels.radius_left_m", "-0.05", "greater than 0"]),
        (SMALLEST.replace("0.05", "50"), ["wheels.radius_left_m", "50", "less than or equal to 10"]),
        (SMALLEST.replace("0.3", "0"), ["wheels.track_m", "0", "greater than 0"]),
        (SMALLEST.replace("0.3", ".nan"), ["wheels.track_m", "nan", "finite"]),
        (SMALLEST.replace("0.3", "no"), ["wheels.track_m", "'no'", "number"]),
        (SMALLEST.replace("0.3", "true"), ["wheels.track_m", "True", "number"]),
        (SMALLEST.replace("4096", "0"), ["wheels.ticks_per_turn", "0", "greater than 0"]),
        (SMALLEST.replace("0.3", "0.3, track_m_sigma: 0"), ["wheels.track_m_sigma", "0", "greater than 0"]),
        ("robot_id: a\nwheels: 3", ["wheels", "3", "field: value"]),
        (SMALLEST + "mount: {yaw_rad: 30}", ["mount.yaw_rad", "30", "2 pi", "radians"]),
        (SMALLEST + "mount: {yaw_deg: 30}", ["mount.yaw_deg", "30", "yaw_rad"]),
        (SMALLEST + "mount: {z_m: 450}", ["mount.z_m", "450", "10"]),
        (SMALLEST + "mount: {x_m: }", ["mount.x_m", "None", "number"]),
        (SMALLEST + "camera: ''", ["camera", "''", "1 character"]),
        (SMALLEST + "devices: {camera: ''}", ["devices.camera", "''", "1 character"]),
        (SMALLEST + "devices: {encoder_port: ''}", ["devices.encoder_port", "''", "1 character"]),
        (SMALLEST + "readout_s: -0.01", ["readout_s", "-0.01", "greater than or equal to 0"]),
        (SMALLEST + "time_offset_s: .inf", ["time_offset_s", "inf", "finite"]),
        (SMALLEST + "tags: {family: tag36h11}", ["tags", "list"]),
        (SMALLEST + "tags: [{family: tag36h12}]", ["tags[0].family", "'tag36h12'", "tag25h9"]),
        (SMALLEST + "tags: [{}]", ["tags[0]", "default_size_m", "outer edge"]),
        (SMALLEST + "tags: [{default_size_m: -0.15}]", ["tags[0].default_size_m", "-0.15", "greater than 0"]),
        (SMALLEST + "tags: [{default_size_m: 150}]", ["tags[0].default_size_m", "150", "10"]),
        (SMALLEST + "tags: [{default_size_m: big}]", ["tags[0].default_size_m", "'big'", "number"]),
        (SMALLEST + "tags: [{sizes_m: {3: 0}}]", ["tags[0].sizes_m[3]", "0", "greater than 0"]),
        (SMALLEST + "tags: [{sizes_m: {three: 0.1}}]", ["tags[0].sizes_m", "'three'", "integer"]),
        (
            SMALLEST + "tags: [{default_size_m: 0.1}, {default_size_m: 0.2, batch: b}]",
            ["tags[1].default_size_m", "tag36h11", "sizes_m"],
        ),
        (
            SMALLEST + "tags: [{sizes_m: {3: 0.1}}, {sizes_m: {3: 0.2}, batch: b}]",
            ["tags[1].sizes_m", "tag36h11 tag 3", "remove one"],
        ),
        (
            SMALLEST + "tags: [{family: tag25h9, default_size_m: 0.1}]",
            ["tags[0].family", "'tag25h9'", "recorder.families", "add it"],
        ),
        (SMALLEST + "devices: {encoder_baud: 9600.5}", ["devices.encoder_baud", "9600.5", "integer"]),
        (SMALLEST + "devices: {camera_fps: 0}", ["devices.camera_fps", "0", "greater than 0"]),
        (SMALLEST + "devices: {port: /dev/ttyUSB0}", ["devices.port", "/dev/ttyUSB0", "encoder_port"]),
        (SMALLEST + "recorder: {jpeg_quality: 101}", ["recorder.jpeg_quality", "101", "100"]),
        (SMALLEST + "recorder: {quad_decimate: 0.5}", ["recorder.quad_decimate", "0.5", "1"]),
        (SMALLEST + "recorder: {detector: aruco}", ["recorder.detector", "'aruco'", "pyapriltags"]),
        (SMALLEST + "recorder: {families: []}", ["recorder.families", "[]", "1 item"]),
        (SMALLEST + TWO_CAMERAS + "camera: a.yaml", ["camera is given beside cameras", "cameras.front.camera"]),
        (
            SMALLEST + TWO_CAMERAS + "devices: {camera_fps: 5}",
            ["devices.camera_fps", "front.device.camera_fps"],
        ),
        (SMALLEST + TWO_CAMERAS.replace("video2", "video0"), ["cameras.left.device.camera", "/dev/video0", "front"]),
        (SMALLEST + TWO_CAMERAS.replace("left:", "Left:"), ["cameras.Left", "'Left'", "[a-z]"]),
        (SMALLEST + TWO_CAMERAS.replace("{x_m", "{x_mm"), ["cameras.front.mount.x_mm", "did you mean x_m?"]),
        (SMALLEST + TWO_CAMERAS.replace("camera: left.yaml, ", ""), ["cameras.left.camera", "missing"]),
        (SMALLEST + "cameras: {}", ["cameras", "{}", "at least 1 item"]),
        (SMALLEST + "robot_id: b", ["line 3", "robot_id", "twice"]),
        (SMALLEST + "whels: 4", ["whels", "4", "did you mean wheels?"]),
        ("robot_id: [", ["line 1", "not valid YAML"]),
        ("? [1, 2]\n: 3", ["not valid YAML", "unhashable"]),
        ("robot_id: " + "1" * 5000, ["not valid YAML", "digits"]),
        ("robot_id: !!int abc", ["not valid YAML", "abc"]),
        ("robot_id: !!float abc", ["not valid YAML", "abc"]),
        ("robot_id: !!bool maybe", ["not valid YAML", "maybe"]),
        ("robot_id: !!timestamp abc", ["not valid YAML", "plain"]),
        ("a: &a [x]\nb: [" + "*a," * 17 + "]", ["line 2", "more than 16 aliases"]),
        ("", ["None", "field: value"]),
    ],
)
def test_a_bad_value_gives_one_clear_line(text: str, words: list[str]) -> None:
    with pytest.raises(CalibError) as caught:
        parse_robot_yaml(text, "somewhere/robot.yaml")
    message = str(caught.value)
    assert "\n" not in message
    for word in ["somewhere/robot.yaml: ", *words]:
        assert word in message
    assert "more after that" not in message  # one mistake, one error


def test_of_a_bad_value_only_what_is_shown_is_written_out() -> None:
    """Four levels of aliases make a quarter of a million words out of a thousand."""
    lists = "".join(f"a{level}: &a{level} [{f'*a{level - 1},' * 4}]\n" for level in range(1, 5))
    data = parse_mapping(f"a0: &a0 [{'x,' * 1000}]\n{lists}".replace("a4: &a4", "robot_id:"), "robot.yaml")
    tracemalloc.start()
    with pytest.raises(CalibError, match=r"robot_id is .*\.\.\. but must be"):
        validate(Robot, {"robot_id": data["robot_id"]}, "robot.yaml")
    _, peak_bytes = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak_bytes < 300_000


def test_a_missing_file_gives_one_clear_line(tmp_path: Path) -> None:
    with pytest.raises(CalibError, match=r"robot\.yaml: cannot be read \(No such file or directory\); check the path"):
        read_robot_yaml(tmp_path / "robot.yaml")


def test_a_file_that_would_take_minutes_is_refused_at_once() -> None:
    with pytest.raises(CalibError, match=r"long\.yaml: has \d+ characters, limit 131072"):
        parse_robot_yaml(SMALLEST + "# x\n" * 40_000, "long.yaml")
