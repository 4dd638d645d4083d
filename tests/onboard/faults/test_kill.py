"""Recorders and salvages killed at any time, a second recorder, numbers out of range. Rows of the table of faults."""

import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from groundsbot.calib.robot.robot_yaml import parse_robot_yaml
from groundsbot.fixtures.recording.devices import PtyPort
from groundsbot.onboard.log.messages import Event, EventKind, StampSource
from groundsbot.onboard.log.reading.reader import find_logs, read_log
from groundsbot.onboard.recorder.recorder import RecorderCore, RunIdentity
from tests.support.data.logs import CAMERA, MS, ROBOT_YAML, START_NS, drive, facts, read_all, wheel_entry, write_log
from tests.support.paths import ROOT

LIMIT_S = 60.0  # only what hangs comes near

# Writes readings at 100 Hz until killed; prints after each one when it was handed over, and how far the disk was.
RECORDER = """
import itertools, os, sys, time
from pathlib import Path
from groundsbot.onboard.recorder.disk.room import DiskRoom, SpacePolicy
from groundsbot.onboard.recorder.disk.log_keeper import LogKeeper
from groundsbot.onboard.log.writing.segments import SegmentLimits
from groundsbot.onboard.recorder.disk.log_thread import LogThread
from groundsbot.onboard.log.writing.storage import Disk
from tests.support.data.logs import START_NS, head, picture_entry, wheel_entry

def record(folder):
    disk = Disk()
    limits = SegmentLimits(700_000_000, 1 << 40)
    room = DiskRoom(disk, folder, "gb1", SpacePolicy(0))
    log = LogThread(LogKeeper(folder / "run1", head(), START_NS, disk, room, keep_pictures=True, limits=limits))
    told = os.open(folder / "told", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    for index in itertools.count():
        log.write(*wheel_entry(index, START_NS + index * 10_000_000))
        if index % 5 == 0:
            log.write(*picture_entry(START_NS + index * 10_000_000, os.urandom(20_000)))
        os.write(told, b"%d %.6f %.6f\\n" % (index, time.monotonic(), log.status.synced_s))
        time.sleep(0.01)

for name in sys.argv[1:]:
    Path(name).mkdir()
    child = os.fork()
    if child == 0:
        record(Path(name))
    print(child, flush=True)
sys.stdin.read()
"""

# Salvages one log again and again into new places, in children that a clock kills.
SALVAGER = """
import os, signal, sys, time
from pathlib import Path
from groundsbot.offline.logs.salvaging import salvage
source, folder = Path(sys.argv[1]), Path(sys.argv[2])
for delay_us in map(int, sys.argv[3:]):
    child = os.fork()
    if child == 0:
        signal.setitimer(signal.ITIMER_REAL, delay_us / 1e6)
        salvage(source, folder / f"out{delay_us}")
        os._exit(0)
    os.waitpid(child, 0)
"""


@pytest.mark.parametrize("count", [10, pytest.param(50, marks=pytest.mark.long)])
def test_row_01_killed_at_any_time(tmp_path: Path, count: int) -> None:
    """What was handed over a second before is there; how long the machine itself held the process up is added."""
    chance = random.Random(1)
    for batch in range(count // 10):
        folders = [tmp_path / f"{batch}_{index}" for index in range(10)]
        command = [sys.executable, "-c", RECORDER, *map(str, folders)]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=ROOT) as parent:
            assert parent.stdout is not None
            children = [int(parent.stdout.readline()) for _ in folders]
            for child, folder in zip(children, folders, strict=True):
                time.sleep(chance.uniform(0.1, 0.5))
                os.kill(child, signal.SIGKILL)
                check_promise(folder, time.monotonic())
            parent.communicate()


def check_promise(folder: Path, killed_s: float) -> None:
    told = np.array([line.split() for line in (folder / "told").read_text().splitlines()], dtype=float)
    found, _ = read_all(folder / "run1")
    readings = {each for each in found if each[0] == "/wheels"}
    written = {index: facts([wheel_entry(index, START_NS + index * 10 * MS)])[0] for index in range(len(told) + 1)}
    assert readings <= set(written.values())
    held_up_s = max(np.diff(told[:, 1], append=killed_s).max() - 0.01, 0.0)
    promised = told[:, 1] <= killed_s - 1.0 - held_up_s
    assert {written[int(index)] for index in told[promised, 0]} <= readings
    synced = told[:, 1] <= told[-1, 2]  # whatever the machine did: before the last sync that was reported
    assert {written[int(index)] for index in told[synced, 0]} <= readings


@pytest.mark.parametrize("count", [12, pytest.param(100, marks=pytest.mark.long)])
def test_row_43_salvage_killed_at_any_time(tmp_path: Path, count: int) -> None:
    source = write_log(tmp_path / "run1", drive(20.0, picture_hz=5), finished=False)
    before = {path.name: path.read_bytes() for path in source.iterdir()}
    delays_us = np.unique(np.geomspace(500, 300_000, count).astype(int))
    command = [sys.executable, "-c", SALVAGER, str(source), str(tmp_path), *map(str, delays_us)]
    subprocess.run(command, check=True, cwd=ROOT)
    whole = facts(drive(20.0, picture_hz=5))
    n_done = 0
    for delay_us in delays_us:
        output = tmp_path / f"out{delay_us}"
        if not output.exists():
            assert_salvages(source, output)
        else:
            n_done += 1
        found = [each for each in list_all(output) if each[0] != "/events"]
        assert found == [each for each in whole if each[0] != "/events"]
    assert n_done < len(delays_us)
    assert {path.name: path.read_bytes() for path in source.iterdir()} == before


def assert_salvages(source: Path, output: Path) -> None:
    from groundsbot.offline.logs.salvaging import salvage

    assert all(each.is_whole for each in salvage(source, output))


def list_all(folder: Path) -> list[tuple[str, int, int, bytes]]:
    found, losses = read_all(folder)
    assert not losses
    return found


def test_row_43_killed_around_the_rename(tmp_path: Path) -> None:
    """A file has its old name or its new one; both are read, and a second start spoils neither."""
    entries = drive(3.0)
    run = write_log(tmp_path / "run1", entries)
    finished = run / "0000.core.mcap"
    assert read_all(run)[0] == facts(entries)
    finished.rename(run / "0000.core.mcap.active")
    found, losses = read_all(run)
    assert found == facts(entries)
    assert not losses  # whole to its end mark, whatever its name


def test_row_19_a_second_recorder_leaves_with_one_line(tmp_path: Path, plug_in: Callable[..., PtyPort]) -> None:
    plug_in(tmp_path / "wheels")
    robot = tmp_path / "robot.yaml"
    robot.write_text(ROBOT_YAML + "devices: {encoder_port: wheels}\n")
    command = [
        sys.executable,
        "-m",
        "groundsbot.onboard.cli",
        "record",
        "--robot",
        str(robot),
        "--output",
        str(tmp_path / "logs"),
    ]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT) as first:
        assert first.stdout is not None
        assert "recording_started" in first.stdout.readline()
        second = subprocess.run(command, capture_output=True, text=True, check=False, timeout=LIMIT_S, cwd=ROOT)
        assert second.returncode == 1
        assert second.stderr == f"error: {robot}: robot gb1 is being recorded already; stop that recorder first\n"
        first.send_signal(signal.SIGTERM)
        first.communicate(timeout=LIMIT_S)
    assert len(find_logs([tmp_path / "logs"])) == 1


def test_row_38_what_is_out_of_range_is_refused_alone(tmp_path: Path) -> None:
    run = RunIdentity(parse_robot_yaml(ROBOT_YAML, "robot.yaml"), ROBOT_YAML, CAMERA, "run1", START_NS, 5)
    core = RecorderCore(tmp_path, run, durable=False)
    at_ns = START_NS + MS
    good = {"stamp_ns": at_ns, "receive_ns": at_ns, "sequence": 7}
    bad = [{"stamp_ns": -1}, {"stamp_ns": 1 << 63}, {"stamp_ns": 1 << 70}, {"sequence": -1}, {"sequence": 1 << 64}]
    for each in ({}, *bad, {}):
        values = good | each
        core.on_detections(
            [], (64, 48), values["stamp_ns"], values["receive_ns"], StampSource.STAMP_SOURCE_ARRIVAL, values["sequence"]
        )
        core.tick(at_ns + 600 * MS)
        good = {name: value + 1 for name, value in good.items()}
    core.close(at_ns + 1000 * MS)
    log = list(read_log(tmp_path / "run1"))
    assert sum(each.topic == "/tags/detections" for each in log) == 2
    events = [each.message for each in log if isinstance(each.message, Event)]
    assert sum(each.kind == EventKind.MESSAGE_REFUSED for each in events) == core.losses["messages refused"] == len(bad)
