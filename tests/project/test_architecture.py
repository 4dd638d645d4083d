"""docs/architecture.md names what is there; rooms have public names that others use, and contracts that can break."""

import ast
import importlib
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path
from types import ModuleType

import pytest

from tests.support.paths import ROOT

PAGE = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
PACKAGES = ("calib", "onboard", "offline", "fixtures")
ROOMS = sorted(path.parent for package in PACKAGES for path in (ROOT / package).glob("*/__init__.py"))
MOST_MODULES = 20


def module_of(folder: Path) -> str:
    return ".".join(("groundsbot", *folder.relative_to(ROOT).parts))


def definitions_of(path: Path) -> set[str]:
    """Names of a file's classes and functions, those of methods as Class.method."""
    found: set[str] = set()
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ClassDef):
            found |= {
                node.name,
                *(f"{node.name}.{each.name}" for each in node.body if isinstance(each, ast.FunctionDef)),
            }
        elif isinstance(node, ast.FunctionDef):
            found.add(node.name)
    return found


def test_files_that_the_page_names_are_there() -> None:
    paths = re.findall(r"`((?:calib|onboard|offline|fixtures|tests)/[\w./]+)`", PAGE)
    assert len(paths) > 60
    assert [path for path in paths if not (ROOT / path).exists()] == []


def test_functions_that_the_page_names_are_there() -> None:
    named = re.findall(r"`([\w/]+\.py)` `([A-Za-z][\w.]*)`", PAGE)
    assert len(named) > 25
    assert [(path, name) for path, name in named if name not in definitions_of(ROOT / path)] == []


def test_the_page_and_the_picture_name_every_room() -> None:
    picture = (ROOT / "docs" / "architecture.svg").read_text(encoding="utf-8")
    for room in ROOMS:
        assert f"`{room.name}`" in PAGE, room
        assert f">{room.name}<" in picture or room.parent.name == "fixtures", room


@pytest.mark.parametrize("room", ROOMS, ids=lambda room: f"{room.parent.name}.{room.name}")
def test_a_room_says_what_it_is_and_what_others_may_use(room: Path) -> None:
    module: ModuleType = importlib.import_module(module_of(room))
    assert module.__doc__
    if room.parent.name != "fixtures":  # the paper has no simulator
        assert re.search(r"\bIn: .*\bOut: .*\bpaper\b", module.__doc__, re.DOTALL)
    assert module.__all__ == sorted(module.__all__), "public names are listed by the alphabet"
    for name in module.__all__:
        assert getattr(module, name) is not None, name


def test_public_names_are_those_that_other_rooms_use() -> None:
    used: dict[str, set[str]] = {}
    files = [path for package in PACKAGES for path in (ROOT / package).rglob("*.py")]
    for path in [*files, ROOT / "groundsbot" / "__init__.pyi"]:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module:
                module = f"groundsbot.{node.module}" if node.level else node.module
                used.setdefault(module, set()).update(each.name for each in node.names)
    for room in ROOMS:
        public = set(importlib.import_module(module_of(room)).__all__)
        assert public == used.get(module_of(room), set()), room


def test_no_folder_is_crowded() -> None:
    for folder in {path.parent for package in (*PACKAGES, "tests") for path in (ROOT / package).rglob("*.py")}:
        assert len(list(folder.glob("*.py"))) <= MOST_MODULES, folder


@pytest.mark.parametrize(
    ("file", "line", "contract"),
    [
        ("offline/sam/graph.py", "from groundsbot.offline.mapping import build_map", "rooms of offline"),
        ("offline/sam/factors/odometry_and_observations.py", "from groundsbot.offline.sam import solver", "inside sam"),
        ("onboard/log/head.py", "from groundsbot.onboard.recorder import RecorderCore", "rooms of onboard"),
        ("calib/camera/model.py", "from groundsbot.calib.intrinsics import calibrate_camera", "rooms of calib"),
        ("fixtures/worlds/world.py", "from groundsbot.fixtures.drives import Drive", "rooms of fixtures"),
        (
            "offline/mapping/pipeline.py",
            "from groundsbot.offline.sam.solver import solve",
            "used by their public names",
        ),
        ("offline/logs/info.py", "from groundsbot.onboard.recorder import RecorderCore", "offline touches no device"),
        (
            "calib/robot/robot_yaml.py",
            "from groundsbot.onboard.log import read_log",
            "fixtures -> offline -> onboard -> calib",
        ),
        ("offline/attic.py", "", "rooms of offline"),
        (
            "offline/measurements/run.py",
            "from groundsbot.offline.measurements.segment import Segment",
            "inside measurements",
        ),
        ("offline/sam/graph.py", "from groundsbot import build_map", "used by their public names"),
        ("offline/logs/info.py", "from groundsbot.onboard.process import RunClock", "offline touches no device"),
        (
            "onboard/log/head.py",
            "from groundsbot.onboard.wheels import EncoderPort",
            "log and detection touch no device",
        ),
    ],
)
def test_contracts_break(tmp_path: Path, file: str, line: str, contract: str) -> None:
    found = lint(tmp_path, file, line)
    assert [told for told in found if contract in told and told.endswith("BROKEN")], found


def test_contracts_hold_without_that(tmp_path: Path) -> None:
    found = lint(tmp_path, "offline/sam/graph.py", "")
    assert not [told for told in found if told.endswith("BROKEN")]
    assert len([told for told in found if told.endswith("KEPT")]) == 10


def lint(tmp_path: Path, file: str, line: str) -> list[str]:
    """What the import linter says of a copy with one more line in a file."""
    for name in ("groundsbot", *PACKAGES, "tests/support"):
        shutil.copytree(ROOT / name, tmp_path / name, symlinks=True, ignore=shutil.ignore_patterns("__pycache__"))
    (tmp_path / "pyproject.toml").write_bytes((ROOT / "pyproject.toml").read_bytes())
    with (tmp_path / file).open("a", encoding="utf-8") as changed:
        changed.write(f"\n{line}\n")
    linter = "from importlinter.cli import lint_imports_command; lint_imports_command()"
    command = [sys.executable, "-c", linter, "--no-cache"]
    return subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False).stdout.splitlines()


def test_offline_may_use_log_and_detection_of_onboard_only() -> None:
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"][
        "contracts"
    ]
    (contract,) = [each for each in contracts if each["name"] == "offline touches no device"]
    forbidden = {name.removeprefix("groundsbot.onboard.") for name in contract["forbidden_modules"]}
    there = {
        path.stem for path in (ROOT / "onboard").iterdir() if path.suffix == ".py" or (path / "__init__.py").exists()
    }
    assert there - forbidden == {"__init__", "log", "detection", "errors"}
