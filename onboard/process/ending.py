"""Signals that tell a program to end, as an event that its threads wait for."""

import os
import signal
import threading
from typing import Final

ENDING_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def stop_event() -> threading.Event:
    """An event that SIGINT, SIGTERM and SIGHUP set for the rest of the process, but for those it was started to ignore.

    A handler in Python runs in the main thread between any two of its instructions, also while that thread holds the
    event's own lock, in `wait` or in an earlier handler; `set` would then wait for itself for ever. So a signal only
    writes a byte to a pipe (signal.set_wakeup_fd), and a thread that does nothing else sets the event.
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
        os.close(read_fd)  # whoever takes the handlers back closes the other end

    threading.Thread(target=pass_on, name="signals", daemon=True).start()
    return stop
