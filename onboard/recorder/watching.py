"""Watching of a recording under way: what it takes in is offered, and nothing waits for those who watch."""

from collections.abc import Mapping, Sequence
from typing import Protocol

from google.protobuf.message import Message

from groundsbot.onboard.detection import Detection
from groundsbot.onboard.log import LogHead, Picture, RunLog


class Watcher(Protocol):
    """Watcher of a recording. The calls come in the core's thread, so they must not wait."""

    def offer_head(self, head: LogHead, log_time_ns: int) -> None:
        """Take the messages at the head of a run's log, by topic."""

    def offer_message(self, topic: str, message: Message, log_time_ns: int) -> None:
        """Take a message that the log has accepted."""

    def offer_picture(self, picture: Picture, detections: Sequence[Detection], camera: str) -> None:
        """Take a picture of a camera, by name, and the tags found in it; the only camera has an empty name."""


class WatchedLog:
    """Log of a recorder whose messages are offered to a watcher, too."""

    def __init__(self, log: RunLog, watcher: Watcher) -> None:
        """Stand before a log."""
        self._log = log
        self._watcher = watcher
        self.take_notes = log.take_notes
        self.close = log.close

    @property
    def last_log_time_ns(self) -> int:
        """See RunLog."""
        return self._log.last_log_time_ns

    @property
    def written(self) -> Mapping[str, int]:
        """See RunLog."""
        return self._log.written

    def write(self, topic: str, message: Message, log_time_ns: int, publish_time_ns: int) -> bool:
        """See RunLog."""
        is_accepted = self._log.write(topic, message, log_time_ns, publish_time_ns)
        if is_accepted:
            self._watcher.offer_message(topic, message, log_time_ns)
        return is_accepted
