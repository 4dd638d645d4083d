"""How long a process was ready to run while others had the processor.

A limit of seconds is a promise about a computer that has nothing better to do; a machine full of tests holds a process
up for as long as it likes. Linux counts that time for each thread (proc(5), /proc/PID/task/TID/schedstat: its second
number), so a test can hold the promise to its seconds on any machine.
"""

import os
import subprocess
import threading
import time
from pathlib import Path

_LOOK_S = 0.01
_PATIENCE_S = 300.0


class ProcessorWait:
    """Adds up, look by look, what the threads of a process and of its children waited."""

    def __init__(self, pid: int) -> None:
        self._pid = pid
        self._waited_ns: dict[str, int] = {}
        self._at_start_ns: dict[str, int] = {}
        self.look()
        self._at_start_ns = dict(self._waited_ns)

    def look(self) -> None:
        for pid in (str(self._pid), *_children(self._pid)):
            for thread in _list(Path(f"/proc/{pid}/task")):
                try:
                    self._waited_ns[thread.name] = int((thread / "schedstat").read_text().split()[1])
                except (OSError, IndexError):
                    continue  # it ended just now

    @property
    def seconds(self) -> float:
        """Since the beginning; by all threads, of which one or two matter: an upper bound."""
        return 1e-9 * sum(ns - self._at_start_ns.get(thread, 0) for thread, ns in self._waited_ns.items())


def _list(folder: Path) -> list[Path]:
    try:
        return list(folder.iterdir())
    except OSError:
        return []


def _children(pid: int) -> list[str]:
    try:
        return Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    except OSError:
        return []


def wait_for_end(process: "subprocess.Popen[str]", limit_s: float) -> str:
    """Waits for the end of a process; fails where it takes longer than the limit, waits for a processor aside.

    It takes as long as it has been seen to run: the check waits for a processor too, and a process that ended
    meanwhile is not to blame. One over the limit is killed and its listener awaited: left alone, that one would go on
    observation the number of a pipe that is closed, and would read the output of the next owner of that number.

    Returns:
        What it said.
    """
    wait, start_s = ProcessorWait(process.pid), time.monotonic()
    said: list[str] = []

    def listen() -> None:
        said.append(process.communicate()[0])

    reader = threading.Thread(target=listen, daemon=True)
    reader.start()
    while True:
        took_s = time.monotonic() - start_s
        if _has_ended(process.pid):
            break
        wait.look()
        if took_s - wait.seconds > limit_s or took_s > _PATIENCE_S:
            process.kill()
            reader.join()
            raise AssertionError(f"{took_s:.1f} s, {wait.seconds:.1f} s of them waiting for a processor")
        reader.join(_LOOK_S)
    reader.join(_PATIENCE_S)
    assert said, "it has ended, and a process that it left behind holds its output open"
    return said[0]


def _has_ended(pid: int) -> bool:
    """Of a child of ours, which its parent waits for."""
    try:
        return os.waitid(os.P_PID, pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None
    except ChildProcessError:  # its parent has its exit code already
        return True
