"""docs/robot_setup.md: every command on it, in its order and unchanged, from a bare robot to a first map."""

import re
import shlex
import signal
import subprocess
import sys
import threading
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import NamedTuple

import numpy as np
import yaml

from groundsbot.calib.camera.file import read_camera_yaml
from tests.support.devices.simulated_robot import SimulatedRobot
from tests.support.paths import ROOT

PAGE = ROOT / "docs" / "robot_setup.md"
PROGRAMS = {
    "groundsbot-calib": "groundsbot.calib.cli",
    "groundsbot-onboard": "groundsbot.onboard.cli",
    "groundsbot-offline": "groundsbot.offline.cli",
}
CAPTURE, CHECK, RECORD, STATUS = (("groundsbot-onboard", word) for word in ("capture", "check", "record", "status"))
FILES = {"yaml": "robot.yaml", "csv": "survey.csv"}
PATIENCE_S = 600.0  # on a fresh machine the first map has the solver compiled


class Block(NamedTuple):
    """What the page shows between fences: a file to write, or commands."""

    kind: str
    text: str


def blocks() -> list[Block]:
    found = re.findall(r"^```(\w+)\n(.*?)^```$", PAGE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    return [Block(*each) for each in found]


class Reader:
    """A user who follows the page in a folder, with a simulated robot."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.said: dict[str, str] = {}
        self.robot: SimulatedRobot | None = None
        self._recording: subprocess.Popen[str] | None = None

    def write(self, kind: str, text: str) -> None:
        """Writes a file as the page shows it, but for the names of the devices."""
        if kind == "yaml":
            content = yaml.safe_load(text)
            port, pictures = self.folder / "port", self.folder / "camera"
            self.robot = SimulatedRobot(content, port, pictures)
            text = text.replace(content["devices"]["encoder_port"], str(port))
            text = text.replace(content["devices"]["camera"], str(pictures))
        (self.folder / FILES[kind]).write_text(text, encoding="utf-8")

    def type(self, command: str) -> None:
        """Runs a command, while the robot does what the page says; a recording ends when its status has been asked."""
        program, word, *words = shlex.split(command)
        arguments = [sys.executable, "-m", PROGRAMS[program], word, *words]
        if (program, word) == RECORD:
            self._record(arguments)
            return
        with self._meanwhile(program, word, words):
            found = subprocess.run(
                arguments, cwd=self.folder, capture_output=True, text=True, check=False, timeout=PATIENCE_S
            )
        assert found.returncode == 0, f"{command}\n{found.stdout}{found.stderr}"
        self.said[command] = found.stdout
        if (program, word) == STATUS:
            self._end_recording()

    def _meanwhile(self, program: str, word: str, words: list[str]) -> AbstractContextManager[None]:
        if self.robot is not None and (program, word) == CAPTURE:
            return self.robot.shown_the_board(self.folder / words[words.index("--output") + 1])
        return self.robot.standing() if self.robot is not None and (program, word) == CHECK else nullcontext()

    def _record(self, arguments: list[str]) -> None:
        assert self.robot is not None
        self.robot.plug_in_again()
        self._recording = subprocess.Popen(
            arguments, cwd=self.folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        assert self._recording.stdout is not None
        heard = ""
        while not ("port_connected" in heard and "camera_connected" in heard):
            line = self._recording.stdout.readline()
            assert line, heard
            heard += line
        driving = threading.Thread(target=self.robot.drive, daemon=True)  # held up for good if the recorder dies
        driving.start()
        driving.join(PATIENCE_S)
        assert not driving.is_alive()

    def _end_recording(self) -> None:
        assert self._recording is not None
        self._recording.send_signal(signal.SIGINT)
        rest, _ = self._recording.communicate(timeout=PATIENCE_S)
        assert self._recording.returncode == 0, rest  # nothing was lost

    def leave(self) -> None:
        if self._recording is not None:
            self._recording.kill()
            self._recording.communicate()
        if self.robot is not None:
            self.robot.unplug()


def test_the_page_leads_from_a_bare_robot_to_a_first_map(tmp_path: Path) -> None:
    reader = Reader(tmp_path)
    try:
        for kind, text in blocks():
            if kind in FILES:
                reader.write(kind, text)
                continue
            assert kind == "sh"
            for command in text.splitlines():
                reader.type(command)
    finally:
        reader.leave()

    assert {each.name for each in tmp_path.iterdir()} >= {"board.pdf", "tags.pdf", "camera.yaml", "check.jpg", "map"}
    assert reader.robot is not None
    true, found = reader.robot.camera, read_camera_yaml(tmp_path / "camera.yaml")
    columns, rows = np.meshgrid(np.linspace(20, 620, 9), np.linspace(20, 460, 7))
    pixels = np.stack([columns, rows], axis=-1).reshape(-1, 2)
    assert np.abs(found.project(true.unproject(pixels)) - pixels).max() < 3.0  # a turn of all rays included
    compared = reader.said["groundsbot-offline compare map --survey survey.csv"]
    assert "4 surveyed tags, 4 fit" in compared
    scale = re.search(r"scale: (\S+) % against the survey \(sigma (\S+) %\)", compared)
    assert scale is not None, compared
    assert abs(float(scale[1])) < 3.0 * float(scale[2]) < 3.0


def test_the_page_shows_every_program_and_all_that_calibration_has() -> None:
    used = {tuple(line.split()[:2]) for kind, text in blocks() if kind == "sh" for line in text.splitlines()}
    assert {program for program, _ in used} == set(PROGRAMS)
    assert {word for program, word in used if program == "groundsbot-calib"} == {"board", "tags", "camera", "check"}
