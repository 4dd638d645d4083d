"""The distribution and its programs, as somebody who installs them meets them."""

import importlib
import importlib.metadata
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.paths import ROOT

HEAVY = ("numpy", "cv2", "scipy", "numba", "matplotlib", "google.protobuf", "reportlab")
COMMANDS = [
    ("groundsbot.calib.cli",),
    ("groundsbot.calib.cli", "board"),
    ("groundsbot.calib.cli", "tags"),
    ("groundsbot.calib.cli", "camera"),
    ("groundsbot.calib.cli", "check"),
    ("groundsbot.onboard.cli",),
    ("groundsbot.onboard.cli", "record"),
    ("groundsbot.onboard.cli", "check"),
    ("groundsbot.onboard.cli", "capture"),
    ("groundsbot.onboard.cli", "status"),
    ("groundsbot.offline.cli",),
    ("groundsbot.offline.cli", "map"),
    ("groundsbot.offline.cli", "calibrate"),
    ("groundsbot.offline.cli", "localize"),
    ("groundsbot.offline.cli", "import"),
    ("groundsbot.offline.cli", "info"),
    ("groundsbot.offline.cli", "salvage"),
    ("groundsbot.offline.cli", "detect"),
    ("groundsbot.offline.cli", "compare"),
    ("groundsbot.offline.cli", "export"),
    ("groundsbot.fixtures.__main__",),
    ("groundsbot.fixtures.__main__", "simulate"),
    ("groundsbot.fixtures.__main__", "demo"),
]


def test_help_of_every_command_loads_nothing_heavy() -> None:
    program = f"""
import contextlib, importlib, io, sys
wrong = []
for module, *words in {COMMANDS!r}:
    sys.argv = ["program", *words, "-h"]
    said = io.StringIO()
    try:
        with contextlib.redirect_stdout(said):
            importlib.import_module(module).main()
    except SystemExit as end:
        if end.code != 0 or "Usage:" not in said.getvalue():
            wrong.append(f"{{module}} {{words}}: exit {{end.code}}, said {{said.getvalue()!r}}")
    loaded = [name for name in {HEAVY!r} if name in sys.modules]
    if loaded:
        sys.exit(f"{{module}} {{words}} loaded {{loaded}}")
sys.exit("; ".join(wrong) or None)
"""
    found = subprocess.run([sys.executable, "-c", program], stderr=subprocess.PIPE, text=True, check=False, cwd=ROOT)
    assert found.returncode == 0, found.stderr


@pytest.mark.parametrize(
    "module",
    ["groundsbot.calib.cli", "groundsbot.onboard.cli", "groundsbot.offline.cli", "groundsbot.fixtures.__main__"],
)
def test_version_is_that_of_the_distribution(
    module: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["program", "--version"])
    with pytest.raises(SystemExit) as ended:
        importlib.import_module(module).main()
    assert ended.value.code == 0
    assert capsys.readouterr().out == f"groundsbot {importlib.metadata.version('groundsbot')}\n"


def test_every_command_is_among_those_whose_help_is_tested() -> None:
    from groundsbot.calib.cli import app as calib_app
    from groundsbot.fixtures.__main__ import app as fixtures_app
    from groundsbot.offline.cli import app as offline_app
    from groundsbot.onboard.cli import app as onboard_app

    registered = {
        (module, command.name or (command.callback.__name__ if command.callback else ""))
        for module, app in (
            ("groundsbot.calib.cli", calib_app),
            ("groundsbot.onboard.cli", onboard_app),
            ("groundsbot.offline.cli", offline_app),
            ("groundsbot.fixtures.__main__", fixtures_app),
        )
        for command in app.registered_commands
    }
    assert registered == {command for command in COMMANDS if len(command) == 2}


def test_simulate_works_from_an_installed_wheel_in_an_empty_folder(tmp_path: Path) -> None:
    built, installed, empty = tmp_path / "built", tmp_path / "installed", tmp_path / "empty"
    empty.mkdir()
    _run(
        [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(built), str(_sources(tmp_path))],
        empty,
    )
    (wheel,) = built.glob("groundsbot-*.whl")
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index", "--target", str(installed)]
    _run([*pip, str(wheel)], empty)
    where = _run([sys.executable, "-c", "import groundsbot.fixtures as f; print(f.__file__)"], empty, installed)
    assert Path(where.strip()).is_relative_to(installed)

    simulate = [
        sys.executable,
        "-m",
        "groundsbot.fixtures",
        "simulate",
        "--world",
        "room",
        "--seed",
        "0",
        "--no-render",
    ]
    _run([*simulate, "--output", "logs"], empty, installed)
    assert (empty / "logs" / "truth.json").is_file()
    _run([sys.executable, "-m", "groundsbot.offline.cli", "map", "logs", "-o", "map"], empty, installed)
    assert (empty / "map" / "tags.csv").read_text().startswith("tag_id,")


def _sources(tmp_path: Path) -> Path:
    """What git would ship, copied, so that a build leaves nothing behind in the tree."""
    sources = tmp_path / "sources"
    for name in _run(["git", "ls-files", "--cached", "--others", "--exclude-standard"], ROOT).splitlines():
        source, target = ROOT / name, sources / name
        target.parent.mkdir(parents=True, exist_ok=True)
        if source.is_symlink():
            target.symlink_to(source.readlink())
        elif source.is_file():
            target.write_bytes(source.read_bytes())
    return sources


def _run(command: list[str], folder: Path, first_on_path: Path | None = None) -> str:
    environment = dict(os.environ)
    if first_on_path is not None:
        environment["PYTHONPATH"] = str(first_on_path)
    found = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert found.returncode == 0, found.stdout + found.stderr
    return found.stdout
