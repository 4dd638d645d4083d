"""What an installation needs: versions of Python, the lock of the robot, and a line where a library is missing."""

import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from tests.support.paths import ROOT

VERSIONS = ["3.11", "3.12", "3.13"]
_PIN = re.compile(r"^([a-z0-9-]+)==(\S+)", re.MULTILINE)


def pins(name: str) -> set[tuple[str, str]]:
    return set(_PIN.findall((ROOT / name).read_text(encoding="utf-8")))


def test_the_robot_has_the_laptops_versions_of_all_that_it_needs() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    robot = pins("requirements-robot.lock")
    assert robot < pins("requirements.lock")
    needed = [*project["dependencies"], *project["optional-dependencies"]["robot"]]
    for requirement in needed:
        name = re.split(r"[<>=!; ]", requirement)[0].lower().replace("_", "-")
        assert name in {pinned for pinned, _ in robot}
    assert not {"numba", "matplotlib", "plotly", "rosbags"} & {pinned for pinned, _ in robot}


def test_versions_are_named_alike_everywhere() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    named = [each.removeprefix("Programming Language :: Python :: ") for each in project["classifiers"]]
    assert [each for each in named if re.fullmatch(r"3\.\d+", each)] == VERSIONS
    for page in ("README.md", "CONTRIBUTING.md", "docs/robot_computer.md"):
        assert "Python 3.11, 3.12 or 3.13" in (ROOT / page).read_text(encoding="utf-8")


@pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")
@pytest.mark.parametrize("version", VERSIONS)
def test_make_takes_the_python_that_is_there(tmp_path: Path, version: str) -> None:
    interpreter = tmp_path / f"python{version}"
    interpreter.write_text(f"#!/bin/sh\necho python{version}\n")
    interpreter.chmod(0o755)
    command = [shutil.which("make") or "make", "-n", "setup", f"VENV={tmp_path / 'new'}"]
    environment = {"PATH": str(tmp_path)}
    told = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=True)
    assert told.stdout.startswith(f"python{version} -m venv {tmp_path / 'new'}")
    interpreter.unlink()
    told = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert told.returncode != 0
    assert "no python3.11, python3.12 or python3.13 found" in told.stderr


def test_without_numba_a_command_of_the_laptop_is_one_line(tmp_path: Path, room: Path) -> None:
    program = "import sys; sys.modules['numba'] = None; from groundsbot.offline.cli import main; main()"
    command = [sys.executable, "-c", program, "map", str(room / "a"), "-o", str(tmp_path / "map")]
    told = subprocess.run(command, capture_output=True, text=True, check=False)
    assert told.returncode == 1
    (line,) = told.stderr.strip().splitlines()
    assert line.startswith("error: numba is not installed")
    assert "groundsbot[laptop]" in line
    assert not (tmp_path / "map").exists()
