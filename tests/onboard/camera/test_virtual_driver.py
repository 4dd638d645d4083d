"""Capture from a Video4Linux device of the kernel, whose driver `vivid` draws a test picture."""

from pathlib import Path

import numpy as np
import pytest

from groundsbot.onboard.camera.camera import CameraSettings
from groundsbot.onboard.camera.v4l2 import V4l2Camera
from groundsbot.onboard.log.messages import StampSource
from groundsbot.onboard.process.clock import RunClock

NS_PER_S = 1_000_000_000
N_FRAMES = 15


def vivid_device() -> Path | None:
    """The first capture device of the driver."""
    names = sorted(Path("/sys/class/video4linux").glob("video*/name"))
    found = (Path("/dev", each.parent.name) for each in names if each.read_text().startswith("vivid-000-vid-cap"))
    return next((each for each in found if each.exists()), None)


@pytest.mark.skipif(
    vivid_device() is None,
    reason="no /dev/video* of the kernel's virtual driver: `modprobe vivid`, which containers and most CI may not",
)
def test_pictures_of_the_kernels_virtual_camera_have_its_stamps_and_numbers() -> None:
    clock = RunClock()
    camera = V4l2Camera(CameraSettings(str(vivid_device()), 640, 480, 30.0), clock)
    refused = camera.open()
    try:
        # It has no JPEG.
        assert [each.partition(" is ")[0] for each in refused] == ["format"]
        frames = [frame for _ in range(N_FRAMES) for frame in camera.read(1.0)]
        camera.close()
        assert camera.open() == refused
        (next_one,) = camera.read(1.0)
    finally:
        camera.close()
    pictures = [np.asarray(each.picture) for each in frames]
    assert {(each.shape[:2], each.dtype) for each in pictures} == {((480, 640), np.dtype(np.uint8))}
    assert min(np.ptp(each) for each in pictures) > 100  # bars from black to white
    assert {each.source for each in frames} == {StampSource.STAMP_SOURCE_CAMERA}
    assert all(0 <= each.receive_ns - each.stamp_ns < NS_PER_S for each in frames)
    # The driver's stamps have its period, whatever this machine does; its numbers count what it dropped.
    numbers = [each.sequence for each in frames]
    assert numbers == sorted(set(numbers))
    period_s = (frames[-1].stamp_ns - frames[0].stamp_ns) / NS_PER_S / (numbers[-1] - numbers[0])
    assert 0.8 / 30 < period_s < 1.2 / 30
    assert next_one.sequence == numbers[-1] + 1
