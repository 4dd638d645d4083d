"""Limit of the rate of events, by kind and source; events above it are counted and reported together."""

from collections.abc import Iterator
from typing import Final, NamedTuple

from groundsbot.onboard.log import EventKind, Severity

_NS_PER_S: Final = 1_000_000_000
_BURST: Final = 30  # events of a kind at once
_PERIOD_NS: Final = _NS_PER_S  # average time between events of a kind after that


class HeldEvents(NamedTuple):
    """Events of a kind that were not written."""

    kind: EventKind
    source: str  # camera by name; empty for others
    severity: "Severity | int"  # of the last one, like the text
    text: str
    times: int
    total: int  # sum of their counts


class EventLimits:
    """Token bucket for each kind of event and each source, so that one camera cannot hide what another has.

    Without it a faulty device that causes thousands of events per second would fill the disk.
    """

    def __init__(self) -> None:
        # By kind and source; the time is that at which a bucket is full again.
        self._full_at_ns: dict[tuple[EventKind, str], int] = {}
        self._held: dict[tuple[EventKind, str], HeldEvents] = {}

    def allows(
        self, kind: EventKind, severity: "Severity | int", text: str, now_ns: int, count: int, source: str = ""
    ) -> bool:
        """Return whether to write an event of a source now; otherwise it is counted for `take`."""
        key = kind, source
        before = self._held.get(key)
        full_at_ns = max(self._full_at_ns.get(key, now_ns), now_ns)
        if before is None and full_at_ns - now_ns <= (_BURST - 1) * _PERIOD_NS:
            self._full_at_ns[key] = full_at_ns + _PERIOD_NS
            return True
        times, sum_before = (before.times, before.total) if before is not None else (0, 0)
        self._held[key] = HeldEvents(kind, source, severity, text, times + 1, sum_before + count)
        return False

    def take(self) -> Iterator[HeldEvents]:
        """Yield the events held since the last call, by kind and source. Call it once per second."""
        held, self._held = self._held, {}
        yield from held.values()
