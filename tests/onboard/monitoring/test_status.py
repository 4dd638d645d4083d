"""A recorder's status: what it says, that it is there whole, and what the command makes of it."""

import json
import os
import re
import threading
import time
from io import StringIO
from pathlib import Path
from typing import Any, cast

import pytest
from rich.console import Console
from typer.testing import CliRunner

from groundsbot.fixtures.recording.devices import PictureFolder
from groundsbot.onboard.cli import app
from groundsbot.onboard.errors import OnboardError
from groundsbot.onboard.log.messages import Event, EventKind, Severity
from groundsbot.onboard.monitoring import status as status_module
from groundsbot.onboard.monitoring.housekeeping import Housekeeper
from groundsbot.onboard.monitoring.status import Rates, RecordingSnapshot, Status, is_alive, read_status, write_status
from groundsbot.onboard.monitoring.status_rows import rows
from groundsbot.onboard.monitoring.status_view import _panel
from groundsbot.onboard.process.systemd import Notifier
from tests.support.devices.live_recording import Driver, recording, robot_yaml, tag_jpeg, two_cameras_yaml, until
from tests.support.devices.recorder_cores import START_NS, S


def look(second: float, lines: int, written_bytes: int = 0, losses: dict[str, int] | None = None) -> RecordingSnapshot:
    now_ns = START_NS + round(second * S)
    return RecordingSnapshot(now_ns, {"/wheels": lines}, {"/wheels": now_ns - S // 4}, written_bytes, losses or {})


def test_rates_are_of_the_last_seconds_and_growth_of_the_last_minutes() -> None:
    rates = Rates()
    for second in range(300):
        rates.add(look(second, 100 * min(second, 250) + 10 * max(0, second - 250), 1_000_000 * second))
    wheels = rates.device("/wheels", "port", expected=True)
    assert wheels.rate_hz == 10.0
    assert wheels.age_s == 0.25
    assert rates.bytes_per_s() == 1_000_000
    assert len(rates._looks) <= 122  # however long the day
    camera = rates.device("/tags/detections", "camera", expected=True)
    assert (camera.rate_hz, camera.age_s) == (0.0, None)
    assert Rates().bytes_per_s() is None


def test_losses_are_of_now_for_ten_seconds() -> None:
    rates = Rates()
    lately = []
    for second in range(30):
        rates.add(look(second, 0, losses={"wheel lines": 5} if second >= 8 else {}))
        lately.append(rates.lost_lately())
    assert lately == [{}] * 8 + [{"wheel lines": 5}] * 10 + [{}] * 12
    assert Rates().lost_lately() == {}


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Silence is a problem after one second."""
    monkeypatch.setattr("groundsbot.onboard.monitoring.housekeeping._SILENT_S", 1.0)
    monkeypatch.setattr("groundsbot.onboard.recorder.watches._WHEEL_SILENCE_NS", 800_000_000)


@pytest.mark.usefixtures("impatient")
def test_the_status_of_a_recording(tmp_path: Path) -> None:
    robot = robot_yaml(tmp_path, f"{{encoder_port: {tmp_path / 'wheels'}, camera: pictures}}")
    camera, path = PictureFolder(tmp_path / "pictures"), tmp_path / "logs" / "gb1.status.json"
    seen: list[Status] = []
    said: list[str] = []

    def shows(lines: int) -> bool:
        camera.show(tag_jpeg())
        time.sleep(0.05)
        if path.exists():
            seen.append(read_status(tmp_path / "logs"))  # at any moment whole
        return bool(seen) and seen[-1].counts.get("/wheels", 0) > lines and bool(seen[-1].tags_in_view)

    with Driver(tmp_path / "wheels") as driver:
        driver.plug_in()
        with recording(robot, tmp_path / "logs") as made:
            keeper = Housekeeper(made.recorder, path, Notifier(), said.append, period_s=0.1)
            keeper.start()
            until(lambda: shows(100), "a status")
            driver.unplug()
            made.wait_for(EventKind.PORT_LOST)
            keeper.note(made.events[-1])
            until(lambda: shows(0) and "no wheel readings for 1 s" in seen[-1].problems, "a problem")
            until(lambda: not read_status(path).tags_in_view, "the tags of a camera that fell silent to go")
            assert "no pictures for 1 s" in read_status(path).problems
        keeper.end()
    assert (seen[-1].robot_id, seen[-1].pid, seen[-1].state) == ("gb1", os.getpid(), "recording")
    assert any(each.wheels.rate_hz > 0.0 for each in seen)
    assert all(each.counts.get("/wheels", 0) <= driver.sent for each in seen)
    assert seen[-1].tags_in_view == ["tag36h11 9"]
    assert "port_lost" in seen[-1].last_events[-1]
    assert seen[-1].disk.free_bytes > 0
    last = read_status(path)
    assert last.state == "stopped"
    assert not is_alive(last)
    assert sorted(each.name for each in (tmp_path / "logs").iterdir() if "status" in each.name) == [path.name]


@pytest.mark.usefixtures("impatient")
def test_each_camera_has_its_rate_and_is_missed_by_its_name(tmp_path: Path) -> None:
    front, picture = PictureFolder(tmp_path / "front"), tag_jpeg()
    PictureFolder(tmp_path / "left")
    with recording(two_cameras_yaml(tmp_path), tmp_path / "logs") as made:
        keeper = Housekeeper(made.recorder, tmp_path / "x.json", Notifier(), print)

        def is_right() -> bool:
            front.show(picture)
            time.sleep(0.05)
            seen = keeper._write("recording")
            return (
                seen is not None
                and seen.problems == ["no wheel readings for 1 s", "no pictures of left for 1 s"]
                and seen.tags_in_view == ["tag36h11 9 in front"]
                and seen.cameras["front"].rate_hz > 0.0
            )

        until(is_right, "pictures of front alone")
        last = read_status(tmp_path / "x.json")
    assert (last.cameras["left"].age_s, last.cameras["left"].name) == (None, "left")
    shown = {label: text for label, text, _ in rows(read_status(tmp_path / "x.json"))}
    assert shown["camera left"] == "left: nothing yet"
    assert shown["camera front"].startswith("front: ")


def test_events_of_a_kind_take_one_line(tmp_path: Path) -> None:
    keeper = Housekeeper(cast(Any, None), tmp_path / "x.json", Notifier(), print)
    warning, info = Severity.SEVERITY_WARNING, Severity.SEVERITY_INFO
    for severity, kind, text in (
        (warning, EventKind.PORT_LOST, "unplugged"),
        *((warning, EventKind.WHEEL_GAP, f"{index} lines missing") for index in range(100)),
        (info, EventKind.PORT_CONNECTED, "port"),
        (warning, EventKind.DISK, "full"),
    ):
        keeper.note(Event(severity=Severity.Name(severity), kind=kind, text=text))
    first, second, third = keeper.last_events()
    assert first[8:] == " port_lost: unplugged"
    assert re.fullmatch(r"..:..:.. wheel_gap: 99 lines missing \(100 times since ..:..:..\)", second)
    assert third[8:] == " disk: full"


def test_pictures_dropped_for_space_are_wrong_now(tmp_path: Path) -> None:
    robot = robot_yaml(tmp_path, "{camera: pictures}", "{picture_rate_hz: 5, keep_free_mb: 1000000000}")
    PictureFolder(tmp_path / "pictures")
    with recording(robot, tmp_path / "logs") as made:
        keeper = Housekeeper(made.recorder, tmp_path / "x.json", Notifier(), print)

        def has_problem() -> bool:
            status = keeper._write("recording")
            return status is not None and "disk: little space left: pictures are not kept" in status.problems

        until(has_problem, "a problem")


def test_the_services_status_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    service, output, other = (tmp_path / name for name in ("run", "output", "other"))
    for folder in (service, output, other):
        folder.mkdir()
    monkeypatch.setattr(status_module, "SERVICE_FOLDER", service)
    monkeypatch.chdir(other)
    with pytest.raises(OnboardError, match="there is no status"):
        read_status(Path())
    assert write_status(make_status(folder=str(output / "run1")), service / "robot.status.json") is None
    assert read_status(Path()).run_id == read_status(output).run_id == "run1"
    with pytest.raises(OnboardError, match="there is no status"):
        read_status(other)
    assert write_status(make_status(run_id="mine"), other / "gb1.status.json") is None
    assert read_status(Path()).run_id == "mine"


@pytest.mark.usefixtures("impatient")
def test_the_status_of_a_gyro_on_the_controller(tmp_path: Path) -> None:
    """There once it was heard, and missed when it is silent; the wheels go on."""
    robot = robot_yaml(tmp_path, f"{{encoder_port: {tmp_path / 'wheels'}}}")
    path = tmp_path / "logs" / "gb1.status.json"

    def status() -> Status | None:
        return read_status(path) if path.exists() else None

    def hears(samples: int) -> bool:
        shown = status()
        return shown is not None and shown.gyro is not None and shown.counts.get("/gyro", 0) > samples

    def misses() -> bool:
        shown = status()
        return shown is not None and "no yaw rates for 1 s" in shown.problems

    with Driver(tmp_path / "wheels") as driver, recording(robot, tmp_path / "logs") as made:
        keeper = Housekeeper(made.recorder, path, Notifier(), lambda _: None, period_s=0.1)
        keeper.start()
        driver.plug_in()
        until(lambda: (shown := status()) is not None and shown.counts.get("/wheels", 0) > 20, "wheels")
        before = status()
        assert before is not None
        assert before.gyro is None
        driver.gyro = True
        until(lambda: hears(40), "yaw rates")
        driver.gyro = False
        until(misses, "a problem")
        made.wait_for(EventKind.NO_GYRO_DATA)
        keeper.end()
    assert made.count(EventKind.NO_GYRO_DATA) == 1


def make_status(**changes: object) -> Status:
    device = {"name": "port", "rate_hz": 100.0, "age_s": 0.0, "expected": True}
    disk = {"free_bytes": 10**9, "bytes_per_s": 1e4, "hours_left": 27.8, "waiting_bytes": 0, "problem": None}
    values: dict[str, object] = {
        "robot_id": "gb1", "run_id": "run1", "folder": "logs/run1", "pid": 1, "state": "recording",
        "updated_ns": time.time_ns(), "recording_s": 3723.0, "wheels": device, "camera": device,
        "tags_in_view": ["tag36h11 4"], "counts": {}, "losses": {}, "disk": disk, "clock_synchronised": True,
        "stalled_s": 0.0, "problems": [], "last_events": [],
    }  # fmt: skip
    return Status.model_validate({**values, **changes})


@pytest.mark.parametrize(
    ("changes", "code", "words"),
    [
        ({}, 0, ["recording, 1:02:03", "100.0 lines/s", "tag36h11 4", "lost so far: nothing", "enough for 27.8 h"]),
        (
            {"gyro": {"name": "port", "rate_hz": 200.0, "age_s": 0.0, "expected": True}},
            0,
            ["gyro: port: 200.0 samples/s, the newest 0.00 s old"],
        ),
        ({"losses": {"pictures": 3}}, 0, ["lost so far: 3 pictures"]),
        ({"problems": ["disk: full"]}, 3, ["wrong now: disk: full"]),
        ({"updated_ns": 0}, 1, ["gone: no status"]),
        ({"state": "stopped"}, 1, ["recorder: stopped"]),
    ],
)
def test_the_command_says_it_in_plain_lines(
    tmp_path: Path, changes: dict[str, object], code: int, words: list[str]
) -> None:
    assert write_status(make_status(**changes), tmp_path / "gb1.status.json") is None
    said = CliRunner().invoke(app, ["status", "--once", str(tmp_path)])
    assert said.exit_code == code
    assert [word for word in words if word not in said.output] == []


def test_without_a_status_the_command_says_so(tmp_path: Path) -> None:
    with pytest.raises(OnboardError, match="there is no status of a recorder"):
        read_status(tmp_path)
    (tmp_path / "x.status.json").write_text(json.dumps({"format_version": 1}))
    with pytest.raises(OnboardError, match="is not a status"):
        read_status(tmp_path)


def test_a_status_is_never_written_through_a_link(tmp_path: Path) -> None:
    victim, path = tmp_path / "victim", tmp_path / "gb1.status.json"
    victim.write_text("precious")
    path.symlink_to(victim)
    (tmp_path / f".{path.name}.{os.getpid()}.partial").symlink_to(victim)
    assert write_status(make_status(), path) is None
    assert victim.read_text() == "precious"
    assert read_status(path).robot_id == "gb1"


def test_a_disk_that_will_not_have_the_status_does_not_stop_the_recorder(tmp_path: Path) -> None:
    assert write_status(make_status(), tmp_path / "absent" / "gb1.status.json") == "No such file or directory"


class FakeRecorder:
    """As much of a recorder as decides what systemd is told."""

    def __init__(self) -> None:
        self.begun = threading.Event()
        self.begun.set()
        self.is_stopping = False
        self.stalled_s = 0.0
        self.log = self


class FakeNotifier:
    """Notes what systemd is told."""

    watchdog_s: float | None = 0.02  # so that looks come every 5 ms

    def __init__(self) -> None:
        self.said: list[str] = []

    def ready(self) -> None:
        self.said.append("ready")

    def alive(self, _text: str) -> None:
        self.said.append("alive")

    def notify_trouble(self, _text: str) -> None:
        self.said.append("troubled")

    def stopping(self) -> None:
        self.said.append("stopping")


def test_only_a_log_that_stands_still_keeps_the_watchdog_from_its_food(tmp_path: Path) -> None:
    recorder, notifier, notices = FakeRecorder(), FakeNotifier(), list[str]()
    keeper = Housekeeper(cast(Any, recorder), tmp_path / "x.json", cast(Any, notifier), notices.append)
    keeper.start()  # each look fails: this recorder has no core
    until(lambda: notifier.said.count("alive") >= 3, "food")
    recorder.stalled_s = 100.0
    until(lambda: "troubled" in notifier.said, "trouble")
    assert len(notices) == 1
    assert "status: cannot be determined (AttributeError" in notices[0]
    recorder.is_stopping = True
    until(lambda: "stopping" in notifier.said, "the end")
    recorder.stalled_s = 0.0
    n_looks = len(notifier.said)
    time.sleep(0.05)  # some looks more
    keeper.end()
    assert notifier.said[n_looks:] == []
    assert notifier.said[-1] == "stopping"


def test_a_status_that_cannot_be_written_is_told_of_once(tmp_path: Path) -> None:
    robot = robot_yaml(tmp_path, f"{{encoder_port: {tmp_path / 'wheels'}}}")
    said: list[str] = []
    output = tmp_path / "logs\udcff"  # no UTF-8
    with recording(robot, output) as made:
        keeper = Housekeeper(made.recorder, tmp_path / "absent" / "x.json", Notifier(), said.append, period_s=0.01)
        status = [keeper._write("recording") for _ in range(3)][-1]
    assert said == [f"status: {tmp_path / 'absent' / 'x.json'} cannot be written (No such file or directory)"]
    assert status is not None
    assert "logs\\xff" in status.folder
    assert write_status(status, tmp_path / "x.json") is None


def test_a_status_that_is_a_link_to_nothing_is_none(tmp_path: Path) -> None:
    (tmp_path / "a.status.json").symlink_to("gone")
    with pytest.raises(OnboardError, match="there is no status of a recorder"):
        read_status(tmp_path)


def test_control_characters_of_a_status_do_not_reach_the_terminal(tmp_path: Path) -> None:
    hostile = {"last_events": ["\x1b]0;owned\x07"], "robot_id": "a\x1b[2J", "problems": ["\x9b31m\rred"]}
    assert write_status(make_status(**hostile), tmp_path / "gb1.status.json") is None
    said = CliRunner().invoke(app, ["status", "--once", str(tmp_path)])
    assert said.exit_code == 3
    assert not {"\x1b", "\x9b", "\x07", "\r"} & set(said.output)
    assert "event: \\x1b]0;owned\\x07" in said.output
    screen = Console(file=StringIO(), force_terminal=True, color_system=None, width=100)
    screen.print(_panel(read_status(tmp_path)))
    drawn = cast(StringIO, screen.file).getvalue()
    assert not {"\x1b", "\x9b", "\x07", "\r"} & set(drawn)
    assert "a\\x1b[2J" in drawn
