"""Pictures come once, whole and with the right stamp; detection in its own process outlives what kills it."""

import os
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from groundsbot.calib.foundation.picture_bytes import is_jpeg
from groundsbot.onboard.camera.camera import Camera, CameraEndedError, CameraLostError, CameraSettings, VideoCamera
from groundsbot.onboard.camera.factory import camera_for
from groundsbot.onboard.camera.folder import FolderCamera
from groundsbot.onboard.camera.v4l2 import V4l2Camera
from groundsbot.onboard.detection.child_process import ChildDetector, DetectionResult, DetectorSettings
from groundsbot.onboard.errors import OnboardError
from groundsbot.onboard.log.messages import StampSource
from groundsbot.onboard.process.clock import RunClock
from tests.support.devices.fake_capture import FakeCapture
from tests.support.devices.live_recording import has_ended
from tests.support.tag_pictures import draw_tag

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


def test_an_entry_that_cannot_be_read_holds_up_none_after_it(tmp_path: Path) -> None:
    camera, _ = folder_camera(tmp_path)
    now_ns = time.time_ns()
    (tmp_path / f"{now_ns - 1}.jpg").mkdir()
    (tmp_path / f"{now_ns}.jpg").write_bytes(JPEG)
    assert [frame.picture for frame in camera.read(5.0)] == [JPEG]
    assert [frame.picture for frame in camera.read(5.0)] == [b""]  # for the decoder to refuse, and so counted
    (tmp_path / f"{now_ns + 1}.jpg").write_bytes(JPEG)
    assert [frame.picture for frame in camera.read(5.0)] == [JPEG]


def test_only_regular_files_of_a_limited_size_are_read(tmp_path: Path) -> None:
    """Links may lead to devices without an end, a FIFO blocks who opens it, a sparse file fills the memory."""
    (folder := tmp_path / "pictures").mkdir()
    camera, _ = folder_camera(folder)
    now_ns = time.time_ns()
    (tmp_path / "good.jpg").write_bytes(JPEG)
    (folder / f"{now_ns}.jpg").symlink_to("/dev/zero")
    (folder / f"{now_ns + 1}.jpg").symlink_to(tmp_path / "good.jpg")
    os.mkfifo(folder / f"{now_ns + 2}.jpg")
    with (folder / f"{now_ns + 3}.jpg").open("wb") as file:
        file.truncate(3 << 30)
    frames = camera.read(5.0)
    while len(frames) < 4 and (more := camera.read(5.0)):  # each waited for its rest since its own first look
        frames += more
    assert [frame.picture for frame in frames] == [b""] * 4
    assert [f"{now_ns + index}.jpg" in frame.refusal for index, frame in enumerate(frames)] == [True] * 4
    reasons = ["is a link", "is a link", "is a FIFO", "limit"]
    assert [reason in frame.refusal for reason, frame in zip(reasons, frames, strict=True)] == [True] * 4
    assert camera.read(0.0) == []


def test_large_pictures_come_in_portions_that_memory_holds(tmp_path: Path) -> None:
    camera, _ = folder_camera(tmp_path)
    now_ns = time.time_ns()
    for index in range(3):
        with (tmp_path / f"{now_ns + index}.jpg").open("wb") as file:
            file.write(JPEG)
            file.truncate(15_000_000)
            file.seek(0, os.SEEK_END)
            file.write(JPEG[-2:])
    assert [len(camera.read(1.0)) for _ in range(2)] == [2, 1]


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


@pytest.mark.parametrize("padding", [0, 5000])
def test_a_cameras_jpeg_is_taken_as_it_comes_and_refused_settings_are_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, padding: int
) -> None:
    clock, capture = RunClock(), FakeCapture([JPEG], padding=padding)
    device = tmp_path / "video0"
    device.touch()
    monkeypatch.setattr(cv2, "VideoCapture", lambda *_: capture)
    camera: Camera = V4l2Camera(CameraSettings(str(device), 1280, 720, 15.0, exposure_s=0.008, gain=3.0), clock)
    assert camera.open() == ["width_px is 160, requested 1280", "height_px is 120, requested 720"]
    assert capture.settings[cv2.CAP_PROP_CONVERT_RGB] == 0.0
    assert capture.settings[cv2.CAP_PROP_EXPOSURE] == 80.0  # of 0.1 ms
    assert next(iter(capture.settings)) == cv2.CAP_PROP_FOURCC
    (frame,) = camera.read(1.0)
    assert frame.picture == JPEG
    assert frame.source == StampSource.STAMP_SOURCE_CAMERA
    driver_ns = clock.from_monotonic(round(capture.get(cv2.CAP_PROP_POS_MSEC) * MS))
    assert frame.stamp_ns == driver_ns + 4 * MS  # half the exposure later
    camera.close()
    assert capture.released == 1


@pytest.mark.parametrize(("name", "grey_at"), [("YUYV", 0), ("UYVY", 1)])
def test_of_yuv_only_the_grey_is_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, grey_at: int
) -> None:
    raw = np.full((120, 160, 2), 128, np.uint8)
    raw[:, :, grey_at] = TAG_PICTURE
    capture = FakeCapture([raw], fourcc=float(cv2.VideoWriter.fourcc(*name)))
    (tmp_path / "video0").touch()
    monkeypatch.setattr(cv2, "VideoCapture", lambda *_: capture)
    camera = V4l2Camera(CameraSettings(str(tmp_path / "video0"), 160, 120, 15.0), RunClock())
    assert camera.open() == [f"format is {name}, requested MJPG: pictures kept are encoded by the recorder"]
    (frame,) = camera.read(1.0)
    np.testing.assert_array_equal(np.asarray(frame.picture), TAG_PICTURE)


def test_an_absent_camera_is_waited_for() -> None:
    camera = camera_for(CameraSettings("/dev/video-that-is-not", 1280, 720, 15.0), RunClock(), 0)
    with pytest.raises(CameraLostError, match="is missing"):
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
    assert has_ended(child)


def check_found(result: DetectionResult) -> None:
    assert result.error is None
    assert result.size_px == (160, 120)
    assert [(each.family, each.tag_id) for each in result.detections] == [("tag36h11", 9)]
    np.testing.assert_allclose(result.detections[0].corners_px, CORNERS, atol=0.5)


def test_a_detector_that_cannot_be_made_is_reported_by_its_parent() -> None:
    with pytest.raises(OnboardError, match=r"recorder\.families"):
        ChildDetector(DetectorSettings(families=("tag36h10",)))
