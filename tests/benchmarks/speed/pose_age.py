"""Ages of the poses of `live --map`, and its memory, with the topics that a recorder serves for viewers.

    python -m tests.benchmarks.speed.pose_age [--minutes 3] [--drive-minutes 20] [--times 1]

Two drives of a fleet past 100 tags are simulated once; one is mapped, and the other is played through the recorder's
side of its viewers (PageLink), each message when the recorder had it. `groundsbot-offline live ws://... --map --poses`
follows in a process of its own; the age of each pose is that when its line came here, by one clock. `--times` plays
faster, for memory over long drives: ages mean nothing then. Not in it: serial port and camera, whose stamps
recorder_load measures.
Exits with 1 where fewer than 50 poses a second come, or the 99th percentile of their ages is above 20 ms.
"""

import argparse
import json
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Final

import numpy as np
from google.protobuf.message import Message

from groundsbot.calib.web.page_address import PageAddress
from groundsbot.onboard.log.messages import is_head_topic
from groundsbot.onboard.log.reading.reader import find_logs, read_head, read_log
from groundsbot.onboard.page.link import PageLink
from groundsbot.onboard.page.messages import PageSettings
from tests.benchmarks.command_line import exit_code, say
from tests.benchmarks.speed.fleet import simulated_fleet
from tests.support.devices.live_recording import until
from tests.support.hostile.page_attacks import free_port

MOST_MS: Final = 20.0
LEAST_HZ: Final = 50.0
_KEYFRAMES_A_MINUTE: Final = 870  # of a robot of the fleet
_TAGS: Final = 100
_PARTS: Final = 6  # of the time, of which the memory is stated
_WARM_UP_S: Final = 60.0  # kernels are compiled or read, the start is searched


def _played(log: Path, minutes: float, times: float) -> Iterator[tuple[str, Message, int]]:
    """Topic, message and log time, each when it is due; stamps are moved to now."""
    began_ns, first_ns = time.time_ns(), 0
    for each in read_log(log):
        if is_head_topic(each.topic):
            continue
        first_ns = first_ns or each.log_time_ns
        due_ns = began_ns + round((each.log_time_ns - first_ns) / times)
        if due_ns - began_ns > minutes * 60e9:
            return
        time.sleep(max(0.0, (due_ns - time.time_ns()) * 1e-9))
        if hasattr(each.message, "stamp_ns"):
            each.message.stamp_ns += began_ns - first_ns
        yield each.topic, each.message, each.log_time_ns + began_ns - first_ns


class Reader:
    """Ages of the poses that came after the warm-up, and how many of them were known."""

    def __init__(self, port: int) -> None:
        """Begin to read in a thread."""
        self.ages_ms: list[float] = []
        self.n_known = 0
        self._begin_s = time.monotonic() + _WARM_UP_S
        threading.Thread(target=self._read, args=(port,), daemon=True).start()

    def _read(self, port: int) -> None:
        with socket.create_connection(("127.0.0.1", port)) as connection:
            for line in connection.makefile():
                now_ns = time.time_ns()
                pose = json.loads(line)
                if time.monotonic() > self._begin_s:
                    self.ages_ms.append((now_ns - pose["stamp_ns"]) * 1e-6)
                    self.n_known += "x_m" in pose


def _memory_mb(pid: int) -> float:
    lines = Path(f"/proc/{pid}/status").read_text(encoding="ascii").splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmRSS")) / 1000.0


def measure(known: Path, log: Path, minutes: float, times: float) -> tuple[Reader, list[float]]:
    """Play a log; returns what came, and the memory of `live` each ten seconds after the warm-up, in MB."""
    served, poses = free_port(), free_port()
    settings = PageSettings("fleet", None, None, PageAddress("127.0.0.1", served))
    command = [sys.executable, "-m", "groundsbot.offline.cli", "live", f"ws://127.0.0.1:{served}"]
    memory_mb: list[float] = []
    with closing(PageLink(None, settings, lambda _: "", say)) as link:
        link.offer_head(read_head(log), time.time_ns())
        options = ["--map", str(known), "--poses", str(poses), "--period-s", "10"]
        with subprocess.Popen([*command, *options], stdout=subprocess.PIPE, text=True) as live:
            try:
                assert live.stdout is not None
                until(lambda: "poses: port" in live.stdout.readline(), "the port of the poses")  # type: ignore[union-attr]
                threading.Thread(target=live.stdout.read, daemon=True).start()
                until(lambda: "/tags/detections" in link._topics, "the subscription")
                reader, next_s = Reader(poses), time.monotonic() + _WARM_UP_S
                for entry in _played(log, minutes, times):
                    link.offer_message(*entry)
                    if time.monotonic() > next_s:
                        memory_mb.append(_memory_mb(live.pid))
                        next_s += 10.0
            finally:
                live.kill()
    return reader, memory_mb


def main() -> int:
    """Plays one drive, and says what came of it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=3.0)
    parser.add_argument("--drive-minutes", type=float, default=20.0)
    parser.add_argument("--times", type=float, default=1.0)
    given = parser.parse_args()
    logs = find_logs([simulated_fleet(2, round(_KEYFRAMES_A_MINUTE * given.drive_minutes), _TAGS, 1)])
    with tempfile.TemporaryDirectory() as folder:
        known = Path(folder) / "map"
        mapped = ["map", str(logs[0]), "-o", str(known)]
        subprocess.run(
            [sys.executable, "-m", "groundsbot.offline.cli", *mapped], check=False, stdout=subprocess.DEVNULL
        )
        reader, memory_mb = measure(known, logs[1], given.minutes, given.times)
    rate_hz = len(reader.ages_ms) / (given.minutes * 60.0 - _WARM_UP_S)
    middle, high, most = np.quantile(reader.ages_ms, [0.5, 0.99, 1.0])
    say(f"{len(reader.ages_ms)} poses, {reader.n_known} known, {rate_hz:.0f} a second")
    say(f"age: {middle:.1f} ms median, {high:.1f} ms 99th percentile, {most:.1f} ms at most")
    parts = np.linspace(0, len(memory_mb) - 1, _PARTS + 1).round().astype(int)
    say(f"memory of live, from {_WARM_UP_S:.0f} s to the end: {', '.join(f'{memory_mb[i]:.1f}' for i in parts)} MB")
    missed = [f"{rate_hz:.0f} poses a second, at least {LEAST_HZ:g}"] if rate_hz < LEAST_HZ else []
    if given.times == 1.0 and high > MOST_MS:
        missed.append(f"99th percentile of the ages {high:.1f} ms, at most {MOST_MS:g}")
    return exit_code(missed)


if __name__ == "__main__":
    sys.exit(main())
