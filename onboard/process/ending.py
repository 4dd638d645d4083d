"""Signals that end a program, as an event for its threads."""

import os
import signal
import threading
from typing import Final

ENDING_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def stop_event() -> threading.Event:
    """Return an event that is set by SIGINT, SIGTERM and SIGHUP, except for signals ignored since the start.

    A Python signal handler runs in the main thread between two instructions, possibly while that thread holds the lock
    of the event in `wait` or in an earlier handler; `set` would then deadlock. A signal therefore writes a byte to a
    pipe (signal.set_wakeup_fd), and a separate thread sets the event.
    """
    stop = threading.Event()
    read_fd, write_fd = os.pipe()
    os.set_blocking(write_fd, False)
    signal.set_wakeup_fd(write_fd, warn_on_full_buffer=False)
    for each in ENDING_SIGNALS:
        if signal.getsignal(each) is not signal.SIG_IGN:
            signal.signal(each, lambda *_: None)

    def pass_on() -> None:
        while os.read(read_fd, 1):
            stop.set()
        os.close(read_fd)  # the other end is closed by code that restores the handlers

    threading.Thread(target=pass_on, name="signals", daemon=True).start()
    return stop
