"""Detections that wait for the wheel reading after their picture, to determine the reading before it."""

from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Iterator
from operator import itemgetter
from typing import Final, NamedTuple

from groundsbot.onboard.log import TagDetections
from groundsbot.onboard.wheels import WARM_UP_NS

_WAIT_FOR_WHEELS_NS: Final = WARM_UP_NS  # readings held back by the clock mapping arrive within that time
_WHEEL_MEMORY: Final = 4096  # recent readings for the look-up; 4 s at 1 kHz


class ReadyDetections(NamedTuple):
    """Detections ready to be written."""

    topic: str
    message: TagDetections
    receive_ns: int


class WaitingDetections:
    """Queue of detections, with the most recent wheel readings."""

    def __init__(self, *, wheels: bool) -> None:
        """Start empty; without `wheels` detections do not wait."""
        self._wait_ns = _WAIT_FOR_WHEELS_NS if wheels else 0
        self._waiting: deque[ReadyDetections] = deque()
        self._recent: deque[tuple[int, int]] = deque(maxlen=_WHEEL_MEMORY)  # (stamp_ns, sequence), in order

    @property
    def newest_wheels_ns(self) -> int | None:
        """Stamp of the newest wheel reading, or None."""
        return self._recent[-1][0] if self._recent else None

    def note_wheels(self, stamp_ns: int, sequence: int) -> None:
        """Store a wheel reading that has been written."""
        self._recent.append((stamp_ns, sequence))

    def add(self, topic: str, message: TagDetections, receive_ns: int) -> None:
        """Add the detections of one picture, for a topic of the log."""
        self._waiting.append(ReadyDetections(topic, message, receive_ns))

    def take_ready(self, now_ns: int) -> Iterator[ReadyDetections]:
        """Yield detections whose wheel reading is known, with its sequence, or that have waited long enough."""
        return self._take(lambda receive_ns: now_ns - receive_ns >= self._wait_ns)

    def take_all(self) -> Iterator[ReadyDetections]:
        """Yield all remaining detections."""
        return self._take(lambda _: True)

    def _take(self, is_late: Callable[[int], bool]) -> Iterator[ReadyDetections]:
        newest_ns = self.newest_wheels_ns
        while self._waiting:
            _, message, receive_ns = self._waiting[0]
            wheels_are_past = newest_ns is not None and newest_ns > message.stamp_ns
            if not (wheels_are_past or is_late(receive_ns)):
                return
            self._name_wheels(message)
            yield self._waiting.popleft()

    def _name_wheels(self, message: TagDetections) -> None:
        n_before = bisect_right(self._recent, message.stamp_ns, key=itemgetter(0))
        if n_before:
            message.has_wheel_sequence = True
            message.wheel_sequence = self._recent[n_before - 1][1]
