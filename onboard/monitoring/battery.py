"""Batteries of this computer, as the kernel shows them in /sys/class/power_supply.

Reading them may take long where a gauge does not answer, so that the recorder's process never does.
"""

import re
from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Final, NamedTuple

from groundsbot.calib.errors import CalibError
from groundsbot.calib.foundation import printable, read_regular

_SUPPLIES: Final = Path("/sys/class/power_supply")
_MOST_SUPPLIES: Final = 16
_MOST_BYTES: Final = 4096  # the size that the kernel gives such a file
_KINDS: Final = ("Battery", "UPS")
_DISCHARGING: Final = "discharging"
_STATES: Final = ("charging", _DISCHARGING, "full", "not charging")
_AMOUNTS: Final = (("energy_now", "power_now"), ("charge_now", "current_now"))  # µWh and µW, or µAh and µA
_MOST_HOURS: Final = 1000.0
_FEW_HOURS: Final = 1.0
_FEW_PERCENT: Final = 20


class Battery(NamedTuple):
    """One battery."""

    name: str
    state: str  # as the kernel's, in lower case; "unknown" if it has another
    percent: int | None  # None if not known
    hours_left: float | None  # at the present load; None if not known, or if it is not discharging


def read_batteries(supplies: Path = _SUPPLIES) -> list[Battery]:
    """Return the batteries that power this computer; those of a mouse or a keyboard are not among them.

    Files that are missing, too long, or not as the kernel writes them are taken for unknown values.
    """
    try:
        folders = sorted(islice(supplies.iterdir(), _MOST_SUPPLIES))
    except OSError:
        return []
    found = [_read(each) for each in folders if _text(each / "type") in _KINDS and _text(each / "scope") != "Device"]
    return [each for each in found if each.percent is not None or each.state != "unknown"]


def battery_rows(batteries: Sequence[Battery]) -> Iterator[tuple[str, str, str]]:
    """Yield a label, a text and a rating, as the rows of a status, for each battery."""
    for each in batteries:
        label = f"battery {printable(each.name)}" if len(batteries) > 1 else "battery"
        parts = [] if each.percent is None else [f"{each.percent} %"]
        parts.append(each.state)
        if each.hours_left is not None:
            parts.append(f"enough for {each.hours_left:.1f} h")
        yield label, ", ".join(parts), _rating(each)


def _rating(battery: Battery) -> str:
    if battery.state == _DISCHARGING and battery.hours_left is not None:
        return "bad" if battery.hours_left < _FEW_HOURS else "good"
    if battery.state == _DISCHARGING and battery.percent is not None:
        return "bad" if battery.percent < _FEW_PERCENT else "good"
    return ""


def _read(folder: Path) -> Battery:
    state, percent = _text(folder / "status").lower(), _number(folder / "capacity")
    return Battery(
        folder.name,
        state if state in _STATES else "unknown",
        percent if percent is not None and 0 <= percent <= 100 else None,
        _compute_hours(folder) if state == _DISCHARGING else None,
    )


def _compute_hours(folder: Path) -> float | None:
    for amount_name, rate_name in _AMOUNTS:
        amount, rate = _number(folder / amount_name), _number(folder / rate_name)
        if amount is not None and amount >= 0 and rate:
            hours = amount / abs(rate)  # some drivers have a minus while the battery discharges
            return hours if hours <= _MOST_HOURS else None
    return None


def _number(path: Path) -> int | None:
    text = _text(path)
    return int(text) if re.fullmatch(r"-?[0-9]{1,12}", text) else None


def _text(path: Path) -> str:
    try:
        return read_regular(path, _MOST_BYTES).decode("ascii").strip()
    except (OSError, ValueError, CalibError):
        return ""
