"""How a recording ends: by signals, blocked, stalled; and how it never begins. Rows of the table of faults."""

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.writer import MCAP0_MAGIC

from groundsbot.fixtures.recording.devices import PictureFolder, PtyPort, wheel_line
from groundsbot.onboard.errors import OnboardError
from groundsbot.onboard.log.reading.reader import find_logs, read_log
from groundsbot.onboard.monitoring.status import read_status
from tests.support.devices.live_recording import PATIENCE_S, PATIENT, repeat, robot_yaml, tag_jpeg, until
from tests.support.devices.recorder_cores import frames_of, wheels_of
from tests.support.paths import ROOT
from tests.support.processor_wait import wait_for_end
from tests.support.programs import running

LIMIT_S = 5.0
DEVICES = "{encoder_port: wheels, encoder_baud: 115200, camera: pictures, camera_fps: 15}"
BOTH_SIGNALS = (signal.SIGTERM, signal.SIGINT)
# The parent of the tests (nohup, or a shell in the background) may have set SIGHUP or SIGINT to be ignored, which the
# recorder would inherit.
TOLD_BY_SIGNALS = """
import signal
for each in (signal.SIGTERM, signal.SIGHUP):
    signal.signal(each, signal.SIG_DFL)
signal.signal(signal.SIGINT, signal.default_int_handler)
"""
# Devices that never come back from a read, and a detection that never answers.
BLOCKED = """
import os, signal, time
from groundsbot.onboard.wheels.port import EncoderPort
from groundsbot.onboard.camera.folder import FolderCamera
from functools import partial
from groundsbot.onboard.recorder import camera_detection
reads = {EncoderPort: EncoderPort.read, FolderCamera: FolderCamera.read}
def blocking(device):
    given = False  # what the devices gave last is still under way then
    def read(self, timeout_s):
        nonlocal given
        if given:
            print("blocked", device.__name__, flush=True)
            time.sleep(1e6)
        last = os.path.exists("block")
        found = reads[device](self, timeout_s)
        given = last and bool(found)
        return found
    return read
for device in reads:
    device.read = blocking(device)
camera_detection.ChildDetector = partial(camera_detection.ChildDetector, job_limit_s=1e6)
"""
# A disk that never comes back from a sync, which is said after a second and a half.
STALLED = """
import os, time
from groundsbot.onboard.monitoring import housekeeping
housekeeping._STALLED_S = 1.5
fdatasync = os.fdatasync
def stalling(file):
    while os.path.exists("stall"):
        time.sleep(0.05)
    fdatasync(file)
os.fdatasync = stalling
"""


def recorder(
    folder: Path,
    robot: Path,
    before: str = "",
    stdout: int = subprocess.PIPE,
    environment: Mapping[str, str] | None = None,
) -> AbstractContextManager["subprocess.Popen[str]"]:
    """`groundsbot-onboard record` as a process of its own, working in `folder`."""
    program = f"import sys\n{TOLD_BY_SIGNALS}\n{before}\nfrom groundsbot.onboard.cli import main\nmain()"
    command = [sys.executable, "-c", program, "record", "--robot", str(robot), "--output", "logs"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), **(environment or {})}
    return running(command, folder=folder, stdout=stdout, environment=environment, own_group=True)


def wait_for(process: "subprocess.Popen[str]", *words: str) -> None:
    """Reads what the process says until each word has come."""
    assert process.stdout is not None
    left = set(words)
    while left:
        line = process.stdout.readline()
        assert line, f"ended without {left}"
        left -= {word for word in left if word in line}


def wait_for_load(folder: Path) -> None:
    """Waits until the recorder says by its status that all is flowing."""

    until(
        lambda: counts(folder).get("/wheels", 0) > 1000 and counts(folder).get("/tags/detections", 0) > 30, "the load"
    )


def counts(folder: Path) -> dict[str, int]:
    """Of the messages so far, as the recorder's status says."""
    try:
        return read_status(folder / "logs").counts
    except OnboardError:
        return {}


def only_log(folder: Path) -> Path:
    (log,) = find_logs([folder / "logs"])
    return log


def check_finished(log: Path) -> None:
    """Every file has its index, and one end."""
    files = sorted(log.iterdir())
    assert files
    assert [path.suffix for path in files] == [".mcap"] * len(files)
    for path in files:
        assert path.read_bytes().count(MCAP0_MAGIC) == 2  # at its beginning and its end
        with path.open("rb") as file:
            summary = make_reader(file).get_summary()
        assert summary is not None
        assert summary.chunk_indexes


@contextmanager
def full_load(folder: Path) -> Iterator[None]:
    """1 kHz of lines and 30 pictures a second, until the block ends."""
    port = PtyPort(folder / "wheels", patient=True)  # a busy machine may hold up the test as well as the recorder
    camera, picture = PictureFolder(folder / "pictures"), tag_jpeg()
    with (
        repeat(lambda index: port.send(wheel_line(index, time.monotonic_ns())), 1000.0),
        repeat(lambda _: camera.show(picture), 30.0),
    ):
        try:
            yield
        finally:
            port.unplug()  # else a line may wait for a reader that has ended


@pytest.fixture
def both(tmp_path: Path) -> Path:
    return robot_yaml(tmp_path, f"{{encoder_port: {tmp_path / 'wheels'}, camera: pictures}}", "{picture_rate_hz: 30}")


@pytest.mark.parametrize("number", [*BOTH_SIGNALS, signal.SIGHUP])
def test_row_16_a_request_to_end_at_full_load(tmp_path: Path, both: Path, number: signal.Signals) -> None:
    """With its detection, as a terminal does: by Ctrl-C, or where it is closed."""
    with full_load(tmp_path), recorder(tmp_path, both, PATIENT) as process:
        wait_for_load(tmp_path)
        os.killpg(process.pid, number)
        said = wait_for_end(process, LIMIT_S)
    assert process.returncode == 0, said
    log = only_log(tmp_path)
    check_finished(log)
    sequences = [reading.sequence for reading in wheels_of(log)]
    assert sequences == list(range(sequences[0], sequences[0] + len(sequences)))
    assert len(sequences) > 500
    assert len(frames_of(log)) > 20
    assert len(list(read_log(log, ["/camera/image"]))) == len(frames_of(log))


def test_row_17_repeated_requests_to_end_while_closing(tmp_path: Path, both: Path) -> None:
    with full_load(tmp_path), recorder(tmp_path, both) as process:
        wait_for_load(tmp_path)
        insisting = threading.Thread(target=tell_until_it_ends, args=(process,), daemon=True)
        insisting.start()
        said = wait_for_end(process, LIMIT_S)
        insisting.join()
    assert process.returncode in (0, -signal.SIGTERM, -signal.SIGINT), said  # the latter: as it was leaving already
    check_finished(only_log(tmp_path))
    assert "Traceback" not in said


def tell_until_it_ends(process: "subprocess.Popen[str]") -> None:
    while process.returncode is None:
        process.send_signal(BOTH_SIGNALS[time.monotonic_ns() % 2])
        time.sleep(0.003)


def test_row_18_a_request_to_end_while_port_camera_and_detection_block(tmp_path: Path, both: Path) -> None:
    with full_load(tmp_path), recorder(tmp_path, both, BLOCKED) as process:
        wait_for_load(tmp_path)
        for child in Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split():
            if "spawn_main" in Path(f"/proc/{child}/cmdline").read_text():
                os.kill(int(child), signal.SIGSTOP)
        (tmp_path / "block").touch()
        wait_for(process, "blocked EncoderPort", "blocked FolderCamera")
        process.send_signal(signal.SIGTERM)
        said = wait_for_end(process, LIMIT_S)
    assert process.returncode == 3, said  # the pictures that the detection had
    assert "detection had not ended" in said
    log = only_log(tmp_path)
    check_finished(log)
    sequences = [reading.sequence for reading in wheels_of(log)]
    assert sequences == list(range(sequences[0], sequences[0] + len(sequences)))


def test_row_18_a_terminal_that_takes_no_more_lines_holds_up_neither_recording_nor_end(tmp_path: Path) -> None:
    robot = robot_yaml(tmp_path, f"{{encoder_port: {tmp_path / 'wheels'}}}")
    read_fd, write_fd = os.pipe()
    os.set_blocking(write_fd, False)
    with suppress(BlockingIOError):
        while True:
            os.write(write_fd, b"\n")
    os.set_blocking(write_fd, True)
    with full_load(tmp_path), recorder(tmp_path, robot, stdout=write_fd) as process:
        os.close(write_fd)
        until(lambda: counts(tmp_path).get("/wheels", 0) > 1000, "readings")
        process.send_signal(signal.SIGTERM)
        wait_for_end(process, LIMIT_S)
    os.close(read_fd)
    assert process.returncode == 0
    check_finished(only_log(tmp_path))
    assert len(wheels_of(only_log(tmp_path))) > 1000


class Systemd:
    """Listens as systemd does."""

    def __init__(self, path: Path) -> None:
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(str(path))
        self._socket.settimeout(PATIENCE_S)
        self.heard: list[str] = []

    def next(self) -> str:
        """The next notice."""
        self.heard.append(self._socket.recv(4096).decode())
        return self.heard[-1]

    def wait_for(self, text: str, times: int = 1) -> None:
        """Listens until so many notices had the text."""
        while times:
            times -= text in self.next()

    def rest(self) -> list[str]:
        """Messages not yet read, of a process that has ended."""
        self._socket.setblocking(False)
        said = []
        with suppress(BlockingIOError):
            while True:
                said.append(self.next())
        return said


def test_row_40_a_stalled_writer_does_not_feed_the_watchdog(tmp_path: Path) -> None:
    """What systemd then does, the test does: it kills the recorder and starts it again."""
    robot = robot_yaml(tmp_path, f"{{encoder_port: {tmp_path / 'wheels'}}}")
    systemd = Systemd(tmp_path / "notify")
    listening = {"NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": "2000000"}
    with full_load(tmp_path):
        with recorder(tmp_path, robot, STALLED, environment=listening) as process:
            wait_for(process, "port_connected")
            assert systemd.next() == "READY=1"
            systemd.wait_for("WATCHDOG=1", 2)
            until(lambda: counts(tmp_path).get("/wheels", 0) > 1000, "readings")
            systemd.wait_for("WATCHDOG=1", 2)  # meanwhile those are safe
            safe = tmp_path / "stall"
            safe.touch()
            systemd.wait_for("the log has made no progress")
            assert not [said for said in (systemd.next() for _ in range(3)) if "WATCHDOG=1" in said]
            process.kill()
            process.wait()
            safe.unlink()
        with recorder(tmp_path, robot, STALLED, environment=listening) as process:
            wait_for(process, "port_connected")
            systemd.wait_for("READY=1")
            systemd.wait_for("WATCHDOG=1")
            process.send_signal(signal.SIGTERM)
            wait_for_end(process, LIMIT_S)
    said = systemd.rest()
    assert said.count("STOPPING=1") == 1
    assert not [each for each in said[said.index("STOPPING=1") :] if "WATCHDOG=1" in each]
    first, second = find_logs([tmp_path / "logs"])
    assert len(wheels_of(first)) > 1000  # what came before the stall
    check_finished(second)


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("radius_left_m: 0.05", "radius_left_m: 50", ["robot.yaml", "wheels.radius_left_m", "50", "10"]),
        ("radius_left_m: 0.05", "radius_left_m: -1", ["robot.yaml", "wheels.radius_left_m", "-1", "0"]),
        ("track_m: 0.3", "track_m: 0.3, wheelbase_m: 0.4", ["robot.yaml", "wheels.wheelbase_m"]),
        ("ticks_per_turn: 1024", "tics_per_turn: 1024", ["robot.yaml", "wheels.ticks_per_turn"]),
        ("camera: camera.yaml", "camera: gone.yaml", ["gone.yaml"]),
        ("camera: camera.yaml\n", "", ["robot.yaml", "devices.camera", "calibration"]),
        ("encoder_baud: 115200", "encoder_baud: 0", ["robot.yaml", "devices.encoder_baud", "0"]),
        ("camera_fps: 15", "camera_fps: .nan", ["robot.yaml", "devices.camera_fps", "nan"]),
        ("quad_decimate: 2.0", "quad_decimate: 9.0", ["robot.yaml", "recorder.quad_decimate", "9", "8"]),
        ("detector: pupil-apriltags", "detector: magic", ["robot.yaml", "recorder.detector", "magic"]),
        ("robot_id: gb1", "robot_id: [", ["robot.yaml"]),
        (DEVICES, "{}", ["robot.yaml", "devices names neither encoder_port nor camera"]),
    ],
)
def test_row_41_a_bad_file_is_one_line_at_the_start(tmp_path: Path, old: str, new: str, expected: list[str]) -> None:
    robot = robot_yaml(tmp_path, DEVICES, "{quad_decimate: 2.0, detector: pupil-apriltags}")
    assert old in robot.read_text()
    robot.write_text(robot.read_text().replace(old, new))
    with recorder(tmp_path, robot) as process:
        said, _ = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 1
    assert said.startswith("error: ")
    assert said.count("\n") == 1
    assert [word for word in expected if word not in said] == []
    assert not (tmp_path / "logs").exists()
