"""A thread for writing a log, which the disk may block."""

import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Final

from google.protobuf.message import Message

from groundsbot.onboard.log import EventKind, LogNote, Severity
from groundsbot.onboard.recorder.disk.log_keeper import LogKeeper, LogStatus

# From the start of one step to that of the next. Together with the wait of readings and detections before (0.35 s) and
# with steps of a disk that takes 0.1 s for a sync, data older than a second are on the disk.
_PERIOD_S: Final = 0.25
_END_LIMIT_S: Final = 2.0  # together with devices and detection a recording ends within 5 s


class LogThread:
    """Log of a run that is written in a thread of its own."""

    def __init__(self, keeper: LogKeeper, period_s: float = _PERIOD_S) -> None:
        """Start the thread, which opens the files."""
        self._keeper = keeper
        self._period_s = period_s
        self._stop = threading.Event()
        self._stepped_s = time.monotonic()
        self._given_up: deque[LogNote] = deque()
        self._fault = ""
        self._finished = False
        self._thread = threading.Thread(target=self._work, name="log", daemon=True)
        self._thread.start()

    @property
    def last_log_time_ns(self) -> int:
        """Log time of the newest message."""
        return self._keeper.last_log_time_ns

    @property
    def written(self) -> Mapping[str, int]:
        """Number of messages on the disk, by topic."""
        return self._keeper.written

    @property
    def status(self) -> LogStatus:
        """The present status of the log."""
        return self._keeper.status

    @property
    def stalled_s(self) -> float:
        """Time since the last step, which a working disk completes four times a second; for a watchdog."""
        return time.monotonic() - self._stepped_s

    def write(self, topic: str, message: Message, log_time_ns: int, publish_time_ns: int) -> bool:
        """Accept one message; return False for a picture that is dropped. Raises as `LogKeeper.write`."""
        return self._keeper.write(topic, message, log_time_ns, publish_time_ns)

    def take_notes(self) -> Sequence[LogNote]:
        """Return the notes of `LogKeeper.take_notes`, and those on a thread that failed or did not end."""
        return [*self._keeper.take_notes(), *(self._given_up.popleft() for _ in range(len(self._given_up)))]

    def close(self) -> None:
        """Finish the files, or give up if the disk does not respond. A second call does nothing."""
        if self._stop.is_set():
            return
        self._stop.set()
        self._thread.join(_END_LIMIT_S)
        if self._thread.is_alive():
            text = f"the disk did not respond for {_END_LIMIT_S:g} s: the files stay unfinished"
            self._given_up.append(LogNote(EventKind.DISK, Severity.SEVERITY_ERROR, text, {"log left unfinished": 1}))
        elif not self._finished:
            self._keeper.give_up()

    def _work(self) -> None:
        while True:
            begun_s = time.monotonic()
            self._run_safely(self._keeper.step, begun_s)
            self._stepped_s = time.monotonic()
            if self._stop.wait(begun_s + self._period_s - self._stepped_s):
                break
        self._finished = self._run_safely(self._keeper.finish, time.monotonic())

    def _run_safely(self, act: Callable[[float], None], now_s: float) -> bool:
        """Call `act` and return whether it succeeded; an unexpected error is reported and must not end the thread."""
        try:
            act(now_s)
        except Exception as error:
            if repr(error) != self._fault:
                self._fault = repr(error)
                text = f"the log's thread failed and continues: {error!r}"
                self._given_up.append(LogNote(EventKind.DISK, Severity.SEVERITY_ERROR, text, {"faults of the log": 1}))
            return False
        return True
