"""Lines for whoever watches a recording, from a thread of their own: a pipe that nobody reads blocks who writes.

A terminal held by Ctrl-S or a listener that hangs must not hold up the recording, nor its end.
"""

import os
import queue
import threading
from contextlib import suppress
from typing import Final, TextIO

_WAITING_LIMIT: Final = 1000  # lines
_END_LIMIT_S: Final = 0.5


class ConsoleLines:
    """Says lines, in their order; drops and counts them where they are not taken."""

    def __init__(self, stream: TextIO | None) -> None:
        """Writes to what stands behind `stream`; None: there is nothing, and nobody is told.

        Not through the stream: its lock, held by a thread that blocks, ends the interpreter in a crash. And to a number
        of its own: the stream's may be another file's by the time that a listener who hung reads on.
        """
        self._file = None if stream is None else os.dup(stream.fileno())
        self._encoding = "utf-8" if stream is None else stream.encoding
        self._lines: queue.Queue[str | None] = queue.Queue(_WAITING_LIMIT)
        self._n_dropped = 0
        self._thread = threading.Thread(target=self._work, name="console", daemon=True)
        self._thread.start()

    def say(self, text: str) -> None:
        """Says a line, without waiting; for all threads."""
        try:
            self._lines.put_nowait(text)
        except queue.Full:
            self._n_dropped += 1

    def close(self, limit_s: float = _END_LIMIT_S) -> None:
        """Waits until all has been said, or for so long."""
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
            self._write(f"{n_dropped} lines were left out here: nobody read them in time")

    def _write(self, text: str) -> None:
        data = f"{text}\n".encode(self._encoding, "backslashreplace")
        with suppress(OSError):  # whoever listened may be gone; the recording goes on
            while data and self._file is not None:
                data = data[os.write(self._file, data) :]
