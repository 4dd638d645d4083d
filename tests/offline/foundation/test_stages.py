"""Stages of mapping: reported while they run, timed, and shown to the user."""

import json
from pathlib import Path

import numpy as np
import pytest

from groundsbot.offline.foundation import stages as stages_module
from groundsbot.offline.foundation.stages import Stages
from tests.support.programs import Run, on_terminal

COMPILE = "compiling the solver"  # where this is the first map of a machine
ALL = [
    "reading logs",
    "wiring of the encoders",
    "start values of robots",
    "self-calibration",
    "keyframes and observations",
    "local maps",
    "tags that do not belong",
    "breaks of odometry",
    "fitting the noise",
    "local maps on shared tags",
    "aligning local maps",
    "initial values of all runs",
    "building the graph",
    "solving all runs together",
    "checking that it fits",
    "covariances",
    "advice",
    "writing files",
    "writing the report",
    "drawing the picture",
    "writing map.mcap",
]


def test_beginning_and_progress_are_reported() -> None:
    told: list[tuple[str, int, int]] = []
    stages = Stages(lambda *news: told.append(news))
    with stages.stage("first", 2) as done:
        done()
        done()
    with stages.stage("second"):
        pass
    assert told == [("first", 0, 2), ("first", 1, 2), ("first", 2, 2), ("second", 0, 1)]


def test_a_stage_in_parts_is_one_stage_and_failures_count_too(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter([1.0, 3.5, 10.0, 10.25, 20.0, 21.0])
    monkeypatch.setattr("groundsbot.offline.foundation.stages.time.perf_counter", lambda: next(clock))
    cpu_clock = iter([0.0, 2.0, 3.0, 3.25, 4.0, 4.5])
    monkeypatch.setattr("groundsbot.offline.foundation.stages.time.process_time", lambda: next(cpu_clock))
    stages = Stages()
    with stages.stage("graph"):
        pass
    with stages.stage("solve"):
        pass
    with pytest.raises(ZeroDivisionError), stages.stage("graph"):
        raise ZeroDivisionError
    assert [cost[:3] for cost in stages.costs] == [("graph", 3.5, 2.5), ("solve", 0.25, 0.25)]


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="only Linux tells")
def test_the_peak_is_of_this_process_and_never_falls() -> None:
    """Whatever the tests before took and gave back: more than their peak is taken."""
    stages = Stages()
    with stages.stage("before"):
        pass
    peak_mib = stages.costs[0].peak_mib or 0.0
    with stages.stage("large"):
        np.ones(int((peak_mib + 60.0) * 2**17))  # gone at once
    with stages.stage("after"):
        pass
    before, large, after = (cost.peak_mib or 0.0 for cost in stages.costs)
    assert before + 40.0 < large <= after


def test_no_peak_where_the_kernel_gives_none(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(stages_module, "_STATUS", tmp_path / "none")
    stages = Stages()
    with stages.stage("any"):
        pass
    assert stages.costs[0].peak_mib is None


@pytest.mark.usefixtures("logs")
def test_verbose_says_more_and_prints_each_stage(run: Run, tmp_path: Path) -> None:
    outcome = run("map", tmp_path / "logs", "-o", tmp_path / "map", "-v")
    assert (outcome.code, outcome.err) == (0, "")
    for part in ("4 of 4  ", "scale: known to ", "noise "):
        assert part in outcome.out
    table = outcome.out[outcome.out.index("stage  ") :].splitlines()[1:]
    assert [line[:28].rstrip() for line in table if not line.startswith(COMPILE)] == ALL


@pytest.mark.usefixtures("logs")
def test_verbose_json_holds_the_stages_and_the_map_file_does_not(run: Run, tmp_path: Path) -> None:
    outcome = run("map", tmp_path / "logs", "-o", tmp_path / "map", "--verbose", "--json")
    printed = json.loads(outcome.out)
    assert [each["run"] for each in printed["runs"]] == ["a_one", "b_one"]  # a folder of runs is several logs
    stages = printed.pop("stages")
    assert [stage["name"] for stage in stages if stage["name"] != COMPILE] == ALL
    assert all(stage["seconds"] >= 0.0 for stage in stages)
    assert printed == json.loads((tmp_path / "map" / "map.json").read_text())
    assert "stages" not in json.loads(run("map", tmp_path / "logs", "-o", tmp_path / "again", "--json").out)


@pytest.mark.usefixtures("logs")
def test_a_terminal_shows_the_stages_and_is_left_clean(tmp_path: Path) -> None:
    words = ("-m", "groundsbot.offline.cli", "map", tmp_path / "logs", "-o", tmp_path / "map")
    code, shown, printed = on_terminal(*words)
    assert code == 0
    assert "drawing the picture" in shown
    assert shown.endswith("\x1b[2K")  # the bar's line is wiped
    assert "stage " not in printed
