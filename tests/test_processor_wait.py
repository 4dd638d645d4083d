"""The limit of seconds that leaves out waits for a processor still catches who only dawdles."""

import subprocess
import sys
import threading

import pytest

from tests.processor_wait import ended_within


def test_a_process_that_sleeps_is_over_the_limit_and_one_that_ends_is_not() -> None:
    with subprocess.Popen([sys.executable, "-c", "print('done')"], stdout=subprocess.PIPE, text=True) as process:
        assert ended_within(process, 20.0) == "done\n"
    code = "import time; print('up', flush=True); time.sleep(60)"
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "up\n"
        n_threads = threading.active_count()
        with pytest.raises(AssertionError, match="waiting for a processor"):
            ended_within(process, 1.0)
        assert threading.active_count() == n_threads
