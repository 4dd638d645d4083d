"""Frames that a V4L2 driver dropped show in the numbers of those it gave."""

import ctypes
import fcntl
import os
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import pytest

from groundsbot.onboard.camera.camera import CameraSettings
from groundsbot.onboard.camera.driver_sequence import DriverSequence
from groundsbot.onboard.camera.v4l2 import V4l2Camera
from groundsbot.onboard.log.messages import EventKind
from groundsbot.onboard.recorder import device_threads
from tests.support.devices.fake_capture import FakeCapture
from tests.support.devices.live_recording import recording, robot_yaml, tag_jpeg, until
from tests.support.devices.recorder_cores import events_of, frames_of

DEVICE = "/dev/full"  # a character device that no other process has open
N_BUFFERS = 4


class _TimeVal(ctypes.Structure):
    _fields_ = (("tv_sec", ctypes.c_long), ("tv_usec", ctypes.c_long))


class _TimeCode(ctypes.Structure):
    _fields_ = (
        ("type", ctypes.c_uint32),
        ("flags", ctypes.c_uint32),
        ("numbers", ctypes.c_uint8 * 4),
        ("userbits", ctypes.c_uint8 * 4),
    )


class Buffer(ctypes.Structure):
    """As struct v4l2_buffer stands in linux/videodev2.h."""

    _fields_ = (
        ("index", ctypes.c_uint32),
        ("type", ctypes.c_uint32),
        ("bytesused", ctypes.c_uint32),
        ("flags", ctypes.c_uint32),
        ("field", ctypes.c_uint32),
        ("timestamp", _TimeVal),
        ("timecode", _TimeCode),
        ("sequence", ctypes.c_uint32),
        ("memory", ctypes.c_uint32),
        ("m", ctypes.c_ulong),
        ("length", ctypes.c_uint32),
        ("reserved2", ctypes.c_uint32),
        ("request_fd", ctypes.c_int32),
    )


class FakeDriver:
    """Answers VIDIOC_QUERYBUF for the descriptor that streams: all buffers but one are with the driver."""

    def __init__(self, descriptor: int, numbers: Sequence[int]) -> None:
        self._descriptor = descriptor
        self._numbers = list(numbers)
        self.n_asked = 0

    def ioctl(self, descriptor: int, request: int, argument: bytes) -> bytes:
        assert descriptor == self._descriptor
        assert request == 0xC0000000 | ctypes.sizeof(Buffer) << 16 | 0x5609
        buffer = Buffer.from_buffer_copy(argument)
        assert (buffer.type, buffer.memory) == (1, 1)
        if buffer.index >= N_BUFFERS or not self._numbers:
            raise OSError(22, "Invalid argument")
        held = self.n_asked % N_BUFFERS
        buffer.flags = 0x2001 if buffer.index == held else (0x2003, 0x2005)[buffer.index % 2]
        buffer.sequence = 77
        if buffer.index == held:
            buffer.sequence = self._numbers.pop(0)
            self.n_asked += 1
        return bytes(buffer)


@pytest.fixture
def descriptor() -> Iterator[int]:
    made = os.open(DEVICE, os.O_RDWR | os.O_CLOEXEC)
    yield made
    os.close(made)


def numbers_of(monkeypatch: pytest.MonkeyPatch, descriptor: int, driver: Sequence[int], first: int = 0) -> list[int]:
    monkeypatch.setattr(fcntl, "ioctl", FakeDriver(descriptor, driver).ioctl)
    sequence = DriverSequence(DEVICE, first)
    return [sequence.take() for _ in driver]


@pytest.mark.parametrize(
    ("driver", "numbers"),
    [
        ([0, 1, 2, 3], [0, 1, 2, 3]),
        ([5, 6, 9, 10, 11, 20], [0, 1, 4, 5, 6, 15]),
        ([2**32 - 2, 2**32 - 1, 1, 2], [0, 1, 3, 4]),
        ([0, 0, 0], [0, 1, 2]),  # a driver that does not count
        ([7, 8, 0, 1], [0, 1, 2, 3]),  # or began anew
    ],
)
def test_numbers_follow_the_drivers(
    monkeypatch: pytest.MonkeyPatch, descriptor: int, driver: list[int], numbers: list[int]
) -> None:
    assert numbers_of(monkeypatch, descriptor, driver) == numbers
    assert numbers_of(monkeypatch, descriptor, driver, first=100) == [100 + each for each in numbers]


def test_without_an_answer_frames_are_numbered_as_they_come(tmp_path: Path, descriptor: int) -> None:
    del descriptor  # it answers no VIDIOC_QUERYBUF
    (tmp_path / "video0").touch()
    for device in (DEVICE, str(tmp_path / "video0"), str(tmp_path / "absent")):
        sequence = DriverSequence(device, 3)
        assert [sequence.take() for _ in range(3)] == [3, 4, 5]


def test_frames_that_a_driver_dropped_are_counted_and_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, descriptor: int
) -> None:
    """Also over a reconnection, after which the driver counts from 0 again."""
    captures = [FakeCapture([tag_jpeg()] * 4), FakeCapture([tag_jpeg()] * 4)]
    waiting = list(captures)
    driver = FakeDriver(descriptor, [10, 11, 14, 15, 0, 1, 2, 5])
    monkeypatch.setattr(fcntl, "ioctl", lambda fd, request, argument: driver.ioctl(fd, request, argument))
    monkeypatch.setattr(cv2, "VideoCapture", lambda *_: waiting.pop(0) if waiting else FakeCapture([]))
    settings = CameraSettings(DEVICE, 160, 120, 15.0)
    monkeypatch.setattr(device_threads, "camera_for", lambda _settings, clock, _since_ns: V4l2Camera(settings, clock))
    robot = robot_yaml(tmp_path, "{camera: pictures}", "{picture_rate_hz: 0}")
    with recording(robot, tmp_path / "logs") as made:
        made.wait_for_messages("/tags/detections", 8)
        until(lambda: made.losses.get("pictures", 0) == 4, "the lost ones")
    assert [each.frame_sequence for each in frames_of(made.log)] == [0, 1, 4, 5, 6, 7, 8, 11]
    told = events_of(made.log, EventKind.FRAME_DROPPED)
    assert sum(each.count for each in told) == 4
    assert "dropped by the camera's driver" in told[0].text
