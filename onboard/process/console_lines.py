"""Console output that never blocks the caller, written by a thread of its own.

A pipe that is not read, or a terminal stopped by Ctrl-S, must not block the recording or its end.
"""

import os
import queue
import threading
from contextlib import suppress
from typing import Final, TextIO

from groundsbot.calib.foundation import printable

_WAITING_LIMIT: Final = 1000  # lines
_END_LIMIT_S: Final = 0.5


class ConsoleLines:
    """Writer of lines in order, which drops and counts lines that are not read in time."""

    def __init__(self, stream: TextIO | None) -> None:
        """Write to the file of `stream`, or discard all lines if it is None.

        The stream itself is not used, because the interpreter crashes at exit if a blocked thread holds its lock. The
        file descriptor is duplicated, because the stream's number may belong to another file when a blocked write
        continues.
        """
        self._file = None if stream is None else os.dup(stream.fileno())
        self._encoding = "utf-8" if stream is None else stream.encoding
        self._lines: queue.Queue[str | None] = queue.Queue(_WAITING_LIMIT)
        self._n_dropped = 0
        self._thread = threading.Thread(target=self._work, name="console", daemon=True)
        self._thread.start()

    def say(self, text: str) -> None:
        """Queue a line without waiting. It may be called from any thread."""
        try:
            self._lines.put_nowait(text)
        except queue.Full:
            self._n_dropped += 1

    def close(self, limit_s: float = _END_LIMIT_S) -> None:
        """Wait until all lines are written, at most `limit_s`."""
        with suppress(queue.Full):
            self._lines.put(None, timeout=limit_s)
            self._thread.join(limit_s)

    def __enter__(self) -> "ConsoleLines":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _work(self) -> None:
        while (text := self._lines.get()) is not None:
            self._write(text)
            if self._lines.empty():
                self._report_drops()
        self._report_drops()
        if self._file is not None:
            os.close(self._file)

    def _report_drops(self) -> None:
        n_dropped, self._n_dropped = self._n_dropped, 0
        if n_dropped:
            self._write(f"{n_dropped} lines were dropped here, as they were not read in time")

    def _write(self, text: str) -> None:
        data = f"{printable(text)}\n".encode(self._encoding, "backslashreplace")
        with suppress(OSError):  # the reader may be gone; the recording continues
            while data and self._file is not None:
                data = data[os.write(self._file, data) :]
