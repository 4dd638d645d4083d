"""The limit of seconds that leaves out waits for a processor still catches who only dawdles."""

import os
import subprocess
import sys
import threading
import time
from contextlib import suppress

import pytest

from tests.support import processor_wait
from tests.support.processor_wait import wait_for_end


def test_a_process_that_sleeps_is_over_the_limit_and_one_that_ends_is_not() -> None:
    with subprocess.Popen([sys.executable, "-c", "print('done')"], stdout=subprocess.PIPE, text=True) as process:
        assert wait_for_end(process, 20.0) == "done\n"
    code = "import time; print('up', flush=True); time.sleep(60)"
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "up\n"
        n_threads = threading.active_count()
        with pytest.raises(AssertionError, match="waiting for a processor"):
            wait_for_end(process, 1.0)
        assert threading.active_count() == n_threads


def test_a_process_that_ends_between_two_checks_is_within_the_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    now_s = 0.0

    def held_up() -> None:
        nonlocal now_s
        with suppress(ChildProcessError):  # the listener was first to hear of its end
            os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
        now_s = 100.0

    with subprocess.Popen(
        [sys.executable, "-c", "import sys; sys.stdin.read()"], stdin=subprocess.PIPE, text=True
    ) as process:
        wait = processor_wait.ProcessorWait(process.pid)
        monkeypatch.setattr(wait, "look", held_up)
        monkeypatch.setattr(processor_wait, "ProcessorWait", lambda _: wait)
        monkeypatch.setattr(time, "monotonic", lambda: now_s)
        wait_for_end(process, 5.0)
