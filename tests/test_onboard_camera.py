"""Pictures come once, whole and with the right stamp; detection in its own process outlives what kills it."""

import os
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from onboard.camera import (
    Camera,
    CameraEndedError,
    CameraLostError,
    CameraSettings,
    VideoCamera,
    camera_for,
)
from onboard.clock import RunClock
from onboard.detection_process import ChildDetector, DetectionResult, DetectorSettings
from onboard.errors import OnboardError
from onboard.messages import StampSource
from onboard.picture import is_jpeg
from onboard.picture_folder import FolderCamera
from onboard.v4l2_camera import V4l2Camera
from tests.tag_pictures import draw_tag

MS = 1_000_000
CORNERS = np.array([[50.0, 30.0], [110.0, 32.0], [108.0, 92.0], [52.0, 90.0]])
TAG_PICTURE = draw_tag("tag36h11", 9, CORNERS, (120, 160))
PNG = cv2.imencode(".png", TAG_PICTURE)[1].tobytes()
JPEG = cv2.imencode(".jpg", TAG_PICTURE)[1].tobytes()


def folder_camera(folder: Path, since_ns: int = 0) -> tuple[FolderCamera, RunClock]:
    clock = RunClock()
    camera = FolderCamera(folder, clock, since_ns)
    assert camera.open() == []
    return camera, clock


def test_pictures_in_a_folder_come_once_in_order_of_their_names(tmp_path: Path) -> None:
    camera, clock = folder_camera(tmp_path)
    now_ns = time.time_ns()
    for name in (f"{now_ns}.jpg", f"{now_ns - 100 * MS}.png", "notes.txt", "12x.png", f"{now_ns}.png.part"):
        (tmp_path / name).write_bytes(JPEG if name.endswith("jpg") else PNG)
    frames = camera.read(1.0)
    assert [frame.picture for frame in frames] == [PNG, JPEG]
    assert [frame.sequence for frame in frames] == [0, 1]
    assert [frame.source for frame in frames] == [StampSource.STAMP_SOURCE_FILE_NAME] * 2
    assert abs(frames[1].stamp_ns - clock.from_realtime(now_ns)) < MS
    assert camera.read(0.0) == []
    (tmp_path / f"{now_ns + 1}.png").write_bytes(PNG)
    assert [frame.sequence for frame in camera.read(1.0)] == [2]


def test_a_picture_half_written_waits_for_its_rest(tmp_path: Path) -> None:
    camera, _ = folder_camera(tmp_path)
    path = tmp_path / f"{time.time_ns()}.jpg"
    path.write_bytes(JPEG[:-1])
    assert camera.read(0.1) == []
    path.write_bytes(JPEG)
    assert [frame.picture for frame in camera.read(1.0)] == [JPEG]


def test_a_picture_that_stays_half_is_handed_on_to_be_counted(tmp_path: Path) -> None:
    camera, _ = folder_camera(tmp_path)
    (tmp_path / f"{time.time_ns()}.png").write_bytes(PNG[:50])
    assert [frame.picture for frame in camera.read(5.0)] == [PNG[:50]]
    assert camera.read(0.0) == []


def test_old_pictures_are_left_alone_and_future_ones_get_their_arrival(tmp_path: Path) -> None:
    camera, clock = folder_camera(tmp_path, since_ns=RunClock().now_ns())
    (tmp_path / "0.png").write_bytes(PNG)
    (tmp_path / "9999999999999999999.png").write_bytes(PNG)
    (frame,) = camera.read(1.0)
    assert frame.source == StampSource.STAMP_SOURCE_ARRIVAL
    assert frame.stamp_ns == frame.receive_ns <= clock.now_ns()


def test_many_pictures_at_once_come_in_portions(tmp_path: Path) -> None:
    camera, _ = folder_camera(tmp_path)
    now_ns = time.time_ns()
    for index in range(20):
        (tmp_path / f"{now_ns + index}.png").write_bytes(PNG)
    sizes = [len(camera.read(1.0)) for _ in range(3)]
    assert sizes == [8, 8, 4]


def test_a_folder_that_is_not_there_yet(tmp_path: Path) -> None:
    clock = RunClock()
    camera = camera_for(CameraSettings(str(tmp_path / "later"), 160, 120, 15.0), clock, 0)
    with pytest.raises(CameraLostError, match="neither a folder of pictures"):
        camera.open()
    (tmp_path / "later").mkdir()
    assert camera.open() == []
    (tmp_path / "later").rmdir()
    with pytest.raises(CameraLostError, match="was lost"):
        camera.read(0.1)


def test_a_video_file_is_played_once(tmp_path: Path) -> None:
    path = tmp_path / "drive.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 50.0, (160, 120), isColor=False)
    for _ in range(5):
        writer.write(TAG_PICTURE)
    writer.release()
    camera = camera_for(CameraSettings(str(path), 160, 120, 15.0), RunClock(), 0)
    assert isinstance(camera, VideoCamera)
    camera.open()
    frames = [camera.read(1.0)[0] for _ in range(5)]
    assert np.diff([frame.stamp_ns for frame in frames]) == pytest.approx([20 * MS] * 4)
    assert all(frame.receive_ns >= frame.stamp_ns for frame in frames)
    with pytest.raises(CameraEndedError, match="over after 5 pictures"):
        camera.read(1.0)
    camera.close()


class FakeCapture:
    """Stands in for cv2.VideoCapture of a camera that keeps its own size and stamps by the monotonic clock."""

    def __init__(self, late_ms: float) -> None:
        self.late_ms = late_ms
        self.stamp_ms = 0.0

    def isOpened(self) -> bool:
        return True

    def set(self, _setting: int, _value: float) -> bool:
        return True

    def get(self, setting: int) -> float:
        if setting == cv2.CAP_PROP_POS_MSEC:
            return self.stamp_ms
        sizes = {cv2.CAP_PROP_FRAME_WIDTH: 640.0, cv2.CAP_PROP_FRAME_HEIGHT: 480.0}
        return sizes.get(setting, 15.0 if setting == cv2.CAP_PROP_FPS else float(cv2.VideoWriter.fourcc(*"MJPG")))

    def read(self) -> tuple[bool, "np.ndarray[tuple[int, int, int], np.dtype[np.uint8]]"]:
        self.stamp_ms = time.monotonic_ns() // MS - self.late_ms
        return True, np.zeros((480, 640, 3), np.uint8)

    def release(self) -> None:
        return


@pytest.mark.parametrize(
    ("late_ms", "source"),
    [
        (20.0, StampSource.STAMP_SOURCE_CAMERA),
        (-50.0, StampSource.STAMP_SOURCE_ARRIVAL),
        (1e7, StampSource.STAMP_SOURCE_ARRIVAL),
    ],
)
def test_a_drivers_stamp_is_believed_only_when_sane(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, late_ms: float, source: int
) -> None:
    clock, capture = RunClock(), FakeCapture(late_ms)
    device = tmp_path / "video0"
    device.touch()
    monkeypatch.setattr(cv2, "VideoCapture", lambda *_: capture)
    camera: Camera = V4l2Camera(CameraSettings(str(device), 1280, 720, 15.0, exposure_s=0.008), clock)
    refused = camera.open()
    assert "width_px is 640, asked for 1280" in refused
    assert "height_px is 480, asked for 720" in refused
    (frame,) = camera.read(1.0)
    assert frame.source == source
    if source == StampSource.STAMP_SOURCE_CAMERA:
        assert frame.stamp_ns == clock.from_monotonic(round(capture.stamp_ms * MS)) + 4 * MS  # half the exposure later
    camera.close()


def test_an_absent_camera_is_waited_for() -> None:
    camera = camera_for(CameraSettings("/dev/video-that-is-not", 1280, 720, 15.0), RunClock(), 0)
    with pytest.raises(CameraLostError, match="is absent"):
        camera.open()


def test_detection_in_its_own_process_survives_bad_pictures_and_its_own_death() -> None:
    child = ChildDetector(DetectorSettings(quad_decimate=1.0))
    try:
        assert "apriltags" in child.library
        good = child.detect(PNG, want_jpeg=True)
        check_found(good)
        assert good.jpeg is not None
        assert is_jpeg(good.jpeg)
        assert child.detect(JPEG, want_jpeg=True).jpeg == JPEG  # not encoded again
        check_found(child.detect(np.dstack([TAG_PICTURE] * 3)))
        for bad in (b"", PNG[:100], JPEG[:-2], np.zeros((0, 0), np.uint8), np.zeros((9, 9, 2), np.uint8)):
            assert child.detect(bad).error is not None
        tiny = child.detect(np.zeros((3, 3), np.uint8))
        assert (tiny.detections, tiny.size_px, tiny.error) == ([], (3, 3), None)
        os.kill(child._process.pid or 0, 9)
        lost = child.detect(PNG)
        assert lost.error is not None
        assert "crashed" in lost.error
        assert child.restarts == 1
        check_found(child.detect(PNG))
    finally:
        child.close()
    assert not child._process.is_alive()


def check_found(result: DetectionResult) -> None:
    assert result.error is None
    assert result.size_px == (160, 120)
    assert [(each.family, each.tag_id) for each in result.detections] == [("tag36h11", 9)]
    np.testing.assert_allclose(result.detections[0].corners_px, CORNERS, atol=0.5)


def test_a_detector_that_cannot_be_made_is_told_by_its_parent() -> None:
    with pytest.raises(OnboardError, match=r"recorder\.families"):
        ChildDetector(DetectorSettings(families=("tag36h10",)))
