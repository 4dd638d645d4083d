"""Losses of a recording, as events in its log and as counts at its end."""

from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np

from groundsbot.onboard.log import DETECTIONS_TOPIC, EventKind, Severity, camera_topic
from groundsbot.onboard.recorder.counted_log import CountedLog, pictures_of
from groundsbot.onboard.recorder.watches import Watches
from groundsbot.onboard.wheels import GyroUnwrapper, StampedGyro, StampedReading, WheelIntake


class Tally(NamedTuple):
    """Count of a repeated event."""

    kind: EventKind
    times: int
    text: str  # of the last occurrence
    source: str  # camera by name; empty for others


class Tallies:
    """Counts of frequent events, which are reported from time to time instead of each time."""

    def __init__(self) -> None:
        self._counted: dict[tuple[EventKind, str], Tally] = {}  # by kind and source
        self._left_out = (0, 0, 0)  # rejected, repeated and overtaken lines counted so far

    def add(self, kind: EventKind, count: int, text: str, source: str = "") -> None:
        """Add to the count of a kind and source; does nothing if `count` is 0."""
        if count:
            before = self._counted.get((kind, source))
            self._counted[kind, source] = Tally(kind, count + (before.times if before else 0), text, source)

    def add_left_out(self, intake: WheelIntake) -> None:
        """Count the lines that the intake has dropped since the last call."""
        parser, unwrapper = intake.parser, intake.unwrapper
        left_out = (parser.rejected, unwrapper.repeated, unwrapper.overtaken)
        rejected, repeated, overtaken = np.subtract(left_out, self._left_out).tolist()
        self._left_out = left_out
        pieces = f"pieces that are not a line, the last {list(parser.last_rejected)}"
        self.add(EventKind.WHEEL_LINE_REJECTED, rejected, pieces)
        text = f"lines left out: {repeated} repeated, {overtaken} overtaken by newer ones"
        self.add(EventKind.WHEEL_SEQUENCE, repeated + overtaken, text)

    def take(self) -> Iterator[Tally]:
        """Yield and reset the counts since the last call."""
        counted, self._counted = self._counted, {}
        yield from counted.values()


_NS_PER_S: Final = 1_000_000_000
_WHEEL_GAP_NS: Final = 500_000_000  # motion over a longer one is unknown to a map
_GYRO_GAP_NS: Final = 500_000_000  # longer than lost lines take, which are counted
_FROZEN_NS: Final = 1_000_000_000  # a map leaves a yaw rate out that stays the same for so long


class GyroLosses:
    """Reporter of missing and unusable samples of a gyro."""

    def __init__(self, log: CountedLog, tallies: Tallies) -> None:
        """Write rare events and counts to `log`, and add frequent events to `tallies`."""
        self._log = log
        self._tallies = tallies
        self._counts = (0, 0, 0, 0, 0)  # of the unwrapper so far
        self._last_ns: int | None = None
        self._value_rad_s = float("nan")
        self._same_since_ns = 0
        self._is_frozen = False

    def note_reading(self, each: StampedGyro) -> None:
        """Report samples missing before a reading, and a value that stays the same."""
        reading, last_ns = each.reading, self._last_ns
        self._last_ns = each.stamp_ns
        if reading.lost:
            self._tallies.add(EventKind.GYRO_GAP, reading.lost, "gyro samples missing by their sequence numbers")
            self._log.losses["gyro samples"] += reading.lost
        if last_ns is not None and each.stamp_ns - last_ns > _GYRO_GAP_NS:
            text = f"no yaw rate for {(each.stamp_ns - last_ns) / _NS_PER_S:.3f} s"
            self._log.event(EventKind.GYRO_GAP, Severity.SEVERITY_WARNING, text, each.host_ns, reading.lost)
        self._watch_value(each)

    def _watch_value(self, each: StampedGyro) -> None:
        value = each.reading.yaw_rate_rad_s
        if value != self._value_rad_s:
            self._value_rad_s, self._same_since_ns, self._is_frozen = value, each.stamp_ns, False
        elif not self._is_frozen and each.stamp_ns - self._same_since_ns >= _FROZEN_NS:
            self._is_frozen = True
            self._log.losses["times that the gyro froze"] += 1
            text = f"the gyro repeats {value:.6f} rad/s for 1 s and longer: a map leaves that out; restart the gyro"
            self._log.event(EventKind.GYRO_FROZEN, Severity.SEVERITY_WARNING, text, each.host_ns, 1)

    def note_left_out(self, gyro: GyroUnwrapper) -> None:
        """Count the samples that were dropped or not measured since the last call."""
        counts = (gyro.saturated, gyro.unreadable, gyro.unplaced, gyro.out_of_order, gyro.renumbered)
        saturated, unreadable, unplaced, out_of_order, renumbered = np.subtract(counts, self._counts).tolist()
        self._counts = counts
        text = "gyro samples beyond its range: set it to a larger one"
        self._tallies.add(EventKind.GYRO_SATURATED, saturated, text)
        text = "gyro samples for which the gyro did not answer: check its cable"
        self._tallies.add(EventKind.GYRO_UNREADABLE, unreadable, text)
        text = (
            f"gyro samples or lines out of sequence: samples left out, {out_of_order} repeated or late, {unplaced} of "
            f"another boot or time than the wheels'; {renumbered} lines with a wrong sequence number"
        )
        self._tallies.add(EventKind.GYRO_SEQUENCE, out_of_order + unplaced + renumbered, text)
        lost = {"saturated": saturated, "unreadable": unreadable, "without a time": unplaced}
        self._log.losses.update({f"gyro samples {what}": count for what, count in lost.items() if count})


class RecordingLosses:
    """Reporter of losses: rare ones at once, frequent ones as counts when `report` is called.

    Attributes:
        gyro: reporter of those of the gyro.
    """

    def __init__(self, log: CountedLog) -> None:
        """Write events and counts to `log`."""
        self._log = log
        self._tallies = Tallies()
        self.gyro = GyroLosses(log, self._tallies)

    def note_reading(self, each: StampedReading, before_ns: int | None) -> None:
        """Report losses before a wheel reading; `before_ns` is the stamp of the reading before, None if none."""
        reading = each.reading
        if reading.lost:
            self._tallies.add(EventKind.WHEEL_GAP, reading.lost, "lines missing by their sequence numbers")
            self._log.losses["wheel lines"] += reading.lost
        if before_ns is None:
            return
        gap_ns = each.stamp_ns - before_ns
        if reading.new_epoch:
            self._log.losses["wheel controller resets"] += 1
            text = f"boot {reading.boot_id} after {gap_ns / _NS_PER_S:.3f} s: the motion in between is unknown"
            self._log.event(EventKind.WHEEL_RESET, Severity.SEVERITY_WARNING, text, each.host_ns, 1)
        elif gap_ns > _WHEEL_GAP_NS:
            text = f"no wheel reading for {gap_ns / _NS_PER_S:.3f} s"
            self._log.event(EventKind.WHEEL_GAP, Severity.SEVERITY_WARNING, text, each.host_ns, reading.lost)

    def note_pictures(self, kind: EventKind, count: int, reason: str, camera: str) -> None:
        """Count pictures whose detections are missing in the log, to be reported once a second as an event of `kind`.

        Args:
            kind: kind of the event.
            count: number of pictures.
            reason: text of the event after the count.
            camera: name of the camera; empty for a robot with one.
        """
        self._log.losses[pictures_of(camera)] += count
        self._tallies.add(kind, count, reason, camera)

    def note_stamp(self, camera: str) -> None:
        """Count a camera's change to stamps by time of arrival."""
        text = "times that stamps of the camera became implausible; stamp_source of each picture names the one used"
        self._tallies.add(EventKind.CAMERA_STAMP, 1, text, camera)

    def report(self, intake: WheelIntake, now_ns: int) -> None:
        """Write events on the counts since the last call, including lines dropped by the intake."""
        self._tallies.add_left_out(intake)
        self.gyro.note_left_out(intake.gyro)
        for each in self._tallies.take():
            text = f"{each.source}: {each.times} {each.text}" if each.source else f"{each.times} {each.text}"
            self._log.event(each.kind, Severity.SEVERITY_WARNING, text, now_ns, each.times, each.source)

    def count_missing(self, watches: Watches, *, port_is_lost: bool) -> None:
        """Count devices missing at the end, whose lost lines or pictures cannot be counted."""
        losses, counts = self._log.losses, self._log.counts
        if watches.wheels.is_silent and not counts["/wheels"]:
            losses["recording without a single wheel reading"] += 1
        elif watches.wheels.is_silent or port_is_lost:
            losses["wheel port gone or silent at the end"] += 1
        if watches.gyro.is_silent:
            losses["gyro silent at the end" if counts["/gyro"] else "recording without a single yaw rate"] += 1
        for name, watch in watches.cameras.items():
            if watch.is_missing:
                never = not counts[camera_topic(DETECTIONS_TOPIC, name)] and not losses[pictures_of(name)]
                which, of = (f" {name}", f" of {name}") if name else ("", "")
                gone = f"camera{which} gone or silent at the end"
                losses[f"recording without a single picture{of}" if never else gone] += 1
