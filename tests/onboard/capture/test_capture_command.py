"""`groundsbot-onboard capture` as a program."""

import signal
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import pytest

from groundsbot.fixtures.recording.devices import PictureFolder
from groundsbot.onboard import cli
from groundsbot.onboard.recorder.robot_files import capture_settings
from tests.onboard.capture.shown_pictures import EMPTY, jpeg
from tests.support.board_views import render_views
from tests.support.devices.live_recording import PATIENCE_S, until
from tests.support.programs import running

ROBOT = """
robot_id: gb1
wheels: {radius_left_m: 0.05, radius_right_m: 0.05, track_m: 0.3, ticks_per_turn: 1024}
camera: camera.yaml
devices: {camera: camera}
"""
TWO_CAMERAS = """
robot_id: gb1
wheels: {radius_left_m: 0.05, radius_right_m: 0.05, track_m: 0.3, ticks_per_turn: 1024}
cameras:
  front: {camera: front.yaml, device: {camera: front}}
  left: {camera: left.yaml, device: {camera: left, camera_fps: 20}}
"""


def test_a_camera_among_several_is_chosen_by_name(tmp_path: Path) -> None:
    (tmp_path / "robot.yaml").write_text(TWO_CAMERAS)
    settings = capture_settings(tmp_path / "robot.yaml", "left", None)
    assert (settings.device, settings.fps) == (str(tmp_path / "left"), 20.0)


@contextmanager
def program(folder: Path, *options: str) -> Iterator["subprocess.Popen[str]"]:
    """`groundsbot-onboard capture` of a robot whose camera is a folder; it has no calibration yet."""
    (folder / "robot.yaml").write_text(ROBOT)
    command = [sys.executable, "-m", "groundsbot.onboard.cli", "capture", "--robot", str(folder / "robot.yaml")]
    command += ["--output", str(folder / "pictures"), *options]
    with running(command) as process:
        yield process


def hold_up(camera: PictureFolder, pictures: Path, process: "subprocess.Popen[str]", which: Iterable[int]) -> None:
    """Holds up one view after the other, each until it was taken."""
    for before, index in enumerate(which, start=len(list(pictures.glob("0*")))):
        picture = jpeg(render_views()[index])

        def taken(picture: bytes = picture, before: int = before) -> bool:
            camera.show(picture)
            time.sleep(0.05)
            return process.poll() is not None or len(list(pictures.glob("0*"))) > before

        until(taken, "a picture taken")


def test_the_program_takes_pictures_until_there_are_enough(tmp_path: Path) -> None:
    camera, pictures = PictureFolder(tmp_path / "camera", keep=20), tmp_path / "pictures"
    pictures.mkdir()
    for number, picture in enumerate(render_views()[:-2], start=1):  # of an earlier time
        (pictures / f"{number:04}.jpg").write_bytes(jpeg(picture))
    with program(tmp_path, "--views", "8") as process:
        hold_up(camera, pictures, process, [10, 11])
        said, _ = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, said
    lines = said.splitlines()
    assert "11 of 8: taken; bring the board nearer" in lines
    assert lines[-2:] == [f"{pictures}: 12 pictures", f"next: groundsbot-calib camera {pictures} -o camera.yaml"]
    assert sorted(each.name for each in pictures.iterdir()) == [f"{number:04}.jpg" for number in range(1, 13)]
    for path in (pictures / "0012.jpg", tmp_path / "capture.jpg"):
        assert cv2.imread(str(path)) is not None


@pytest.mark.parametrize("ending", [signal.SIGINT, signal.SIGTERM])
def test_ending_early_keeps_the_pictures_so_far(tmp_path: Path, ending: signal.Signals) -> None:
    camera = PictureFolder(tmp_path / "camera", keep=20)
    with program(tmp_path) as process:
        hold_up(camera, tmp_path / "pictures", process, range(2))
        process.send_signal(ending)
        said, _ = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 3, said
    assert f"{tmp_path / 'pictures'}: 2 pictures" in said
    assert "still missing: show the board at the picture's" in said
    assert sorted(each.name for each in (tmp_path / "pictures").iterdir()) == ["0001.jpg", "0002.jpg"]


def test_without_any_picture_it_fails(tmp_path: Path) -> None:
    camera = PictureFolder(tmp_path / "camera", keep=20)
    with program(tmp_path) as process:

        def looked() -> bool:
            camera.show(jpeg(EMPTY))
            time.sleep(0.05)
            return (tmp_path / "capture.jpg").exists()

        until(looked, "a look")
        process.send_signal(signal.SIGINT)
        said, _ = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 1
    assert f"{tmp_path / 'pictures'}: no picture was taken" in said
    assert not (tmp_path / "pictures").exists()


@pytest.mark.parametrize(
    ("robot", "options", "said"),
    [
        (None, [], "robot.yaml: cannot be read (No such file or directory)"),
        ("robot_id: gb1", [], "robot.yaml: wheels is missing"),
        (ROBOT.replace("{camera: camera}", "{encoder_port: wheels}"), [], "devices names no camera; give one"),
        (ROBOT, [], "is neither a folder of pictures, a video file nor under /dev"),
        (ROBOT.replace("{camera: camera}", "{camera: /dev/video77}"), [], "camera /dev/video77 is missing"),
        (
            ROBOT.replace("{camera: camera}", "{camera: robot.yaml}"),
            [],
            "robot.yaml cannot be opened; give a file that",
        ),
        (ROBOT.replace("camera: camera.yaml", "camera: robot.yaml"), [], "image_width is missing"),
        (ROBOT, ["--board", "7x9"], "board is '7x9' but must read like 7x9-25mm-18mm-5x5_100"),
        (ROBOT, ["--views", "0"], "--views is 0 but must be at least 1"),
        (ROBOT, ["--size", "big"], "--size is 'big' but must read like 1280x720"),
        (ROBOT, ["--size", "0x720"], "--size is '0x720' but"),
        (ROBOT, ["--camera", "left"], "has no camera 'left'; choose one of its cameras: none by name"),
        (TWO_CAMERAS, [], "several cameras; choose one by --camera: front, left"),
        (TWO_CAMERAS, ["--camera", "rear"], "has no camera 'rear'; choose one of its cameras: front, left"),
    ],
)
@pytest.mark.usefixtures("signals_back")
def test_what_cannot_begin_is_one_line_and_nothing_written(
    tmp_path: Path,
    robot: str | None,
    options: list[str],
    said: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = tmp_path / "robot.yaml"
    if robot is not None:
        path.write_text(robot)
    words = ["capture", "--robot", str(path), "--output", str(tmp_path / "pictures"), *options]
    monkeypatch.setattr(sys, "argv", ["groundsbot-onboard", *words])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    told = capsys.readouterr()
    assert ended.value.code == 1
    assert told.err.startswith("error: ")
    assert told.err.count("\n") == 1
    assert said in told.err
    assert {each.name for each in tmp_path.iterdir()} <= {"robot.yaml"}
