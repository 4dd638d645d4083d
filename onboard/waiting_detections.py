"""Detections wait for the wheel reading after their picture, so that they can name the one before it."""

from collections import deque
from collections.abc import Iterator
from typing import Final, NamedTuple

from onboard.messages import TagDetections

WAIT_FOR_WHEELS_NS: Final = 500_000_000
_WHEEL_MEMORY: Final = 4096  # readings in which a picture's wheel sequence is looked up: 4 s at 1 kHz


class ReadyDetections(NamedTuple):
    """Detections that wait no longer."""

    message: TagDetections
    receive_ns: int


class WaitingDetections:
    """Detections in their order, and the wheel readings that were written last."""

    def __init__(self) -> None:
        self._waiting: deque[ReadyDetections] = deque()
        self._recent: deque[tuple[int, int]] = deque(maxlen=_WHEEL_MEMORY)  # (stamp_ns, sequence)

    @property
    def newest_wheels_ns(self) -> int | None:
        """Stamp of the newest wheel reading; None: there was none."""
        return self._recent[-1][0] if self._recent else None

    def note_wheels(self, stamp_ns: int, sequence: int) -> None:
        """A wheel reading has been written."""
        self._recent.append((stamp_ns, sequence))

    def add(self, message: TagDetections, receive_ns: int) -> None:
        """Takes the detections of one picture."""
        self._waiting.append(ReadyDetections(message, receive_ns))

    def take_ready(self, now_ns: int, *, more_to_come: bool) -> Iterator[ReadyDetections]:
        """Gives those whose wheel readings are there, the sequence filled in, or that have waited long enough.

        Args:
            now_ns: now.
            more_to_come: wheel readings are held back elsewhere, so that waiting is worth it however long.
        """
        newest_ns = self.newest_wheels_ns
        while self._waiting:
            message, receive_ns = self._waiting[0]
            wheels_are_past = newest_ns is not None and newest_ns > message.stamp_ns
            too_late = now_ns - receive_ns >= WAIT_FOR_WHEELS_NS and not more_to_come
            if not (wheels_are_past or too_late):
                return
            self._name_wheels(message)
            yield self._waiting.popleft()

    def _name_wheels(self, message: TagDetections) -> None:
        before = next((sequence for at_ns, sequence in reversed(self._recent) if at_ns <= message.stamp_ns), None)
        if before is not None:
            message.has_wheel_sequence = True
            message.wheel_sequence = before
