"""The distribution and its programs, as an installation has them."""

import importlib
import importlib.metadata
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.installed import checkout_sources, install, output_of
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
    ("groundsbot.offline.cli", "live"),
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


def test_a_wheel_holds_every_file_and_works_beside_a_project_that_has_a_package_offline(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NUMBA_DISABLE_JIT", "1")  # a new installation would compile for longer than it runs
    sources = checkout_sources(tmp_path / "sources")
    installed = install(sources, tmp_path / "installed")
    wanted = files_below(sources, "calib", "fixtures", "offline", "onboard")
    wanted |= {path.name for path in (sources / "groundsbot").iterdir() if not path.is_symlink()}
    assert files_below(installed / "groundsbot", ".") == wanted
    (tmp_path / "project" / "offline").mkdir(parents=True)
    project = tmp_path / "project"
    (project / "offline" / "__init__.py").write_text("raise ImportError('not yours')")

    def run(*words: str) -> str:
        return output_of([sys.executable, *words], project, installed)

    code = "import pickle, groundsbot; from groundsbot.onboard.log import WheelEncoders; pickle.dumps(WheelEncoders());"
    where = run("-c", f"{code} [getattr(groundsbot, name) for name in groundsbot.__all__]; print(groundsbot.__file__)")
    assert Path(where.strip()).is_relative_to(installed)
    assert sorted(path.name for path in installed.iterdir() if path.suffix != ".dist-info") == ["bin", "groundsbot"]
    words = ("--world", "room", "--robots", "a", "--no-render", "--output", "logs")
    run("-m", "groundsbot.fixtures", "simulate", *words)
    assert (project / "logs" / "truth.json").is_file()
    assert "robot a, run seed0" in run("-m", "groundsbot.offline.cli", "info", "logs")


def files_below(folder: Path, *names: str) -> set[str]:
    """By their way from the folder; not what Python compiled."""
    paths = [path for name in names for path in (folder / name).rglob("*") if path.is_file()]
    return {str(path.relative_to(folder)) for path in paths if path.suffix != ".pyc"}
