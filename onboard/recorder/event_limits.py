"""Limit of the rate of events, by kind; events above it are counted and reported together."""

from collections.abc import Iterator
from typing import Final, NamedTuple

from groundsbot.onboard.log import EventKind, Severity

_NS_PER_S: Final = 1_000_000_000
_BURST: Final = 30  # events of a kind at once
_PERIOD_NS: Final = _NS_PER_S  # average time between events of a kind after that


class HeldEvents(NamedTuple):
    """Events of a kind that were not written."""

    kind: EventKind
    severity: "Severity | int"  # of the last one, like the text
    text: str
    times: int
    total: int  # sum of their counts


class EventLimits:
    """Token bucket for each kind of event.

    Without it a faulty device that causes thousands of events per second would fill the disk.
    """

    def __init__(self) -> None:
        self._full_at_ns: dict[EventKind, int] = {}  # when the bucket of a kind is full again
        self._held: dict[EventKind, HeldEvents] = {}

    def allows(self, kind: EventKind, severity: "Severity | int", text: str, now_ns: int, count: int) -> bool:
        """Return whether to write an event now; otherwise it is counted for `take`."""
        before = self._held.get(kind)
        full_at_ns = max(self._full_at_ns.get(kind, now_ns), now_ns)
        if before is None and full_at_ns - now_ns <= (_BURST - 1) * _PERIOD_NS:
            self._full_at_ns[kind] = full_at_ns + _PERIOD_NS
            return True
        times, sum_before = (before.times, before.total) if before is not None else (0, 0)
        self._held[kind] = HeldEvents(kind, severity, text, times + 1, sum_before + count)
        return False

    def take(self) -> Iterator[HeldEvents]:
        """Yield the events held since the last call, by kind. Call it once per second."""
        held, self._held = self._held, {}
        yield from held.values()
