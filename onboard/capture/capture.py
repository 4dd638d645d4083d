"""Capture of pictures of a calibration board with the robot's camera: the input and output around `CaptureGuide`."""

import re
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from groundsbot.calib.board import DEFAULT_BOARD
from groundsbot.calib.errors import GroundsbotError
from groundsbot.calib.foundation import MOST_PICTURE_BYTES, atomic_write, is_jpeg, plural, read_regular
from groundsbot.onboard.camera import Camera, CameraEndedError, CameraLostError, Frame
from groundsbot.onboard.capture.guide import Advice, CaptureGuide
from groundsbot.onboard.detection import save_board
from groundsbot.onboard.errors import OnboardError
from groundsbot.onboard.log import Picture, decode_grey, to_grey
from groundsbot.onboard.process import RunClock

_NS_PER_S: Final = 1_000_000_000
_READ_S: Final = 0.1
_SILENT_NS: Final = 5 * _NS_PER_S
_LOOK_NS: Final = _NS_PER_S  # between two previews
_PICTURE_NAME: Final = re.compile(r"(\d{4,9})\.(?:png|jpg)")

Show = Callable[[Advice, CaptureGuide], None]
Watch = Callable[[Picture, Advice, CaptureGuide], None]


class Capture:
    """Capture of pictures of one board with one camera into one folder, which may contain earlier ones.

    Attributes:
        guide: decides which pictures to keep.
    """

    def __init__(
        self,
        camera: Camera,
        clock: RunClock,
        guide: CaptureGuide,
        output: Path,
        looked_at: Path,
        show: Show,
        say: Callable[[str], None],
        watch: Watch | None = None,
    ) -> None:
        """Read the pictures that the folder contains already.

        Args:
            camera: the camera.
            clock: the camera's clock.
            guide: the guide for the board.
            output: folder for the pictures, 0001.jpg or .png and so on.
            looked_at: preview to save, a JPEG with the corners found.
            show: called with the advice after each picture.
            say: called with other messages.
            watch: called with each picture and the advice for it.

        Raises:
            OnboardError: the folder contains other files, or unusable pictures.
        """
        self.guide = guide
        self._camera = camera
        self._output = output
        self._looked_at: Path | None = looked_at
        self._show = show
        self._say = say
        self._watch = watch
        self._clock = clock
        self._size_px: tuple[int, int] | None = None
        self._next_number = 1
        self._next_look_ns = 0
        if output.exists():
            self._remember()

    def run(self, stop: threading.Event) -> None:
        """Take pictures until there are enough, `stop` is set, or a video ends.

        Raises:
            OnboardError: the camera is missing or silent, or a picture cannot be written. Pictures taken are kept.
        """
        try:
            for refused in self._camera.open():
                self._say(refused)
            try:
                self._take_pictures(stop)
            except CameraEndedError as error:
                self._say(str(error))
        finally:
            self._camera.close()

    def _take_pictures(self, stop: threading.Event) -> None:
        last_ns = self._clock.now_ns()
        while not stop.is_set() and not self.guide.enough:
            frames = self._camera.read(_READ_S)
            now_ns = self._clock.now_ns()
            if not frames and now_ns - last_ns > _SILENT_NS:
                raise CameraLostError(
                    f"the camera gave no picture for {_SILENT_NS // _NS_PER_S} s; check its device in robot.yaml"
                )
            last_ns = now_ns if frames else last_ns
            if frames:  # only the newest shows how the board is held now
                self.handle_frame(frames[-1])

    def handle_frame(self, frame: Frame) -> None:
        """Search the calibration board in one picture, save the picture if it adds a new view, and show advice.

        A picture that cannot be decoded is skipped, and the advice says so.

        Args:
            frame: the picture with its times of exposure and of arrival.

        Raises:
            OnboardError: the picture differs in size from the earlier ones, or cannot be written.
        """
        try:
            grey = decode_grey(frame.picture) if isinstance(frame.picture, bytes) else to_grey(frame.picture)
        except OnboardError as error:  # bytes were lost in transmission; the next picture may be intact
            self._show(Advice(False, str(error), None), self.guide)
            return
        self._check_size(grey, "the camera gives")
        advice = self.guide.handle_frame(grey, frame.stamp_ns)
        if advice.keep:
            self._write(frame.picture)
        if advice.keep or frame.receive_ns >= self._next_look_ns:
            self._next_look_ns = frame.receive_ns + _LOOK_NS
            self._save_to_look_at(frame.picture, advice)
        self._show(advice, self.guide)
        if self._watch is not None:
            self._watch(frame.picture, advice, self.guide)

    def _save_to_look_at(self, picture: Picture, advice: Advice) -> None:
        if self._looked_at is None:
            return
        try:
            save_board(picture, advice.seen, self.guide.spread, self._looked_at)
        except OSError as error:  # the default is beside robot.yaml, whose folder may be write-protected
            self._say(
                f"{self._looked_at}: cannot be written ({error.strerror}); --picture names another file to look at"
            )
            self._looked_at = None

    def _write(self, picture: Picture) -> None:
        """Write a picture without loss: encoded ones unchanged, others as PNG."""
        is_file = isinstance(picture, bytes)
        data = picture if isinstance(picture, bytes) else cv2.imencode(".png", picture)[1].tobytes()
        path = self._output / f"{self._next_number:04}.{'jpg' if is_file and is_jpeg(data) else 'png'}"
        with _errors_as_onboard_error(path):
            self._output.mkdir(parents=True, exist_ok=True)
            with atomic_write(path) as temporary:
                temporary.write_bytes(data)
        self._next_number += 1

    def _remember(self) -> None:
        if not self._output.is_dir():
            raise OnboardError(f"{self._output}: is not a folder; name one for the pictures")
        for path in sorted(self._output.glob("[!.]*")):  # an unfinished file after a power cut begins with a dot
            named = _PICTURE_NAME.fullmatch(path.name)
            if named is None:
                raise OnboardError(f"{path}: is not a picture of an earlier capture; name a new folder")
            try:
                grey = decode_grey(read_regular(path, MOST_PICTURE_BYTES))
            except (OSError, GroundsbotError) as error:
                raise OnboardError(f"{path}: cannot be used ({error}); remove it, or name a new folder") from error
            self._check_size(grey, f"{path.name} in it has")
            self.guide.remember(grey)
            self._next_number = int(named[1]) + 1

    def _check_size(self, grey: NDArray[np.uint8], whose: str) -> None:
        size_px = (grey.shape[1], grey.shape[0])
        if self._size_px is None:
            self._size_px = size_px
        if self._size_px != size_px:
            before, now = ("{}x{} px".format(*each) for each in (self._size_px, size_px))
            raise OnboardError(f"{self._output}: is for pictures of {before} but {whose} {now}; name a new folder")


@contextmanager
def _errors_as_onboard_error(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise OnboardError(
            f"{path}: cannot be written ({error.strerror}); make room, or name a place you may write to"
        ) from error


def summary(guide: CaptureGuide, output: Path) -> list[str]:
    """Return lines with the result and the next step."""
    if not guide.kept:
        return [f"{output}: no picture was taken"]
    lines = [f"{output}: {plural(guide.kept, 'picture')}"]
    if guide.missing:
        lines.append(f"still missing: {'; '.join(guide.missing)}")
    elif not guide.enough:
        lines.append(f"{guide.wanted} are wanted")
    else:
        option = "" if guide.board == DEFAULT_BOARD else f" --board {guide.board.specification}"
        lines.append(f"next: groundsbot-calib camera {output} -o camera.yaml{option}")
    return lines
