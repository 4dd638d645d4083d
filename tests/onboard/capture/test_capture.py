"""Capturing pictures of the board: which are kept, what is said, and what is on the disk afterwards."""

import errno
import io
import re
import threading
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from rich.console import Console

from groundsbot.calib.board.board import DEFAULT_BOARD
from groundsbot.onboard.camera.camera import Camera, CameraEndedError, CameraLostError, Frame
from groundsbot.onboard.capture.capture import Capture
from groundsbot.onboard.capture.guide import Advice, CaptureGuide
from groundsbot.onboard.capture.view import CaptureView
from groundsbot.onboard.errors import OnboardError
from groundsbot.onboard.log.messages import StampSource
from groundsbot.onboard.log.picture import Picture
from groundsbot.onboard.process.clock import RunClock
from tests.onboard.capture.shown_pictures import EMPTY, MS, STEP_NS, jpeg, thrice
from tests.support.board_views import good_views, render_views


def show_all(guide: CaptureGuide, pictures: Sequence[NDArray[np.uint8]], start_ns: int = 0) -> list[Advice]:
    return [guide.handle_frame(each, start_ns + index * STEP_NS) for index, each in enumerate(pictures)]


def test_a_picture_is_taken_when_the_board_is_still_and_only_once() -> None:
    guide = CaptureGuide(DEFAULT_BOARD, 30)
    advice = show_all(guide, [render_views()[0]] * 5)
    assert [each.keep for each in advice] == [False, False, True, False, False]
    assert [each.text for each in advice[:2]] == ["hold the board still"] * 2
    assert advice[2].text.startswith("taken; show the board at the picture's")
    assert advice[4].text.startswith("show the board at the picture's")
    assert guide.kept == 1


def test_nothing_is_taken_while_the_board_moves_or_is_away() -> None:
    guide = CaptureGuide(DEFAULT_BOARD, 30)
    start = render_views()[4]
    moving = [np.roll(start, 3 * index, axis=1) for index in range(8)]  # 27 px/s
    assert not any(each.keep for each in show_all(guide, moving))
    creeping = [np.roll(start, index // 2, axis=1) for index in range(8)]
    assert sum(each.keep for each in show_all(guide, creeping, 60_000 * MS)) == 1
    gone = show_all(guide, [render_views()[0], EMPTY] * 3, 120_000 * MS)
    assert not any(each.keep for each in gone)
    assert gone[1].text == "no board 7x9-25mm-18mm-5x5_100 in view; show more of it"
    # Between pictures that far apart the board may have been anywhere.
    assert not any(guide.handle_frame(render_views()[0], (200 + 5 * index) * 1000 * MS).keep for index in range(4))


def test_it_is_enough_when_nothing_is_missing() -> None:
    guide = CaptureGuide(DEFAULT_BOARD, 8)
    for index, picture in enumerate(render_views()):
        assert not guide.enough
        taken = show_all(guide, [picture] * 3, index * 10_000 * MS)[-1]
        assert taken.keep, (index, taken)
        assert (taken.text == "taken; that is enough") == guide.enough
    assert guide.kept == len(good_views())
    assert guide.missing == []
    assert guide.enough
    few = CaptureGuide(DEFAULT_BOARD, 8)
    for picture in render_views()[:-2]:
        assert few.remember(picture)
    assert few.kept == 10
    assert few.missing == ["bring the board nearer"]
    assert not few.enough


class Scripted(Camera):
    """Gives its pictures one after the other, then ends."""

    def __init__(self, pictures: Sequence[Picture]) -> None:
        self._frames = [
            Frame(each, index * STEP_NS, index * STEP_NS, StampSource.STAMP_SOURCE_CAMERA, index)
            for index, each in enumerate(pictures)
        ]
        self.closed = False

    def open(self) -> list[str]:
        return ["camera_fps is 30, asked for 15"]

    def read(self, timeout_s: float) -> list[Frame]:
        if not self._frames:
            raise CameraEndedError("video is over")
        return [self._frames.pop(0)]

    def close(self) -> None:
        self.closed = True


class Taken:
    """A capture in this process."""

    def __init__(self, folder: Path, pictures: Sequence[Picture], wanted: int = 30) -> None:
        self.said: list[str] = []
        self.advice: list[Advice] = []
        self.folder = folder / "pictures"
        self.looked_at = folder / "capture.jpg"
        self.camera = Scripted(pictures)
        self.guide = CaptureGuide(DEFAULT_BOARD, wanted)
        capture = Capture(
            self.camera,
            RunClock(),
            self.guide,
            self.folder,
            self.looked_at,
            lambda advice, _: self.advice.append(advice),
            self.said.append,
        )
        try:
            capture.run(threading.Event())
        finally:
            assert self.camera.closed

    @property
    def names(self) -> list[str]:
        return sorted(each.name for each in self.folder.iterdir()) if self.folder.exists() else []


def test_pictures_are_kept_as_they_came_or_without_loss(tmp_path: Path) -> None:
    files = [jpeg(each) for each in thrice(0, 1)]
    taken = Taken(tmp_path, [*files, *thrice(2)])
    assert taken.said == ["camera_fps is 30, asked for 15", "video is over"]
    assert taken.names == ["0001.jpg", "0002.jpg", "0003.png"]
    assert (taken.folder / "0002.jpg").read_bytes() == files[3]
    np.testing.assert_array_equal(cv2.imread(str(taken.folder / "0003.png"), cv2.IMREAD_GRAYSCALE), render_views()[2])
    looked_at = cv2.imread(str(taken.looked_at))
    assert looked_at is not None
    green = (looked_at[:, :, 1] > 150) & (looked_at[:, :, 0] < 120) & (looked_at[:, :, 2] < 120)
    seen = taken.advice[-1].seen
    assert seen is not None
    x, y = np.rint(seen.pixels).astype(int).T
    assert green[y, x].all()
    assert sorted(each.name for each in tmp_path.iterdir()) == ["capture.jpg", "pictures"]


def test_it_ends_when_there_are_enough(tmp_path: Path) -> None:
    everything = [picture for picture in render_views() for _ in range(3)]
    taken = Taken(tmp_path, [*everything, EMPTY], wanted=12)
    assert taken.guide.enough
    assert len(taken.names) == 12
    assert taken.said == ["camera_fps is 30, asked for 15"]  # the last one was not asked for


def test_a_capture_continues_where_an_earlier_one_ended(tmp_path: Path) -> None:
    Taken(tmp_path, thrice(0, 1))
    again = Taken(tmp_path, thrice(1, 2))
    assert again.guide.kept == 3
    assert again.names == ["0001.png", "0002.png", "0003.png"]


def test_a_picture_that_came_broken_is_passed_over(tmp_path: Path) -> None:
    whole = jpeg(render_views()[0])
    taken = Taken(tmp_path, [whole, whole[: len(whole) // 2], whole, whole])
    assert "truncated" in taken.advice[1].text
    assert taken.names == ["0001.jpg"]


def test_no_picture_no_folder(tmp_path: Path) -> None:
    assert Taken(tmp_path, [EMPTY] * 3).names == []
    assert [each.name for each in tmp_path.iterdir()] == ["capture.jpg"]


def test_what_is_in_the_folder_must_fit(tmp_path: Path) -> None:
    Taken(tmp_path, thrice(0))
    small = [np.ascontiguousarray(each[:400]) for each in thrice(1)]
    with pytest.raises(OnboardError, match=r"is for pictures of 640x480 px but the camera gives 640x400 px; name"):
        Taken(tmp_path, small)
    stranger = tmp_path / "pictures" / "map.json"
    stranger.write_text("{}")
    with pytest.raises(OnboardError, match=r"map\.json: is not a picture of an earlier capture; name a new folder"):
        Taken(tmp_path, thrice(1))
    stranger.unlink()
    (tmp_path / "pictures" / "0002.jpg").write_bytes(b"\xff\xd8\xff")
    with pytest.raises(OnboardError, match=r"0002\.jpg: cannot be used \(.*truncated.*\); remove it"):
        Taken(tmp_path, thrice(1))
    assert sorted(each.name for each in (tmp_path / "pictures").iterdir()) == ["0001.png", "0002.jpg"]


def test_a_full_disk_ends_it_and_leaves_no_half_picture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write = Path.write_bytes

    def fails_from_the_second_on(path: Path, data: bytes) -> int:
        if "0002" in path.name:
            write(path, data[:100])
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(path, data)

    monkeypatch.setattr(Path, "write_bytes", fails_from_the_second_on)
    with pytest.raises(OnboardError, match=r"0002\.png: cannot be written \(No space left on device\); make room"):
        Taken(tmp_path, thrice(0, 1, 2))
    assert [each.name for each in (tmp_path / "pictures").iterdir()] == ["0001.png"]


def test_a_camera_that_falls_silent_is_not_waited_for_forever(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Silent(Scripted):
        def read(self, timeout_s: float) -> list[Frame]:
            return []

    monkeypatch.setattr("groundsbot.onboard.capture.capture._SILENT_NS", 50 * MS)
    camera = Silent([])
    guide, said = CaptureGuide(DEFAULT_BOARD, 3), list[object]()
    capture = Capture(
        camera, RunClock(), guide, tmp_path / "p", tmp_path / "c.jpg", lambda *each: said.append(each), said.append
    )
    with pytest.raises(CameraLostError, match=r"gave no picture for"):
        capture.run(threading.Event())
    assert camera.closed
    assert not list(tmp_path.iterdir())


def test_a_place_that_cannot_be_written_to_costs_only_the_picture_to_look_at(tmp_path: Path) -> None:
    (tmp_path / "capture.jpg").mkdir()
    taken = Taken(tmp_path, thrice(0, 1))
    assert taken.names == ["0001.png", "0002.png"]
    assert sum("capture.jpg: cannot be written (Is a directory); --picture names" in each for each in taken.said) == 1


def test_a_terminal_shows_what_is_missing_and_rings_for_each_picture() -> None:
    screen = io.StringIO()
    guide, view = CaptureGuide(DEFAULT_BOARD, 30), CaptureView(Console(file=screen, force_terminal=True, width=120))
    with view.live():
        for index, picture in enumerate([*thrice(0, 4), EMPTY]):
            view.show(guide.handle_frame(picture, index * STEP_NS), guide)
    last = screen.getvalue().rpartition("groundsbot capture")[2]
    assert screen.getvalue().count("\a") == 2
    assert "2 of 30 pictures" in last
    assert "no board 7x9-25mm-18mm-5x5_100 in view" in last
    regions = [re.findall("[■·]", line) for line in last.splitlines() if "·" in line]
    assert regions == [["■", "■", "·"], ["■", "■", "·"], ["·", "·", "·"]]
    assert "missing: show the board at the picture's top right" in last
