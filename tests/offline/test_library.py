"""`import groundsbot` gives what docs/library.md describes, and does so at once."""

import builtins
import inspect
import re
import subprocess
import sys
from collections.abc import Iterator
from importlib.util import find_spec
from os import PathLike
from pathlib import Path
from typing import Any, get_args, get_origin, get_type_hints

import numpy as np
import pytest

import groundsbot
from groundsbot.offline.evaluation.against_truth import evaluate
from groundsbot.offline.localization.result import LocatedRun
from tests.support.data.drives import HALL, make_drive, make_robot, write_drive
from tests.support.data.maps import make_map, make_truth
from tests.support.paths import ROOT

COMMANDS = ("map", "localize", "export", "compare", "calibrate", "import")
FILE = re.compile(r"\.(json|csv|yaml|mcap|npz|png|html|tum|bag|db3|wpilog)$")
DOCUMENT = ROOT / "docs" / "library.md"
TAGS = [HALL[i] for i in (0, 1, 2, 4, 6, 7)]
DRIVES = [
    ("carl", "monday", [1.0, 1.5, 0.3]),
    ("dora", "monday", [4.0, 2.5, 2.9]),
    ("carl", "evening", [2.0, 2.0, -1.0]),
]
LEGS = [(0.4, 0.4, 2.0), (-0.3, 0.3, 6.0), (0.4, 0.5, 2.0)]


@pytest.fixture
def recordings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for robot, run_id, start in DRIVES:
        drive = make_drive(start, LEGS, step_ns=20_000_000)
        write_drive(tmp_path / "recordings", drive, TAGS, make_robot(robot), run_id=run_id, corner_sigma_px=0.2)
    monkeypatch.chdir(tmp_path)
    return tmp_path / "recordings"


def test_the_worked_example_runs_as_it_stands(recordings: Path, capsys: pytest.CaptureFixture[str]) -> None:
    blocks = re.findall(r"```python\n(.*?)```", DOCUMENT.read_text(encoding="utf-8"), re.DOTALL)
    assert len(blocks) == 11
    assert len([line for line in blocks[0].splitlines() if line]) <= 5
    names: dict[str, Any] = {}
    for block in blocks:
        exec(compile(block, str(DOCUMENT), "exec"), names)
    shown = re.findall(r"```text\n(.*?)```", DOCUMENT.read_text(encoding="utf-8"), re.DOTALL)
    out = without_numbers(capsys.readouterr().out)
    assert len(shown) == 7
    for text in shown:
        assert without_numbers(text) in out, text
    for made in ("map/map.json", "drawn.png", "map.g2o", "tables/tags.csv", "simulated/truth.json"):
        assert (recordings.parent / made).is_file()


def without_numbers(text: str) -> str:
    """A text without digits, blanks and signs, in which machines may differ."""
    return re.sub(r"[-\d\[\]. ]+", " ", text)


def test_the_library_gives_what_the_command_does(recordings: Path) -> None:
    from groundsbot.offline.commands.map_drives import MapOptions, make_map

    logs = groundsbot.find_logs([recordings])
    by_hand = groundsbot.build_map([groundsbot.load_run(log) for log in logs])
    by_command, _ = make_map(MapOptions(logs, recordings.parent / "map"))
    np.testing.assert_array_equal(by_hand.components[0].joint_covariance, by_command.components[0].joint_covariance)


def test_every_name_is_there_and_others_are_not() -> None:
    for name in groundsbot.__all__:
        assert getattr(groundsbot, name).__name__ == name
    assert not hasattr(groundsbot, "build_maps")


FUNCTIONS: list[Any] = [each for name in groundsbot.__all__ if inspect.isfunction(each := getattr(groundsbot, name))]
CLASSES: list[Any] = [each for name in groundsbot.__all__ if inspect.isclass(each := getattr(groundsbot, name))]
OPTIONS = [each for each in CLASSES if each.__name__.endswith("Options")]


def test_every_path_may_be_a_string() -> None:
    found = 0
    for function in (*FUNCTIONS, *OPTIONS):
        for name, hint in get_type_hints(function).items():
            kinds = list(flat(hint))
            found += PathLike in kinds
            assert name == "return" or Path not in kinds, f"{function.__name__}: {name}"
    assert found > 15


def flat(hint: Any) -> Iterator[Any]:
    """A type and all types in its brackets."""
    yield get_origin(hint) or hint
    for part in get_args(hint):
        yield from flat(part)


def test_results_print_as_one_short_line(recordings: Path) -> None:
    result = make_map()
    run = groundsbot.load_run(recordings / "carl" / "monday")
    located = LocatedRun("a", "a", result.runs[0].stamps_ns, result.runs[0].T_map_base, np.zeros((20, 3, 3)), (), 1.0)
    pose = groundsbot.OnlinePose(np.zeros(3), np.eye(3))
    (component,) = result.components
    shown = [result, component, result.tags[0], result.runs[0], run, located, pose]
    shown += [
        groundsbot.Localization(Path("map"), "red_one", 0, (located,)),
        *groundsbot.segments_of(run, result.noise),
    ]
    shown += [groundsbot.TagMeasurement("tag36h11", 3, np.zeros(2), np.eye(2)), evaluate(result, make_truth(component))]
    for each in shown:
        assert re.fullmatch(rf"<{type(each).__name__} ?.{{1,90}}>", repr(each).replace(f"{recordings}/", ""))
        assert "array(" not in repr(each)
    assert repr(result) == "<MapResult: 2 runs, 3 tags, 1 component>"


def test_every_name_in_a_public_docstring_exists() -> None:
    found = [
        (name, owner, each)
        for each in (*FUNCTIONS, *CLASSES)
        for owner in (each, *public_members(each))
        for name in names_in(inspect.getdoc(owner) or "")
    ]
    assert len(found) > 150
    assert [(each.__name__, name) for name, owner, each in found if not is_known(name, owner, each)] == []


def public_members(owner: Any) -> list[Any]:
    """Methods and properties of a class."""
    own = vars(owner).items() if inspect.isclass(owner) else ()
    members = [value.fget if isinstance(value, property) else value for name, value in own if not name.startswith("_")]
    return [each for each in members if inspect.isfunction(each)]


def names_in(text: str) -> list[str]:
    """What stands in backquotes and is an identifier, and the names under Args, Attributes and Raises."""
    quoted = [word.removesuffix("()") for word in re.findall(r"`([^`]+)`", text)]
    names = [word for word in quoted if re.fullmatch(r"[A-Za-z_][\w.]*", word) and not FILE.search(word)]
    for section in re.findall(r"^(?:Args|Attributes|Raises):\n((?: +.*\n?|\n)+)", text, re.MULTILINE):
        for entry in re.findall(r"^ {4}(\w[\w, ]*): ", section, re.MULTILINE):
            names += entry.split(", ")
    return names


def is_known(name: str, owner: Any, public: Any) -> bool:
    """Whether it is a parameter, a field, or a name of the class, of the module, of the library or of Python."""
    places = (vars(sys.modules[owner.__module__]), vars(builtins), COMMANDS)
    first, *rest = name.split(".")
    if first in groundsbot.__all__:
        found = getattr(groundsbot, first)
        return all(hasattr(found, part) or part in getattr(found, "__annotations__", {}) for part in rest)
    if first in inspect.signature(owner).parameters or hasattr(public, first):
        return True
    if first in getattr(public, "__annotations__", {}) or any(first in place for place in places):
        return True
    return bool(rest) and find_spec(f"groundsbot.{name.rpartition('.')[0]}") is not None


def test_importing_it_loads_nothing_heavy() -> None:
    loaded = "import groundsbot, sys; print(sorted({'numpy', 'numba', 'rosbags', 'scipy'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", loaded], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
