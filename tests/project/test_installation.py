"""What an installation needs: versions of Python, the lock of the robot, and a line where a library is missing."""

import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
from scipy import special

from groundsbot.calib.foundation.error_function import erf
from tests.support.devices.live_recording import CORNERS, robot_yaml
from tests.support.paths import ROOT
from tests.support.tag_pictures import draw_tag

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
    assert not {"numba", "matplotlib", "plotly", "rosbags", "scipy"} & {pinned for pinned, _ in robot}


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
    assert told.stdout.splitlines()[1] == f"python{version} -m venv {tmp_path / 'new'}"
    interpreter.unlink()
    told = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert told.returncode != 0
    assert "no python3.11, python3.12 or python3.13 found" in told.stderr


@pytest.mark.parametrize(
    ("package", "module", "arguments"),
    [
        ("numba", "offline", ["map", "LOG", "-o", "map"]),
        ("scipy", "calib", ["camera", "pictures", "-o", "camera.yaml"]),
    ],
)
def test_a_command_of_the_laptop_is_one_line_on_a_robot(
    tmp_path: Path, room: Path, package: str, module: str, arguments: list[str]
) -> None:
    program = f"import sys; sys.modules[{package!r}] = None; from groundsbot.{module}.cli import main; main()"
    words = [str(room / "a") if each == "LOG" else each for each in arguments]
    told = subprocess.run(
        [sys.executable, "-c", program, *words], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert told.returncode == 1
    (line,) = told.stderr.strip().splitlines()
    assert line.startswith(f"error: {package} is not installed")
    assert "groundsbot[laptop]" in line
    assert not any(tmp_path.iterdir())


def test_a_robot_does_without_scipy(tmp_path: Path) -> None:
    """All of onboard is loaded, a tag is detected with its corners fitted, and a log is begun."""
    robot = robot_yaml(tmp_path, "{camera: pictures}")
    program = f"""
import sys
for each in ("scipy", "numba", "matplotlib", "plotly", "rosbags", "reportlab"):
    sys.modules[each] = None
from importlib import import_module
from pathlib import Path
import numpy as np
for room in ("camera", "capture", "detection", "log", "monitoring", "process", "recorder", "wheels"):
    module = import_module(f"groundsbot.onboard.{{room}}")
    for name in module.__all__:
        getattr(module, name)
from groundsbot.onboard.log import log_head
from groundsbot.onboard.recorder import RobotFiles
files = RobotFiles(Path({str(robot)!r}))
picture = np.load(Path({str(tmp_path / "tag.npy")!r}))
(found,) = files.cameras[0].detector_settings.make().detect(picture)
log_head(files.robot, files.text, files.models, "one", 1, 0)
print(found.tag_id)
"""
    np.save(tmp_path / "tag.npy", draw_tag("tag36h11", 9, CORNERS, (120, 160)))
    told = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert told.stdout == "9\n", told.stderr


def test_the_error_function_is_that_of_scipy() -> None:
    x = np.concatenate([np.linspace(-7.0, 7.0, 20_001), [np.inf, -np.inf, np.nan, 0.0]])
    np.testing.assert_allclose(erf(x), special.erf(x), rtol=0.0, atol=1e-12)
