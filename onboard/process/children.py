"""Child processes of the recorder: their start, their priority and their end."""

import ctypes
import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from multiprocessing.process import BaseProcess
from typing import Final

from groundsbot.onboard.process.ending import ENDING_SIGNALS

_PR_SET_PDEATHSIG: Final = 1


@contextmanager
def signals_held_back() -> Iterator[None]:
    """Block ending signals in this thread during the block, and in a child started in it until `settle_child`."""
    held = signal.pthread_sigmask(signal.SIG_BLOCK, ENDING_SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, held)


def settle_child(nice: int) -> None:
    """In the child: ignore ending signals, take a priority, and end with the thread that started it.

    Args:
        nice: the priority. The recorder may run with a raised one.
    """
    for each in ENDING_SIGNALS:  # the parent decides when recording ends
        signal.signal(each, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, ENDING_SIGNALS)
    with suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, nice)
    # Work that does not return would not notice that the parent was killed.
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, int(signal.SIGKILL), 0, 0, 0)


def kill_child(process: BaseProcess) -> None:
    """Kill a child, unless another thread has closed it already."""
    with suppress(ValueError, AttributeError):
        process.kill()
