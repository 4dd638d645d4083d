"""The real recorder in a thread of the test, on devices without hardware."""

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import takewhile
from pathlib import Path

import cv2
import numpy as np

from groundsbot.calib.camera.file import write_camera_yaml
from groundsbot.calib.camera.model import CameraModel
from groundsbot.fixtures.recording.devices import PictureFolder, PtyPort, gyro_line, pace, wheel_line
from groundsbot.onboard.detection.child_process import ChildDetector
from groundsbot.onboard.log.messages import Event
from groundsbot.onboard.recorder.live_recorder import LiveRecorder
from groundsbot.onboard.recorder.robot_files import RobotFiles
from tests.support.devices.recorder_cores import wheels_of
from tests.support.tag_pictures import draw_tag

CAMERA = CameraModel("front", 160, 120, 150.0, 150.0, 79.5, 59.5, "plumb_bob", (0.0,) * 5)
CORNERS = np.array([[50.0, 30.0], [110.0, 32.0], [108.0, 92.0], [52.0, 90.0]])
PATIENCE_S = 120.0  # only what hangs comes near
# For a recorder's process: whatever the devices still hold is taken in, however long a busy machine takes for it.
PATIENT = """
from groundsbot.onboard.recorder import live_recorder, recorder, waiting_detections
from groundsbot.onboard.camera.folder import FolderCamera
live_recorder._END_LIMIT_NS = 120_000_000_000
FolderCamera.patience_s = 120.0
recorder.WAIT_FOR_WHEELS_NS = waiting_detections.WAIT_FOR_WHEELS_NS = 120_000_000_000
"""


@contextmanager
def repeat(act: Callable[[int], object], rate_hz: float) -> Iterator[None]:
    """Calls `act(0)`, `act(1)`, ... at a steady rate from a thread while the block runs, however long that takes."""
    enough = threading.Event()

    def loop() -> None:
        for index in takewhile(lambda _: not enough.is_set(), pace(rate_hz)):
            act(index)

    thread = threading.Thread(target=loop, daemon=True)
    thread.start()
    try:
        yield
    finally:
        enough.set()
        thread.join()


def tag_jpeg() -> bytes:
    """A picture of tag36h11 9, as large as the calibration says."""
    return cv2.imencode(".jpg", draw_tag("tag36h11", 9, CORNERS, (120, 160)))[1].tobytes()


def robot_yaml(folder: Path, devices: str, recorder: str = "{picture_rate_hz: 5}") -> Path:
    """Writes robot.yaml and camera.yaml."""
    write_camera_yaml(CAMERA, folder / "camera.yaml")
    path = folder / "robot.yaml"
    path.write_text(f"""
robot_id: gb1
wheels: {{radius_left_m: 0.05, radius_right_m: 0.05, track_m: 0.3, ticks_per_turn: 1024}}
camera: camera.yaml
devices: {devices}
recorder: {recorder}
""")
    return path


def two_cameras_yaml(folder: Path, recorder: str = "{picture_rate_hz: 1000}") -> Path:
    """Writes robot.yaml of a robot with the cameras front and left, folders of these names."""
    path = robot_yaml(folder, f"{{encoder_port: {folder / 'wheels'}}}", recorder)
    path.write_text(f"""{path.read_text().replace("camera: camera.yaml", "")}
cameras:
  front: {{camera: camera.yaml, device: {{camera: front, camera_fps: 30}}}}
  left: {{camera: camera.yaml, mount: {{yaw_rad: 1.5}}, device: {{camera: left, camera_fps: 30}}}}
""")
    return path


def until(true: Callable[[], bool], what: str) -> None:
    """Waits for something that is to come."""
    end_s = time.monotonic() + PATIENCE_S
    while not true():
        assert time.monotonic() < end_s, f"never came: {what}"
        time.sleep(0.005)


def has_ended(child: ChildDetector) -> bool:
    """Whether its process has: it can only be let go of then."""
    try:
        return not child._process.is_alive()
    except ValueError:
        return True


class Recording:
    """A recording under way."""

    def __init__(self, robot: Path, output: Path) -> None:
        self.events: list[Event] = []
        self.notices: list[str] = []
        self.stop = threading.Event()
        self.recorder = LiveRecorder(RobotFiles(robot), output, self.stop, self.events.append, self.notices.append)
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, daemon=True)

    def _run(self) -> None:
        try:
            self.recorder.run()
        except BaseException as error:
            self._error = error

    def start(self) -> None:
        self._thread.start()
        until(lambda: self.recorder.begun.is_set() or self._error is not None, "a beginning")
        self._raise()

    def end(self, limit_s: float = PATIENCE_S) -> None:
        """Stops it; fails where it does not end within the limit."""
        self.stop.set()
        self._thread.join(limit_s)
        assert not self._thread.is_alive(), f"did not end within {limit_s} s"
        self._raise()

    def _raise(self) -> None:
        if self._error is not None:
            raise self._error

    @property
    def log(self) -> Path:
        return self.recorder.core.folder

    @property
    def losses(self) -> dict[str, int]:
        return dict(self.recorder.core.losses)

    def count(self, kind: str) -> int:
        """Events of a kind so far."""
        return sum(event.kind == kind for event in list(self.events))

    def wait_for(self, kind: str, times: int = 1) -> None:
        """Waits until so many events of a kind have come."""
        until(lambda: self.count(kind) >= times, f"{times} {kind}")

    def wait_for_messages(self, topic: str, times: int) -> None:
        """Waits until so many messages of a topic have come."""
        until(lambda: self.recorder.core.counts[topic] >= times, f"{times} {topic}")


@contextmanager
def recording(robot: Path, output: Path) -> Iterator[Recording]:
    """Records while the block runs."""
    made = Recording(robot, output)
    made.start()
    try:
        yield made
    finally:
        made.end()


def show_until(camera: PictureFolder, picture: bytes, made: Recording, times: int) -> None:
    """Shows a picture again and again until so many were looked at in all."""

    def show() -> bool:
        camera.show(picture)
        time.sleep(0.02)
        return made.recorder.core.counts["/tags/detections"] >= times

    until(show, f"{times} pictures")


def check_gapless(log: Path, refused: Sequence[int]) -> int:
    """Asserts that a log has each line between its first and its last, but for those that the port refused.

    Returns:
        How many these are.
    """
    found = [reading.sequence for reading in wheels_of(log)]
    assert found == [each for each in range(found[0], found[-1] + 1) if each not in set(refused)]
    return found[-1] + 1 - found[0] - len(found)


class Driver:
    """Sends lines at 100 Hz into whatever port is plugged in, from a thread.

    Attributes:
        port: the one that is plugged in.
        sent: lines so far, those without a reader included.
        refused: the numbers of those for which the port had no room, as its reader was held up.
    """

    def __init__(self, link: Path, rate_hz: float = 100.0, *, gyro: bool = False) -> None:
        self.port: PtyPort | None = None
        self.gyro = gyro  # sends two samples with each line
        self.sent = 0
        self.refused: list[int] = []
        self._link = link
        self._period_s = 1.0 / rate_hz
        self._over = threading.Event()
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._drive, daemon=True)

    def plug_in(self) -> str:
        """Returns the name that the port has this time."""
        with self._lock:
            self.port = PtyPort(self._link)
            return self.port.name

    def unplug(self) -> None:
        with self._lock:
            assert self.port is not None
            self.port.unplug()
            self.port = None

    def _drive(self) -> None:
        while not self._over.wait(self._period_s):
            with self._lock:
                now_ns = time.monotonic_ns()
                data = wheel_line(self.sent, now_ns) + (gyro_line(self.sent, now_ns) if self.gyro else b"")
                if self.port is not None and not self.port.send(data):
                    self.refused.append(self.sent)
            self.sent += 1

    def __enter__(self) -> "Driver":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()
        if self.port is not None:
            self.port.unplug()
