"""A recorder's status in words, line by line, for a terminal and for the page."""

import time
from collections.abc import Iterator
from typing import Final

from groundsbot.calib.foundation import plural
from groundsbot.onboard.monitoring.status import DeviceStatus, ProgressStatus, Status, is_alive

_OLD_S: Final = 1.0
_NS_PER_S: Final = 1_000_000_000
_S_PER_H: Final = 3600
_FEW_HOURS: Final = 1.0
_CLOSING_TAGS: Final = 2  # one tag seen again fixes the robot's place, but its heading only roughly


def rows(status: Status) -> Iterator[tuple[str, str, str]]:
    """Yield a label, a text and a rating ("", "good", "bad" or "warn") for each line of the status."""
    alive = is_alive(status)
    hours, rest_s = divmod(int(status.recording_s), _S_PER_H)
    age_s = max(0.0, (time.time_ns() - status.updated_ns) / _NS_PER_S)
    state = status.state if alive or status.state == "stopped" else f"gone: no status for {age_s:.0f} s"
    rating = "warn" if status.state == "stopped" else _how(alive)
    yield "recorder", f"{state}, {hours}:{rest_s // 60:02}:{rest_s % 60:02}, process {status.pid}", rating
    yield "run", f"{status.robot_id} {status.run_id}, in {status.folder}", ""
    yield "wheels", *_device(status.wheels, "lines/s")
    for name, camera in (status.cameras or {"": status.camera}).items():
        yield f"camera {name}".rstrip(), *_device(camera, "pictures/s")
    if status.gyro is not None:
        yield "gyro", *_device(status.gyro, "samples/s")
    yield "tags in view", ", ".join(status.tags_in_view) or "none", ""
    lost = ", ".join(f"{count} {what}" for what, count in sorted(status.losses.items()))
    if status.progress is not None:
        yield "drive", progress_text(status.progress), ""
    yield "lost so far", lost or "nothing", "warn" if lost else "good"
    disk = status.disk
    left = "" if disk.hours_left is None else f", enough for {disk.hours_left:.1f} h"
    few = disk.hours_left is not None and disk.hours_left < _FEW_HOURS
    yield "disk", f"{disk.free_bytes / 1e9:.1f} GB free{left}", "bad" if disk.problem or few else "good"
    yield "clock", "synchronised" if status.clock_synchronised else "not synchronised", ""
    for problem in status.problems:
        yield "wrong now", problem, "bad"
    for event in status.last_events:
        yield "event", event, "warn"


def progress_text(progress: ProgressStatus) -> str:
    """Return how far the drive has come."""
    seen, again = progress.tags_seen, progress.tags_seen_again
    closed = "loop closed" if again >= _CLOSING_TAGS else "loop open: drive past tags seen before"
    return f"{progress.driven_m:.1f} m driven, {plural(seen, 'tag')} seen, {again} seen again, {closed}"


def _device(device: DeviceStatus, unit: str) -> tuple[str, str]:
    if not device.expected:
        return "not in robot.yaml", ""
    if device.age_s is None:
        return f"{device.name}: nothing yet", "bad"
    text = f"{device.name}: {device.rate_hz:.1f} {unit}, the newest {device.age_s:.2f} s old"
    return text, _how(device.age_s < _OLD_S)


def _how(is_good: bool) -> str:
    return "good" if is_good else "bad"
