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


# Contract, file and what it imports wrongly; nothing: the file itself is one too many.
BREAKS = [
    ("rooms of offline", "offline/sam/graph", "groundsbot.offline.mapping", "build_map"),
    ("inside sam", "offline/sam/factors/odometry_and_observations", "groundsbot.offline.sam", "solver"),
    ("rooms of onboard", "onboard/log/head", "groundsbot.onboard.recorder", "RecorderCore"),
    ("rooms of calib", "calib/camera/model", "groundsbot.calib.intrinsics", "calibrate_camera"),
    ("rooms of fixtures", "fixtures/worlds/world", "groundsbot.fixtures.drives", "Drive"),
    ("rooms are used by their public names", "offline/mapping/pipeline", "groundsbot.offline.sam.solver", "solve"),
    ("rooms are used by their public names", "offline/sam/graph", "groundsbot", "build_map"),
    ("offline touches no device", "offline/logs/info", "groundsbot.onboard.recorder", "RecorderCore"),
    ("offline touches no device", "offline/logs/info", "groundsbot.onboard.process", "RunClock"),
    ("fixtures -> offline -> onboard -> calib", "calib/robot/robot_yaml", "groundsbot.onboard.log", "read_log"),
    ("rooms of offline", "offline/attic", "", ""),
    ("inside measurements", "offline/measurements/run", "groundsbot.offline.measurements.segment", "Segment"),
    ("log and detection touch no device", "onboard/log/head", "groundsbot.onboard.wheels", "EncoderPort"),
]


@pytest.fixture(scope="module")
def copy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("copy")
    for name in ("groundsbot", *PACKAGES, "tests/support"):
        shutil.copytree(ROOT / name, folder / name, symlinks=True, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", folder)
    return folder


def lint(folder: Path) -> str:
    """What the import linter says."""
    linter = "from importlinter.cli import lint_imports_command; lint_imports_command()"
    command = [sys.executable, "-c", linter, "--no-cache"]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False).stdout


def test_contracts_hold_and_each_can_break(copy: Path) -> None:
    assert "Contracts: 10 kept, 0 broken." in lint(copy)
    for _, file, module, name in BREAKS:
        with (copy / f"{file}.py").open("a", encoding="utf-8") as changed:
            changed.write(f"\nfrom {module} import {name}\n" if module else "")
    # A contract's name, underlined; then which modules break it.
    _, *parts = re.split(r"^(.+)\n-+\n", lint(copy), flags=re.MULTILINE)
    broken = dict(zip(parts[::2], parts[1::2], strict=True))
    for contract, file, module, _ in BREAKS:
        importer = f"groundsbot.{file.replace('/', '.')}"
        wanted = rf"\b{importer}( -> | \(l\. \d+\) imports ){module}\b" if module else rf"- {importer}\b"
        assert re.search(wanted, " ".join(broken[contract].split())), (contract, file, module)


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
