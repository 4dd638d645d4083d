"""What keeps a process that runs for hours from giving its memory back each time, or from useless searches."""

import platform
import subprocess
import sys

import pytest

# 40 times what a picture or a piece of a log takes: 8 MB in buffers of 1 MB, all of them written to, and gone again.
PROGRAM = """
import gc, resource, sys
from groundsbot.onboard.process.memory import keep_memory
if sys.argv[1] == "kept":
    keep_memory(16 << 20)
def faults():
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt
def once():
    buffers = [bytearray(b"x" * (1 << 20)) for _ in range(8)]
once()
before = faults()
for _ in range(40):
    once()
print(faults() - before, gc.get_freeze_count(), gc.get_threshold()[0])
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="mallopt is glibc's")
def test_free_memory_stays_and_old_objects_are_not_searched() -> None:
    (given_back, none_frozen, usual), (stayed, frozen, rarer) = (
        map(int, subprocess.check_output([sys.executable, "-c", PROGRAM, how], text=True).split())
        for how in ("given back", "kept")
    )
    assert given_back > 40 * 1000  # pages of 4 KiB; twice as many where they are of no more than that
    assert stayed < 0.1 * given_back
    assert none_frozen == 0
    assert frozen > 5000
    assert rarer > 10 * usual
