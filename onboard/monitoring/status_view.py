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
from groundsbot.onboard.monitoring.battery import battery_rows, read_batteries
from groundsbot.onboard.monitoring.status import Status, is_alive, read_status
from groundsbot.onboard.monitoring.status_rows import rows

_PERIOD_S: Final = 0.5


def print_once(place: Path, console: Console) -> Status:
    """Print the status as plain lines, and return it.

    Raises:
        OnboardError: there is no status.
    """
    status = read_status(place)
    for name, text, _ in _rows(status):
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


def _rows(status: Status) -> Iterator[tuple[str, str, str]]:
    """Yield the rows of a status, and those of this computer's batteries while its recorder runs."""
    yield from rows(status)
    if is_alive(status):
        yield from battery_rows(read_batteries())


def _panel(status: Status) -> Panel:
    styles = {"good": "green", "bad": "bold red", "warn": "yellow", "": ""}
    table = Table.grid(padding=(0, 2))
    for name, text, how in _rows(status):
        table.add_row(Text(name, style="dim"), Text(printable(text), style=styles[how]))
    bad = bool(status.problems) or not is_alive(status)
    return Panel(
        Group(table), title=Text(f"groundsbot {printable(status.robot_id)}"), border_style="red" if bad else "green"
    )
