"""`import groundsbot` gives what docs/library.md tells of, and does so at once."""

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import groundsbot
from tests.support.data.drives import HALL, make_drive, make_robot, write_drive
from tests.support.paths import ROOT

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
    out = capsys.readouterr().out.splitlines()
    assert out[0] == "6 tags in one map"
    assert out[1].startswith("recordings/carl/tuesday")
    for made in ("map/map.json", "drawn.png", "map.g2o", "tables/tags.csv", "simulated/truth.json"):
        assert (recordings.parent / made).is_file()
    assert any(line.startswith("tag 99: is not in the map, which has 0, 1, ") for line in out)


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


def test_importing_it_loads_nothing_heavy() -> None:
    loaded = "import groundsbot, sys; print(sorted({'numpy', 'numba', 'rosbags', 'scipy'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", loaded], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
