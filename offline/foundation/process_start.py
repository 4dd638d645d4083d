"""Start of worker processes: forked from a server that has imported the libraries, where the system has that.

Three processes that each import all libraries take two seconds on two cores, and one and a half of processor time each.
The server has no threads, whose locks a forked process could inherit; it ends when the processes that use it have.
"""

import atexit
import gc
import os
import signal
from multiprocessing import forkserver, get_all_start_methods, get_context, parent_process, resource_tracker
from multiprocessing.connection import wait
from threading import Thread
from typing import Final

METHOD: Final = "forkserver" if "forkserver" in get_all_start_methods() else "spawn"
_FIRST: Final = "groundsbot.offline.foundation.worker_server"


def start_server(module: str) -> None:
    """Have the server import a module while this process does other things; nothing is done if it runs already."""
    get_context("forkserver").set_forkserver_preload([_FIRST, "__main__", module])
    resource_tracker.ensure_running()  # unblocks Ctrl-C as it starts
    # The server inherits that Ctrl-C, which a terminal sends to all processes, does not interrupt its imports.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        forkserver.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def begin_worker() -> None:
    """Ignore Ctrl-C, so that the parent handles it; end quickly, and when the parent has ended."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    Thread(target=_end_with_parent, daemon=True).start()
    end_quickly()


def _end_with_parent() -> None:
    """End this process when its parent has, which it would not notice, as both hold both ends of the pipes."""
    parent = parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


def end_quickly() -> None:
    """Have this process end without a search for garbage, which takes half a second among the objects of numba."""
    atexit.register(gc.freeze)
