"""Things that come in numbers are counted, and told of now and then."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from groundsbot.onboard.messages import EventKind
from groundsbot.onboard.wheel_intake import WheelIntake


class Tally(NamedTuple):
    """What happened several times."""

    kind: EventKind
    times: int
    text: str  # of the last time


class Tallies:
    """Counts what comes in numbers, so that it is told of now and then and not each time."""

    def __init__(self) -> None:
        self._counted: dict[EventKind, Tally] = {}
        self._left_out = (0, 0, 0)  # rejected, repeated and overtaken lines counted so far

    def add(self, kind: EventKind, count: int, text: str) -> None:
        """Counts; nothing if `count` is 0."""
        if count:
            before = self._counted.get(kind)
            self._counted[kind] = Tally(kind, count + (before.times if before else 0), text)

    def add_left_out(self, intake: WheelIntake) -> None:
        """Counts the lines that the intake has left out since the last time."""
        parser, unwrapper = intake.parser, intake.unwrapper
        left_out = (parser.rejected, unwrapper.repeated, unwrapper.overtaken)
        rejected, repeated, overtaken = np.subtract(left_out, self._left_out).tolist()
        self._left_out = left_out
        pieces = f"pieces that are no line, the last {list(parser.last_rejected)}"
        self.add(EventKind.WHEEL_LINE_REJECTED, rejected, pieces)
        text = f"lines left out: {repeated} repeated, {overtaken} overtaken by newer ones"
        self.add(EventKind.WHEEL_SEQUENCE, repeated + overtaken, text)

    def take(self) -> Iterator[Tally]:
        """What has been counted since the last time."""
        counted, self._counted = self._counted, {}
        yield from counted.values()
