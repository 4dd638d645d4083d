"""Batteries in the status and on the page."""

import json
import os
import subprocess
import sys
from multiprocessing.connection import Connection
from pathlib import Path
from unittest.mock import Mock, create_autospec

import pytest
from typer.testing import CliRunner

from groundsbot.onboard.cli import app
from groundsbot.onboard.monitoring import battery, status_view
from groundsbot.onboard.monitoring.battery import Battery, battery_rows, read_batteries
from groundsbot.onboard.monitoring.status import write_status
from groundsbot.onboard.page import child
from groundsbot.onboard.page.hub import Hub
from groundsbot.onboard.page.messages import PageState, ToPage
from tests.onboard.monitoring.test_status import make_status


def supply(folder: Path, name: str, **files: str | bytes) -> Path:
    """Makes a power supply as the kernel shows it."""
    place = folder / name
    place.mkdir(parents=True)
    for each, content in files.items():
        (place / each).write_bytes(content if isinstance(content, bytes) else f"{content}\n".encode())
    return place


def test_batteries_have_percentage_state_and_hours(tmp_path: Path) -> None:
    discharging = {"type": "Battery", "status": "Discharging", "capacity": "83"}
    supply(tmp_path, "BAT0", **discharging, energy_now="31000000", power_now="10000000")
    supply(tmp_path, "BAT1", **discharging, charge_now="1000000", current_now="-2000000")
    supply(tmp_path, "BAT2", **(discharging | {"status": "Charging"}), energy_now="31000000", power_now="10000000")
    supply(tmp_path, "gauge", **(discharging | {"capacity": "19"}))
    supply(tmp_path, "mouse", **discharging, scope="Device")
    supply(tmp_path, "AC", type="Mains", online="1")
    assert list(battery_rows(read_batteries(tmp_path))) == [
        ("battery BAT0", "83 %, discharging, enough for 3.1 h", "good"),
        ("battery BAT1", "83 %, discharging, enough for 0.5 h", "bad"),
        ("battery BAT2", "83 %, charging", ""),
        ("battery gauge", "19 %, discharging", "bad"),
    ]
    assert list(battery_rows([Battery("BAT0", "full", 100, None)])) == [("battery", "100 %, full", "")]


def test_without_a_battery_there_is_no_row(tmp_path: Path) -> None:
    assert read_batteries(tmp_path / "none") == []
    assert read_batteries(tmp_path) == []
    supply(tmp_path, "BAT0", type="Battery", status="Unknown")  # an empty slot
    assert read_batteries(tmp_path) == []


@pytest.mark.parametrize("odd", [b"", b"nan", b"1e3", b"\xff\xfe", b"-5", b"9" * 4000, b"0", b"1\x1b[2J", b"5\n5"])
def test_odd_contents_are_unknown_values(tmp_path: Path, odd: bytes) -> None:
    names = ("capacity", "energy_now", "power_now", "charge_now", "current_now", "scope")
    supply(tmp_path, "BAT0", type="Battery", status="Discharging", **dict.fromkeys(names, odd))
    supply(tmp_path, "BAT1", type="Battery", status=odd, capacity="50")
    supply(tmp_path, "BAT2", type=odd)
    (found, other) = read_batteries(tmp_path)
    assert found in (Battery("BAT0", "discharging", None, None), Battery("BAT0", "discharging", 0, None))
    assert other == Battery("BAT1", "unknown", 50, None)


def test_what_is_no_small_file_is_not_read(tmp_path: Path) -> None:
    place = supply(tmp_path, "BAT0", type="Battery", status="Full", energy_now=b"1" * 5000)
    os.mkfifo(place / "capacity")
    (place / "scope").symlink_to("/dev/zero")
    (tmp_path / "BAT1").write_text("no folder")
    assert read_batteries(tmp_path) == [Battery("BAT0", "full", None, None)]


def test_there_is_a_limit_to_the_number_of_supplies(tmp_path: Path) -> None:
    for index in range(20):
        supply(tmp_path, f"BAT{index}", type="Battery", status="Full", capacity="1")
    assert len(read_batteries(tmp_path)) == 16


def test_status_has_the_battery_while_its_recorder_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(status_view, "read_batteries", lambda: [Battery("BAT0", "discharging", 83, 3.1)])
    said = {}
    for state in ("recording", "stopped"):
        assert write_status(make_status(state=state), tmp_path / "gb1.status.json") is None
        said[state] = CliRunner().invoke(app, ["status", "--once", str(tmp_path)]).output
    assert "battery: 83 %, discharging, enough for 3.1 h\n" in said["recording"]
    assert "battery" not in said["stopped"]


@pytest.mark.parametrize("state", ["recording", "checked"])
def test_the_page_has_the_battery_below_the_disk(state: str) -> None:
    hub = Hub(create_autospec(Connection))
    hub.battery_rows = (("battery", "full", ""),)
    rows = (("disk", "9.0 GB free", "good"), ("clock", "synchronised", ""))
    hub.take(ToPage(PageState(state, rows), "", {}, None, ()), None)
    labels = [row[0] for row in json.loads(hub._state_json())["rows"]]
    assert labels == (["disk", "battery", "clock"] if state == "recording" else ["disk", "clock"])


def test_the_pages_process_looks_at_the_batteries(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(battery, "read_batteries", lambda: [Battery("BAT0", "full", 100, None)])
    monkeypatch.setattr(child, "time", Mock(sleep=Mock(side_effect=InterruptedError)))
    hub = Hub(create_autospec(Connection))
    with pytest.raises(InterruptedError):
        child._watch_batteries(hub)
    assert hub.battery_rows == (("battery", "100 %, full", ""),)


def test_the_recorders_process_never_reads_a_battery() -> None:
    """A gauge that does not answer blocks whoever reads it, and with the housekeeping its watchdog."""
    code = (
        "import sys, groundsbot.onboard.monitoring.recording, groundsbot.onboard.page.recording\n"
        "print([each for each in sys.modules if 'battery' in each])"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"
