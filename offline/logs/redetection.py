"""Tag detection in recorded pictures: a new log with the new detections and all else; the old one is not changed."""

import os
import queue
from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Final

from groundsbot.calib.errors import GroundsbotError
from groundsbot.calib.foundation import MOST_PIXELS, is_jpeg, size_in_header
from groundsbot.calib.robot import parse_robot_yaml
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.foundation import Progress
from groundsbot.offline.logs.new_log import new_log
from groundsbot.onboard.detection import ChildDetector, DetectionResult, DetectorSettings, detections_message
from groundsbot.onboard.log import (
    CALIBRATION_TOPIC,
    DETECTIONS_TOPIC,
    PICTURE_TOPIC,
    CameraCalibration,
    CompressedImage,
    Event,
    EventKind,
    LogLosses,
    LogWriter,
    Picture,
    RunInfo,
    SegmentLimits,
    Severity,
    StampSource,
    TagDetections,
    WheelEncoders,
    camera_from_message,
    camera_of,
    camera_topic,
    files_of,
    is_head_topic,
    read_head,
    read_log,
)

_QUEUED: Final = 4  # pictures in memory for each process
# A camera's JPEG needs at least 6 bits for 64 pixels and is incompressible; a decompression bomb takes minutes.
_PIXELS_PER_BYTE: Final = 128
# Detection time in pixels of a plain picture: at least; for each byte of a JPEG, as bytes encode edges; for each pixel
# of a PNG, which may repeat one patch of noise.
_LEAST_PIXELS: Final = 1 << 14
_PIXELS_A_BYTE: Final = 16
_PIXELS_A_PNG_PIXEL: Final = 8


@dataclass(frozen=True)
class DetectOptions:
    """Options of detection. None: as robot.yaml in the log says."""

    families: tuple[str, ...] | None = None
    library: str | None = None
    quad_decimate: float = 1.0  # full resolution: offline there is time for small tags
    drop_others: bool = False  # leave out detections of pictures that were not recorded
    n_processes: int | None = None  # None: one for each core


@dataclass
class DetectReport:
    """Result of a detection."""

    n_pictures: int = 0
    n_unusable: int = 0
    n_unchanged: int = 0  # old detections, of pictures that were not recorded
    tags_before: Counter[tuple[str, int]] = field(default_factory=Counter)
    tags_after: Counter[tuple[str, int]] = field(default_factory=Counter)
    losses: LogLosses = field(default_factory=LogLosses)

    def lines(self) -> list[str]:
        """Return the numbers of pictures and detections as lines of text."""
        lines = [
            f"{self.n_pictures} pictures: {_describe(self.tags_before)} before, {_describe(self.tags_after)} now",
            f"{self.n_unchanged} older detections kept, of pictures not recorded" if self.n_unchanged else "",
            f"{self.n_unusable} pictures cannot be used; their older detections stay" if self.n_unusable else "",
            *self.losses.lines(),
        ]
        return [line for line in lines if line]


def _describe(tags: Counter[tuple[str, int]]) -> str:
    return f"{len(tags)} tags in {tags.total()} observations"


def detect_again(log: Path, output: Path, options: DetectOptions, progress: Progress) -> DetectReport:
    """Detect tags in every picture of a log and write a new log, which appears complete or not at all.

    Args:
        log: a file or a run folder with pictures.
        output: a new run folder, or a new file if it ends in `.mcap`.
        options: options of the detection.
        progress: called with the stage, the number done and the total.

    Raises:
        GroundsbotError: the log holds no picture or cannot be read, `output` exists, or no detector is installed.
    """
    with new_log(output) as folder:
        old = _OldDetections.read(log)
        settings = _settings(log, options, old)
        if not old.n_pictures:
            raise OfflineError(f"{log}: holds no pictures; record with recorder.picture_rate_hz above 0")
        report = DetectReport()
        found = _detect_all(log, old, settings, options, report, progress)
        target = folder / output.name if output.suffix == ".mcap" else folder
        _write(log, target, old, found, options, report)
    return report


def _settings(log: Path, options: DetectOptions, old: "_OldDetections") -> dict[str, DetectorSettings]:
    """Return the settings for the pictures of each camera."""
    head = read_head(log)
    run = head.get("/run")
    if not isinstance(run, RunInfo):
        raise OfflineError(
            f"{log}: has no intact /run message, so it is damaged, or no log of groundsbot; `salvage` or `import` it "
            "first"
        )
    recorder = parse_robot_yaml(run.robot_yaml, f"{log}: robot.yaml in /run").recorder
    families = options.families or tuple(recorder.families)
    found: dict[str, DetectorSettings] = {}
    for name in sorted({camera for camera, _ in old.pictures}):
        model, calibration = None, head.get(camera_topic(CALIBRATION_TOPIC, name))
        if isinstance(calibration, CameraCalibration):
            with suppress(GroundsbotError):  # mapping reports what is wrong with it; detection works without
                model = camera_from_message(calibration)
        library = options.library or recorder.detector
        found[name] = DetectorSettings(families, library, options.quad_decimate, camera=model)
    return found


Shot = tuple[str, int]  # camera by name, and stamp of the picture in ns


@dataclass
class _OldDetections:
    """Data collected in a first pass over the log."""

    n_pictures: int = 0
    pictures: set[Shot] = field(default_factory=set)  # all recorded ones, usable or not
    messages: dict[Shot, TagDetections] = field(default_factory=dict)  # without their tags
    wheels: list[tuple[int, int]] = field(default_factory=list)  # stamp, sequence

    @classmethod
    def read(cls, log: Path) -> "_OldDetections":
        """Read the log, without decoding pictures.

        Raises:
            OfflineError: the log has more detections than one of its size can hold.
        """
        old = cls()
        n_left = most = MOST_PIXELS + _PIXELS_PER_BYTE * sum(file.stat().st_size for file in files_of(log))
        for each in read_log(log, ("/wheels", DETECTIONS_TOPIC, PICTURE_TOPIC), LogLosses()):
            if isinstance(each.message, WheelEncoders):
                old.wheels.append((each.message.stamp_ns, each.message.sequence))
            elif isinstance(each.message, TagDetections):
                del each.message.detections[:]
                old.messages[camera_of(each.topic), each.message.stamp_ns] = each.message
            elif isinstance(each.message, CompressedImage):
                old.n_pictures += 1
                old.pictures.add((camera_of(each.topic), each.publish_time_ns))
                n_left -= _work_pixels(each.message.data)
                if n_left < 0:
                    raise OfflineError(
                        f"{log}: its pictures have more than {most} pixels, the limit for a log of its size; are they "
                        "a camera's?"
                    )
        old.wheels.sort()
        return old

    def fill_in(self, camera: str, message: TagDetections) -> None:
        """Fill in the fields other than tags from the picture's old message; without one, the wheel sequence."""
        old = self.messages.get((camera, message.stamp_ns))
        if old is not None:
            message.frame_sequence = old.frame_sequence
            message.stamp_source = old.stamp_source
            message.has_wheel_sequence = old.has_wheel_sequence
            message.wheel_sequence = old.wheel_sequence
            return
        index = bisect_right(self.wheels, message.stamp_ns, key=lambda wheel: wheel[0]) - 1
        if index >= 0:
            message.has_wheel_sequence = True
            message.wheel_sequence = self.wheels[index][1]


def _work_pixels(encoded: bytes) -> int:
    """Return the detection work for a picture, in pixels of a plain one."""
    width_px, height_px = size_in_header(encoded)
    n_pixels = width_px * height_px * (1 if is_jpeg(encoded) else _PIXELS_A_PNG_PIXEL)
    is_detected = width_px * height_px <= _PIXELS_PER_BYTE * len(encoded)
    return max(n_pixels if is_detected else 0, _PIXELS_A_BYTE * len(encoded), _LEAST_PIXELS)


def _detect_all(
    log: Path,
    old: _OldDetections,
    settings: dict[str, DetectorSettings],
    options: DetectOptions,
    report: DetectReport,
    progress: Progress,
) -> dict[Shot, bytes]:
    """Return new messages, serialised, by their picture."""
    found: dict[Shot, bytes] = {}
    n_processes = options.n_processes or os.cpu_count() or 1
    for camera, of_camera in settings.items():
        with detectors(of_camera, n_processes) as (detect, library, described):
            for stamp_ns, result in detect_in_parallel(_pictures(log, camera), detect, n_processes):
                report.n_pictures += 1
                progress("looking for tags", report.n_pictures, old.n_pictures)
                if result.error is not None:
                    report.n_unusable += 1
                    continue
                source = StampSource.STAMP_SOURCE_UNSPECIFIED
                message = detections_message(result.detections, result.size_px, stamp_ns, source, 0, library, described)
                old.fill_in(camera, message)
                report.tags_after.update((each.family, each.tag_id) for each in message.detections)
                found[camera, stamp_ns] = message.SerializeToString(deterministic=True)
    return found


Detect = Callable[[Picture], DetectionResult]


@contextmanager
def detectors(settings: DetectorSettings, n_processes: int) -> Iterator[tuple[Detect, str, str]]:
    """Yield a function for several threads, each call of which has a process to itself, and the detector's names."""
    with ExitStack() as stack:
        idle: queue.SimpleQueue[ChildDetector] = queue.SimpleQueue()
        children = []
        for _ in range(n_processes):
            children.append(ChildDetector(settings))
            stack.callback(children[-1].close)
            idle.put(children[-1])

        def detect(picture: Picture) -> DetectionResult:
            if isinstance(picture, bytes):
                width_px, height_px = size_in_header(picture)
                if width_px * height_px > _PIXELS_PER_BYTE * len(picture):
                    return DetectionResult([], (0, 0), None, f"{width_px}x{height_px} pixels in {len(picture)} bytes")
            detector = idle.get()
            try:
                return detector.detect(picture)
            finally:
                idle.put(detector)

        yield detect, children[0].library, children[0].settings


def _pictures(log: Path, camera: str) -> Iterator[tuple[int, Picture]]:
    for each in read_log(log, (camera_topic(PICTURE_TOPIC, camera),), LogLosses()):
        if isinstance(each.message, CompressedImage):
            yield each.publish_time_ns, each.message.data


def detect_in_parallel(
    pictures: Iterator[tuple[int, Picture]], detect: Detect, n_threads: int
) -> Iterator[tuple[int, DetectionResult]]:
    """Yield results as they are ready, with few pictures in memory."""
    with ThreadPoolExecutor(n_threads) as pool:
        under_way: dict[Future[DetectionResult], int] = {}
        while True:
            for stamp_ns, picture in islice(pictures, _QUEUED * n_threads - len(under_way)):
                under_way[pool.submit(detect, picture)] = stamp_ns
            if not under_way:
                return
            for future in wait(under_way, return_when=FIRST_COMPLETED).done:
                yield under_way.pop(future), future.result()


def _write(
    log: Path,
    target: Path,
    old: _OldDetections,
    found: dict[Shot, bytes],
    options: DetectOptions,
    report: DetectReport,
) -> None:
    writer: LogWriter | None = None
    head = read_head(log)
    limits = None if target.suffix == ".mcap" else SegmentLimits()
    for each in read_log(log, losses=report.losses):
        at_ns = max(each.log_time_ns, writer.last_log_time_ns) if writer else each.log_time_ns
        if writer is None:
            writer = LogWriter(target, head, at_ns, keep_pictures=True, durable=False, limits=limits)
        if is_head_topic(each.topic):
            continue
        camera = camera_of(each.topic)
        if isinstance(each.message, TagDetections):
            report.tags_before.update((tag.family, tag.tag_id) for tag in each.message.detections)
            shot = camera, each.message.stamp_ns
            if shot in found:
                each.message.ParseFromString(found[shot])
            elif not _should_keep(shot, old, options, report):
                continue
        writer.write(each.topic, each.message, at_ns, each.publish_time_ns)
        if isinstance(each.message, CompressedImage) and (camera, each.publish_time_ns) not in old.messages:
            data = found.get((camera, each.publish_time_ns))  # a picture without old detections
            if data is not None:
                topic = camera_topic(DETECTIONS_TOPIC, camera)
                writer.write(topic, TagDetections.FromString(data), at_ns, each.publish_time_ns)
    if writer is not None:
        _write_event(writer, log, report)
        writer.close()


def _should_keep(shot: Shot, old: _OldDetections, options: DetectOptions, report: DetectReport) -> bool:
    """Whether to keep detections that have no new ones."""
    if shot in old.pictures:  # unusable now, so the old detection is better
        return True
    report.n_unchanged += not options.drop_others
    return not options.drop_others


def _write_event(writer: LogWriter, log: Path, report: DetectReport) -> None:
    now_ns = writer.last_log_time_ns
    text = f"tags detected again in the pictures of {log.name}: {'; '.join(report.lines())}"
    event = Event(
        stamp_ns=now_ns,
        severity=Severity.SEVERITY_INFO,
        kind=EventKind.DETECTED_AGAIN,
        text=text,
        count=report.n_unusable,
    )
    writer.write("/events", event, now_ns, now_ns)
