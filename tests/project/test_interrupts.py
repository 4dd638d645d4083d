"""Ctrl-C and SIGTERM: one line, the exit code shells know, nothing half-written, no process left."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from groundsbot.calib.foundation.command_line import new_app, run
from tests.support.data.played_logs import PlayedLog

LIMIT_S = 120.0  # only a program that hangs comes near

# `map`, but the map never gets finished.
ENDLESS_MAP = """
import sys, time
from types import SimpleNamespace
from groundsbot.offline import cli
from groundsbot.offline.commands import drives, map_drives
def write(_result, folder):
    (folder / "map.json").write_text("half")
    time.sleep(600)
drives.logs_of = map_drives.logs_of = lambda logs: logs
map_drives.read_runs = lambda *_, **__: None
map_drives.build_map = lambda *_, **__: SimpleNamespace(runs=())
map_drives.replace = lambda result, **_: result
map_drives.write_map = write
cli.main()
"""

SIGNALS = pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])


@contextmanager
def program(*arguments: object) -> Iterator[subprocess.Popen[str]]:
    """A Python process with a group of its own, as from a terminal."""
    process = subprocess.Popen(
        ["env", "--default-signal=INT,TERM", sys.executable, *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )
    with process:
        try:
            yield process
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)


def wait_until(condition: Callable[[], object], process: subprocess.Popen[str]) -> None:
    end_s = time.monotonic() + LIMIT_S
    while not condition():
        assert process.poll() is None, process.communicate()[0]
        assert time.monotonic() < end_s
        time.sleep(0.01)


def end_of(process: subprocess.Popen[str], number: signal.Signals) -> tuple[int, str]:
    """Signals as a terminal (all of the group) or as `kill` does; the output ends with the last process that has it."""
    if number == signal.SIGINT:
        os.killpg(process.pid, number)
    else:
        process.send_signal(number)
    said, _ = process.communicate(timeout=LIMIT_S)
    return process.returncode, said


@SIGNALS
@pytest.mark.parametrize("rendering", [False, True], ids=["processes starting", "rendering"])
def test_an_interrupted_simulation_leaves_nothing(
    tmp_path: Path, number: signal.Signals, code: int, rendering: bool
) -> None:
    output = tmp_path / "logs"
    awaited = ".*.partial/*/*/*.mcap*" if rendering else ".*.partial"
    long = ("--world", "room", "--frame-rate-hz", 1000)  # minutes, were its processes waited for
    with program("-m", "fixtures", "simulate", *long, "--output", output) as process:
        wait_until(lambda: any(tmp_path.glob(awaited)), process)
        assert end_of(process, number) == (code, "interrupted\n")
    assert list(tmp_path.iterdir()) == []


@SIGNALS
@pytest.mark.parametrize("existing", [False, True], ids=["new folder", "overwrite"])
def test_an_interrupted_map_leaves_what_was_there(
    tmp_path: Path, number: signal.Signals, code: int, existing: bool
) -> None:
    output = tmp_path / "map"
    if existing:
        output.mkdir()
        (output / "map.json").write_text("earlier")
    before = sorted(tmp_path.rglob("*"))
    with program("-c", ENDLESS_MAP, "map", tmp_path / "log", "-o", output, "--overwrite") as process:
        wait_until(lambda: any(tmp_path.glob(".*.partial/map.json")), process)
        assert end_of(process, number) == (code, "interrupted\n")
    assert sorted(tmp_path.rglob("*")) == before
    assert not existing or (output / "map.json").read_text() == "earlier"


@SIGNALS
def test_an_interrupted_live_map_leaves_that_of_the_last_update(
    tmp_path: Path, room: Path, number: signal.Signals, code: int
) -> None:
    drive, output = PlayedLog(room / "a" / "seed3", tmp_path / "a"), tmp_path / "map"
    drive.play(6.0)
    with program("-m", "groundsbot.offline.cli", "live", drive.copy, "-o", output, "--period-s", 0.1) as process:
        wait_until((output / "map.json").exists, process)
        returned, said = end_of(process, number)
    assert (returned, said.splitlines()[-1]) == (code, "interrupted")
    assert [each.name for each in output.iterdir()] == ["map.json"]
    assert json.loads((output / "map.json").read_text())["tags"]
    assert sorted(each.name for each in tmp_path.iterdir()) == ["a", "map"]


# The first signal comes in a `__del__`, which swallows what it raises; the third while the second is cleaned up after.
SWALLOWED = """
import os, signal
from groundsbot.calib.foundation.command_line import new_app, run
from tests.support.data.played_logs import PlayedLog
app = new_app("x")
class Swallowing:
    def __del__(self):
        os.kill(os.getpid(), signal.SIGINT)
@app.command("a")
def a():
    Swallowing()
    print("goes on", flush=True)
    try:
        os.kill(os.getpid(), signal.SIGINT)
        print("deaf", flush=True)
    finally:
        os.kill(os.getpid(), signal.SIGINT)
        print("cleaned up", flush=True)
run(app)
"""


def test_a_swallowed_signal_does_not_block_later_ones() -> None:
    with program("-c", SWALLOWED, "a") as process:
        said, _ = process.communicate(timeout=LIMIT_S)
    assert process.returncode == 130, said
    assert said.endswith("goes on\ncleaned up\ninterrupted\n")


def test_signal_handlers_are_as_before_when_a_program_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    app = new_app("Does nothing.")
    app.command("rest")(lambda: None)
    monkeypatch.setattr(sys, "argv", ["nothing", "rest"])
    before = [signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)]
    with pytest.raises(SystemExit) as caught:
        run(app)
    assert caught.value.code == 0
    assert [signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)] == before
