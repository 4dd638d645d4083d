"""Runs that are started and stopped from the page, within one program."""

import threading
from collections.abc import Callable


class RunControl:
    """Start and stop of runs. All methods may be called from any thread.

    A run has an event of its own that ends it; the end of the program ends it too.
    """

    def __init__(self, stop: threading.Event) -> None:
        """Begin as if a start was requested; `stop` ends the program."""
        self._stop = stop
        self._changed = threading.Condition()
        self._is_wanted = True
        self._run: threading.Event | None = None
        threading.Thread(target=self._end_with_program, name="end of runs", daemon=True).start()

    @property
    def goes_on(self) -> bool:
        """Whether the program goes on after the present run."""
        return not self._stop.is_set()

    def start(self) -> bool:
        """Request a run, after the end of one that was stopped; return False if one goes on."""
        with self._changed:
            if self._run is not None and not self._run.is_set():
                return False
            self._is_wanted = True
            self._changed.notify_all()
            return True

    def stop(self) -> bool:
        """End the present run, or take back the request for one; return False if there is neither."""
        with self._changed:
            was_wanted, self._is_wanted = self._is_wanted, False
            if self._run is None or self._run.is_set():
                return was_wanted
            self._run.set()
            return True

    def next_run(self, wait_s: float, on_wait: Callable[[], None]) -> threading.Event | None:
        """Wait until a run is requested, and return the event that ends it; None at the end of the program.

        Args:
            wait_s: time between two calls of `on_wait`.
            on_wait: called while there is no run.
        """
        with self._changed:
            self._run = None
            while not self._is_wanted and self.goes_on:
                self._changed.wait(wait_s)
                on_wait()
            if not self.goes_on:
                return None
            self._is_wanted = False  # a run that ends by itself is not repeated
            self._run = threading.Event()
            return self._run

    def _end_with_program(self) -> None:
        self._stop.wait()
        with self._changed:
            if self._run is not None:
                self._run.set()
            self._changed.notify_all()
