"""How far a drive has come: metres driven, tags seen, and tags seen again later."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final, NamedTuple

from groundsbot.calib.robot import Wheels
from groundsbot.onboard.detection import Detection
from groundsbot.onboard.wheels import StampedReading

# A standing wheel whose encoder flickers between two counts must not drive metres in a thousand lines a second.
_STEP_NS: Final = 100_000_000
_AWAY_NS: Final = 10_000_000_000  # a tag in view again after so long, and so far, was seen again
_AWAY_M: Final = 1.0


class Progress(NamedTuple):
    """Progress of a drive."""

    driven_m: float  # length of the path of the point midway between the wheels
    tags_seen: int
    tags_seen_again: int  # of these, the ones that went out of view for 10 s and 1 m at least, and came back


@dataclass
class _SeenTag:
    stamp_ns: int  # of the newest picture of it
    driven_m: float  # at that time
    again: bool = False


class DriveProgress:
    """Counter of the progress of one drive, by the lengths and the wiring of robot.yaml."""

    def __init__(self, wheels: Wheels) -> None:
        left_m, right_m = wheels.metres_per_tick
        left_sign, right_sign = wheels.wiring.signs
        self._m_per_count = wheels.wiring.order(left_m * left_sign, right_m * right_sign)
        self._before: StampedReading | None = None
        self._driven_m = 0.0
        self._tags: dict[tuple[str, int], _SeenTag] = {}
        self._n_again = 0

    @property
    def now(self) -> Progress:
        """The progress so far."""
        return Progress(self._driven_m, len(self._tags), self._n_again)

    def note_wheels(self, each: StampedReading) -> None:
        """Add the way since the reading before; what was driven during a reset of the controller is unknown."""
        before = self._before
        if before is None or each.reading.new_epoch:
            self._before = each
        elif each.stamp_ns - before.stamp_ns >= _STEP_NS:
            self._before = each
            left_m = (each.reading.ticks_left - before.reading.ticks_left) * self._m_per_count[0]
            right_m = (each.reading.ticks_right - before.reading.ticks_right) * self._m_per_count[1]
            self._driven_m += abs(left_m + right_m) / 2.0

    def note_tags(self, detections: Iterable[Detection], stamp_ns: int) -> None:
        """Count the tags of one picture. Without wheel readings the time alone decides what was seen again."""
        for each in detections:
            tag = self._tags.get((each.family, each.tag_id))
            if tag is None:
                self._tags[each.family, each.tag_id] = _SeenTag(stamp_ns, self._driven_m)
                continue
            is_far = self._before is None or self._driven_m - tag.driven_m >= _AWAY_M
            if not tag.again and is_far and stamp_ns - tag.stamp_ns >= _AWAY_NS:
                tag.again = True
                self._n_again += 1
            tag.stamp_ns, tag.driven_m = stamp_ns, self._driven_m
