"""Summary of a log, for a person or a program."""

from collections import Counter, defaultdict
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from itertools import pairwise
from math import hypot, isfinite
from pathlib import Path
from statistics import median
from typing import Any, Final

from groundsbot.calib.foundation import plural
from groundsbot.calib.robot import Wheels, parse_robot_yaml
from groundsbot.offline.errors import OfflineError
from groundsbot.onboard.log import (
    Allowance,
    Event,
    Gyro,
    LogLosses,
    LogMessage,
    PlanarOdometry,
    RunInfo,
    TagDetections,
    TagObservations,
    WheelEncoders,
    camera_of,
    is_head_topic,
    read_log,
    topic_of,
    topics_of_cameras,
)

_NS_PER_S: Final = 1_000_000_000
_EARLIEST_NS: Final = 946_684_800 * _NS_PER_S  # 2000-01-01: no log is older
_GAP_S: Final = 0.5  # the motion during a longer gap of wheel readings is unknown
_GAP_INTERVALS: Final = 5  # in a slow log, the limit is this many usual intervals
_WHEELS: Final = ("/wheels", "/odometry")
_STREAMS: Final = (*_WHEELS, "/tags/detections", "/camera/image")
_GAPS_SHOWN: Final = 5
_MOST_LOSSES_LISTED: Final = 20


@dataclass(frozen=True)
class Gap:
    """A time without messages on a topic that otherwise has a steady rate."""

    topic: str
    start_s: float  # after the log's first measurement
    duration_s: float


@dataclass(frozen=True)
class TopicInfo:
    """Number of messages of a topic and their rate (None: fewer than two)."""

    topic: str
    count: int
    rate_hz: float | None


@dataclass(frozen=True)
class LogInfo:
    """Summary of one run's log."""

    log: Path
    run_id: str
    robot_id: str
    software_version: str
    start_utc: str | None  # the first measurement, to the second; None if the log's clock has no date
    duration_s: float
    distance_m: float | None  # by the wheels; None if the log has no readings, or none that are finite
    n_wheel_restarts: int
    n_wheel_lines_lost: int  # by their sequence numbers
    n_gyro_samples_lost: int  # or not measured, by their sequence numbers
    n_pictures: int | None  # None: an imported log
    n_pictures_lost: int
    pictures_lost: dict[str, int]  # of several cameras, by name; empty for a single one
    tags: dict[str, dict[int, int]]  # family, id: number of observations
    topics: tuple[TopicInfo, ...]
    gaps: tuple[Gap, ...]
    events: dict[str, int]  # number of messages of each kind
    file_bytes: dict[str, int]
    losses: tuple[str, ...]  # defects of its files, as sentences
    lost: str  # description of what cannot be read; empty if all can

    def as_json(self) -> dict[str, Any]:
        """Return plain data for `--json`."""
        found = asdict(self) | {"log": str(self.log)}
        if not self.pictures_lost:
            del found["pictures_lost"]
        return found

    def lines(self) -> list[str]:
        """Return the content of the log as lines of text."""
        size = ", ".join(f"{name} {size_bytes / 1e6:.2f} MB" for name, size_bytes in self.file_bytes.items())
        lines = [
            f"{self.log}",
            f"  robot {self.robot_id}, run {self.run_id}, written by {self.software_version or 'an unnamed version'}",
            f"  {self._time()}, {self._distance()}; {size}",
            f"  tags: {self._tags()}",
        ]
        for topic in self.topics:
            rate = "" if topic.rate_hz is None else f"  {topic.rate_hz:8.2f} Hz"
            lines.append(f"  {topic.topic:<20} {topic.count:8d}{rate}")
        lines.extend(self._losses())
        if self.events:
            lines.append("  events: " + ", ".join(f"{kind} {count}" for kind, count in self.events.items()))
        return lines

    def _time(self) -> str:
        return f"{self.duration_s:.1f} s" if self.start_utc is None else f"{self.start_utc}, {self.duration_s:.1f} s"

    def _distance(self) -> str:
        if self.distance_m is None and any(each.topic in _WHEELS for each in self.topics):
            return "wheel readings are not finite, so no map can use it"
        if self.distance_m is None:
            return "no wheel readings, so no map can use it"
        return f"{self.distance_m:.2f} m driven"

    def _tags(self) -> str:
        if not self.tags:
            return "none seen"
        return "; ".join(
            f"{len(seen)} of {family} in {plural(sum(seen.values()), 'observation')}: {' '.join(map(str, seen))}"
            for family, seen in self.tags.items()
        )

    def _losses(self) -> list[str]:
        lines = [
            f"  gap in {gap.topic}: {gap.duration_s:.2f} s from {gap.start_s:.2f} s on"
            for gap in self.gaps[:_GAPS_SHOWN]
        ]
        if len(self.gaps) > _GAPS_SHOWN:
            lines.append(f"  and {plural(len(self.gaps) - _GAPS_SHOWN, 'more gap')}; --json lists them")
        for camera, n_lost in (self.pictures_lost or {"": self.n_pictures_lost}).items():
            if n_lost:
                of_camera = f" of {camera}" if camera else ""
                lines.append(f"  {plural(n_lost, 'picture')}{of_camera} lost, by the camera's own count")
        if self.n_wheel_restarts:
            lines.append(f"  the wheel controller restarted {plural(self.n_wheel_restarts, 'time')}")
        if self.n_wheel_lines_lost:
            lines.append(f"  {plural(self.n_wheel_lines_lost, 'wheel reading')} lost, by the controller's own count")
        if self.n_gyro_samples_lost:
            samples = plural(self.n_gyro_samples_lost, "gyro sample")
            lines.append(f"  {samples} lost or not measured, by the controller's own count")
        lines.extend(f"  damaged: {loss}" for loss in self.losses)
        if self.lost:
            lines.append(f"  lost: {self.lost}")
        return lines


def describe_log(log: Path, allowance: Allowance | None = None) -> LogInfo:
    """Return the summary of a log, reading it once.

    Args:
        log: a file or a run folder.
        allowance: reading budget shared with other logs; one of its own if None.

    Raises:
        GroundsbotError: the log is missing, damaged, not one of ours, or its robot.yaml cannot be used.
    """
    collected, losses = _LogStatistics(), LogLosses()
    for entry in read_log(log, losses=losses, allowance=allowance):
        collected.add(entry)
    run = collected.run
    if run is None:
        found = "; ".join([f"{log}: holds no /run message", *losses.lines()])
        raise OfflineError(f"{found}; is it a groundsbot log?")
    (allowance or Allowance()).check_text(run.robot_yaml, log, sum(_file_bytes(log).values()))
    wheels = parse_robot_yaml(run.robot_yaml, f"{log}: robot.yaml in /run").wheels
    stamps = [stamp for stamps in collected.stamps_ns.values() for stamp in stamps]
    first_ns = min(stamps, default=0)
    cameras = list(dict.fromkeys(map(camera_of, collected.counts)))  # as their heads have them in the log
    topics = [topic for topic in topics_of_cameras(cameras) if topic in collected.counts]
    streams = [topic for kind in _STREAMS for topic in topics if _kind_of(topic) == kind]
    pictures_lost = {
        camera_of(topic): _missing([(0, sequence) for sequence in sequences])
        for topic, sequences in sorted(collected.frame_sequences.items())
    }
    distance_m = _distance_m(collected, wheels)
    return LogInfo(
        log=log,
        run_id=run.run_id,
        robot_id=run.robot_id,
        software_version=run.software_version,
        start_utc=_utc(first_ns),
        duration_s=(max(stamps, default=0) - first_ns) / _NS_PER_S,
        distance_m=distance_m if distance_m is not None and isfinite(distance_m) else None,
        n_wheel_restarts=sum(before[0] != after[0] for before, after in pairwise(collected.ticks)),
        n_wheel_lines_lost=_missing(collected.wheel_lines),
        n_gyro_samples_lost=_missing(collected.gyro_samples),
        n_pictures=sum(map(len, collected.frame_sequences.values())) or None,
        n_pictures_lost=sum(pictures_lost.values()),
        pictures_lost={camera: n_lost for camera, n_lost in pictures_lost.items() if camera},
        tags={family: dict(sorted(collected.tags[family].items())) for family in sorted(collected.tags)},
        topics=tuple(TopicInfo(t, collected.counts[t], _rate_hz(collected.stamps_ns[t])) for t in topics),
        gaps=tuple(gap for topic in streams for gap in _gaps(topic, collected.stamps_ns[topic], first_ns)),
        events=dict(sorted(collected.events.items())),
        file_bytes=_file_bytes(log),
        losses=tuple(losses.lines(_MOST_LOSSES_LISTED)),
        lost=losses.in_words,
    )


@dataclass
class _LogStatistics:
    """Statistics collected in one pass over a log."""

    run: RunInfo | None = None
    counts: Counter[str] = field(default_factory=Counter)
    stamps_ns: defaultdict[str, list[int]] = field(default_factory=lambda: defaultdict(list))
    ticks: list[tuple[int, int, int]] = field(default_factory=list)  # boot, left, right
    wheel_lines: list[tuple[int, int]] = field(default_factory=list)  # boot, sequence
    gyro_samples: list[tuple[int, int]] = field(default_factory=list)  # same; all (0, 0) in an imported log
    distances_m: list[float] = field(default_factory=list)  # cumulative, of the middle
    places_m: list[tuple[float, float]] = field(default_factory=list)
    frame_sequences: defaultdict[str, list[int]] = field(default_factory=lambda: defaultdict(list))  # by topic
    tags: defaultdict[str, Counter[int]] = field(default_factory=lambda: defaultdict(Counter))
    events: Counter[str] = field(default_factory=Counter)

    def add(self, entry: LogMessage) -> None:
        """Add one message; those that begin each file are no measurements and have no time."""
        self.counts[entry.topic] += 1
        if not is_head_topic(entry.topic):
            self.stamps_ns[entry.topic].append(entry.publish_time_ns)
        message = entry.message
        if isinstance(message, WheelEncoders):
            self.ticks.append((message.boot_id, message.ticks_left, message.ticks_right))
            self.wheel_lines.append((message.boot_id, message.sequence))
        elif isinstance(message, Gyro):
            self.gyro_samples.append((message.boot_id, message.sequence))
        elif isinstance(message, TagDetections):
            self.frame_sequences[entry.topic].append(message.frame_sequence)
            self._add_tags((detection.family, detection.tag_id) for detection in message.detections)
        elif isinstance(message, PlanarOdometry):
            self._add_odometry(message)
        elif isinstance(message, TagObservations):
            self._add_tags((observation.family, observation.tag_id) for observation in message.observations)
        elif isinstance(message, Event):
            self.events[message.kind] += 1
        elif isinstance(message, RunInfo):
            self.run = message

    def _add_tags(self, tags: Iterable[tuple[str, int]]) -> None:
        for family, tag_id in tags:
            self.tags[family][tag_id] += 1

    def _add_odometry(self, message: PlanarOdometry) -> None:
        if message.WhichOneof("motion") == "pose":
            self.places_m.append((message.pose.x_m, message.pose.y_m))
        else:
            self.distances_m.append((message.wheels.left_m + message.wheels.right_m) / 2)


def _kind_of(name: str) -> str:
    topic = topic_of(name)
    return name if topic is None else topic.kind


def _distance_m(collected: _LogStatistics, wheels: Wheels) -> float | None:
    """Return the path length of the point midway between the wheels; unknown motion at a restart counts as none."""
    if collected.ticks:
        left_m, right_m = (
            sign * each_m for sign, each_m in zip(wheels.wiring.signs, wheels.metres_per_tick, strict=True)
        )
        left_m, right_m = wheels.wiring.order(left_m, right_m)
        return sum(
            abs((after[1] - before[1]) * left_m + (after[2] - before[2]) * right_m) / 2
            for before, after in pairwise(collected.ticks)
            if before[0] == after[0]
        )
    if collected.distances_m:
        return sum(abs(after - before) for before, after in pairwise(collected.distances_m))
    if collected.places_m:
        return sum(hypot(after[0] - before[0], after[1] - before[1]) for before, after in pairwise(collected.places_m))
    return None


def _missing(numbered: list[tuple[int, int]]) -> int:
    """Return how many numbers are missing in an ascending sequence of (epoch, number), within each epoch."""
    return sum(max(0, after[1] - before[1] - 1) for before, after in pairwise(numbered) if before[0] == after[0])


def _utc(stamp_ns: int) -> str | None:
    """Return date and time of day; None for an imported log whose times begin near zero."""
    if stamp_ns < _EARLIEST_NS:
        return None
    return datetime.fromtimestamp(stamp_ns // _NS_PER_S, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")


def _rate_hz(stamps_ns: list[int]) -> float | None:
    span_ns = max(stamps_ns) - min(stamps_ns) if stamps_ns else 0
    return (len(stamps_ns) - 1) * _NS_PER_S / span_ns if span_ns else None


def _gaps(topic: str, stamps_ns: list[int], first_ns: int) -> list[Gap]:
    if len(stamps_ns) < 2:
        return []
    steps_ns = [after - before for before, after in pairwise(stamps_ns)]
    limit_ns = max(_GAP_S * _NS_PER_S, _GAP_INTERVALS * median(steps_ns))
    return [
        Gap(topic, (start_ns - first_ns) / _NS_PER_S, step_ns / _NS_PER_S)
        for start_ns, step_ns in zip(stamps_ns, steps_ns, strict=False)
        if step_ns > limit_ns
    ]


def _file_bytes(log: Path) -> dict[str, int]:
    files = sorted(log.glob("*.mcap*")) if log.is_dir() else [log]
    return {file.name: file.stat().st_size for file in files}
