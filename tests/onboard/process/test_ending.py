"""Signals that end a recorder at any point of its main thread."""

import subprocess
import sys

import pytest

LIMIT_S = 120.0  # only a program that hangs comes near

# The lock that the main thread holds for moments in `wait` and in `set`.
TOLD_WHILE_LOCKED = """
import os, signal
from groundsbot.onboard.process.ending import stop_event
stop = stop_event()
assert not stop.is_set()
with stop._cond:
    for _ in range(100):
        os.kill(os.getpid(), signal.{name})
print(stop.wait(10.0))
"""

TOLD_WHAT_IS_IGNORED = """
import os, signal
from groundsbot.onboard.process.ending import stop_event
signal.signal(signal.SIGHUP, signal.SIG_IGN)
stop = stop_event()
os.kill(os.getpid(), signal.SIGHUP)
print(stop.wait(0.2))
"""


def exit_line(code: str) -> str:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=LIMIT_S)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_a_request_to_end_while_the_main_thread_holds_the_events_lock(name: str) -> None:
    assert exit_line(TOLD_WHILE_LOCKED.format(name=name)) == "True\n"


def test_what_it_was_started_to_ignore_stays_ignored() -> None:
    assert exit_line(TOLD_WHAT_IS_IGNORED) == "False\n"
