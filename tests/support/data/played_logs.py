"""Logs that grow as they did when they were recorded, step by step."""

from collections.abc import Iterable
from pathlib import Path

from groundsbot.onboard.log.messages import topic_of
from groundsbot.onboard.log.reading.decoder import LogMessage
from groundsbot.onboard.log.reading.reader import read_head, read_log
from groundsbot.onboard.log.writing.segments import SegmentLimits
from groundsbot.onboard.log.writing.writer import LogWriter


class PlayedLog:
    """A copy of a log, written up to some time of its drive."""

    def __init__(self, log: Path, copy: Path) -> None:
        """Write the head of the copy, a run folder."""
        self.copy = copy
        self._messages = iter(list(read_log(log)))
        self._next: LogMessage | None = next(self._messages)
        assert self._next is not None
        self._start_ns = self._next.log_time_ns
        self._writer = LogWriter(copy, read_head(log), self._start_ns, durable=False, limits=SegmentLimits())

    def play(self, until_s: float) -> bool:
        """Write what was logged up to a time since the beginning; whether the log goes on, or is finished."""
        while self._next is not None and self._next.log_time_ns <= self._start_ns + until_s * 1e9:
            topic = topic_of(self._next.topic)
            if topic is None or not topic.every_file:
                self._writer.write(*self._next)
            self._next = next(self._messages, None)
        if self._next is None:
            self._writer.close()
            return False
        self._writer.flush()
        return True


def play_all(logs: Iterable[PlayedLog], until_s: float) -> bool:
    """Play several logs that began at the same time; whether one of them goes on."""
    goes_on = [each.play(until_s) for each in logs]
    return any(goes_on)
