"""Display of a recorder's status: plain lines, or a live panel in a terminal."""

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from rich.console import Console, Group
from rich.live import Live
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from groundsbot.calib.foundation import printable
from groundsbot.onboard.errors import OnboardError
from groundsbot.onboard.monitoring.status import DeviceStatus, Status, is_alive, read_status

_PERIOD_S: Final = 0.5
_OLD_S: Final = 1.0
_NS_PER_S: Final = 1_000_000_000
_S_PER_H: Final = 3600
_FEW_HOURS: Final = 1.0


def rows(status: Status) -> Iterator[tuple[str, str, str]]:
    """Yield a label, a text and a rating ("", "good", "bad" or "warn") for each line of the status."""
    alive = is_alive(status)
    hours, rest_s = divmod(int(status.recording_s), _S_PER_H)
    age_s = max(0.0, (time.time_ns() - status.updated_ns) / _NS_PER_S)
    state = status.state if alive or status.state == "stopped" else f"gone: no status for {age_s:.0f} s"
    yield "recorder", f"{state}, {hours}:{rest_s // 60:02}:{rest_s % 60:02}, process {status.pid}", _how(alive)
    yield "run", f"{status.robot_id} {status.run_id}, in {status.folder}", ""
    for name, device, unit in (("wheels", status.wheels, "lines/s"), ("camera", status.camera, "pictures/s")):
        yield name, *_device(device, unit)
    if status.gyro is not None:
        yield "gyro", *_device(status.gyro, "samples/s")
    yield "tags in view", ", ".join(status.tags_in_view) or "none", ""
    lost = ", ".join(f"{count} {what}" for what, count in sorted(status.losses.items()))
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


def print_once(place: Path, console: Console) -> Status:
    """Print the status as plain lines, and return it.

    Raises:
        OnboardError: there is no status.
    """
    status = read_status(place)
    for name, text, _ in rows(status):
        console.print(printable(f"{name}: {text}"), markup=False, highlight=False, soft_wrap=True)
    return status


def show_live(place: Path, console: Console) -> None:
    """Show the status in a panel that is updated until Ctrl-C.

    Raises:
        OnboardError: there is no status at the start.
    """
    read_status(place)
    with Live(console=console, auto_refresh=False) as live:
        while True:
            try:
                live.update(_panel(read_status(place)), refresh=True)
            except OnboardError as error:
                live.update(Text(printable(str(error)), style="red"), refresh=True)
            time.sleep(_PERIOD_S)


def _panel(status: Status) -> Panel:
    styles = {"good": "green", "bad": "bold red", "warn": "yellow", "": ""}
    table = Table.grid(padding=(0, 2))
    for name, text, how in rows(status):
        table.add_row(Text(name, style="dim"), Text(printable(text), style=styles[how]))
    bad = bool(status.problems) or not is_alive(status)
    return Panel(
        Group(table), title=Text(f"groundsbot {printable(status.robot_id)}"), border_style="red" if bad else "green"
    )


def _device(device: DeviceStatus, unit: str) -> tuple[str, str]:
    if not device.expected:
        return "not in robot.yaml", ""
    if device.age_s is None:
        return f"{device.name}: nothing yet", "bad"
    text = f"{device.name}: {device.rate_hz:.1f} {unit}, the newest {device.age_s:.2f} s old"
    return text, _how(device.age_s < _OLD_S)


def _how(is_good: bool) -> str:
    return "good" if is_good else "bad"
