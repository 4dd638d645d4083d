"""Tag detection in a process of its own: in the recorder's it would hold up the wheel readings by tens of ms."""

import ctypes
import multiprocessing
import os
import queue
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib.camera_model import CameraModel
from calib.picture_bytes import is_jpeg
from onboard.errors import OnboardError
from onboard.picture import decode, decode_grey, encode_jpeg, to_grey
from onboard.tag_detector import Detection, TagDetector

Picture = bytes | NDArray[np.uint8]  # a PNG or JPEG file's bytes; or grey [h, w] or BGR [h, w, 3]

_START_LIMIT_S: Final = 30.0
_JOB_LIMIT_S: Final = 5.0
_END_LIMIT_S: Final = 0.5
_PR_SET_PDEATHSIG: Final = 1


@dataclass(frozen=True)
class DetectorSettings:
    """What a TagDetector is made from."""

    families: Sequence[str] = ("tag36h11",)
    library: str = "pupil-apriltags"
    quad_decimate: float = 2.0
    jpeg_quality: int = 90
    camera: CameraModel | None = None

    def make(self) -> TagDetector:
        """The detector, in this process."""
        return TagDetector(self.families, self.library, self.quad_decimate, camera=self.camera)


class DetectionResult(NamedTuple):
    """What became of one picture."""

    detections: list[Detection]
    size_px: tuple[int, int]  # width, height
    jpeg: bytes | None  # where it was asked for
    error: str | None  # why the picture was of no use; then the rest is empty


class ChildDetector:
    """Detects in a child process, one picture at a time, in the order they come.

    A child that crashes or hangs is replaced; the picture it had is reported as of no use.

    Attributes:
        library: name and version of the library in use.
        settings: how it was set, as text for the log.
        restarts: children replaced.
    """

    def __init__(
        self,
        settings: DetectorSettings,
        on_restart: Callable[[str], None] | None = None,
        job_limit_s: float = _JOB_LIMIT_S,
    ) -> None:
        """Starts the child and waits until it is ready. The child ends with the thread that calls this.

        Args:
            settings: what to detect with.
            on_restart: told, from another thread, why the child had to be replaced.
            job_limit_s: a child that takes longer than this for one picture hangs.

        Raises:
            OnboardError: it cannot start, or no detector is installed.
        """
        self.restarts = 0
        self._settings = settings
        self._on_restart = on_restart
        self._job_limit_s = job_limit_s
        self._closing = threading.Event()
        self._jobs: queue.SimpleQueue[tuple[Picture, bool, Callable[[DetectionResult], None]] | None]
        self._jobs = queue.SimpleQueue()
        self._start_child()
        self._thread = threading.Thread(target=self._serve, name="detection", daemon=True)
        self._thread.start()

    def submit(self, picture: Picture, want_jpeg: bool, on_result: Callable[[DetectionResult], None]) -> None:
        """Queues a picture; `on_result` is called from another thread. The caller bounds the queue."""
        self._jobs.put((picture, want_jpeg, on_result))

    def detect(self, picture: Picture, want_jpeg: bool = False) -> DetectionResult:
        """Waits for one picture's result."""
        results: queue.SimpleQueue[DetectionResult] = queue.SimpleQueue()
        self.submit(picture, want_jpeg, results.put)
        return results.get()

    def close(self) -> None:
        """Ends the child; pictures still queued after half a second come to nothing."""
        self._jobs.put(None)
        self._thread.join(_END_LIMIT_S)
        self._closing.set()  # from here on nobody starts another
        self._process.kill()
        self._thread.join()
        self._stop_child()

    def _serve(self) -> None:
        while (job := self._jobs.get()) is not None and not self._closing.is_set():
            picture, want_jpeg, on_result = job
            passed_through = picture if want_jpeg and isinstance(picture, bytes) and is_jpeg(picture) else None
            result = self._run(picture, want_jpeg and passed_through is None)
            if passed_through is not None and result.error is None:
                result = result._replace(jpeg=passed_through)
            on_result(result)

    def _run(self, picture: Picture, want_jpeg: bool) -> DetectionResult:
        try:
            self._connection.send((picture, want_jpeg))
            if self._connection.poll(self._job_limit_s):
                result: DetectionResult = self._connection.recv()
                return result
            reason = f"detection gave no answer for {self._job_limit_s:g} s"
        except (OSError, EOFError):
            reason = "detection crashed"
        return DetectionResult([], (0, 0), None, self._replace_child(reason))

    def _replace_child(self, reason: str) -> str:
        """Returns the reason with what became of it."""
        if self._closing.is_set():
            return f"{reason}; the recording is at its end"
        self.restarts += 1
        try:
            self._stop_child()
            self._start_child()
        except OnboardError as error:
            reason = f"{reason}; {error}"
        else:
            reason = f"{reason}; its process was started again"
        if self._on_restart is not None:
            self._on_restart(reason)
        return reason

    def _start_child(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._connection, theirs = context.Pipe()
        self._process = context.Process(
            target=_child, args=(theirs, self._settings), name="groundsbot-detection", daemon=True
        )
        with _signals_held_back():
            self._process.start()
        theirs.close()
        if self._closing.is_set():  # close() may have ended the one before this
            self._process.kill()
        try:
            if not self._connection.poll(_START_LIMIT_S):
                raise OnboardError(f"detection process did not start within {_START_LIMIT_S:g} s; try again")
            answer = self._connection.recv()
        except (OSError, EOFError) as error:
            raise OnboardError("detection process died at its start; try the other recorder.detector") from error
        if isinstance(answer, str):
            raise OnboardError(answer)
        self.library, self.settings = answer

    def _stop_child(self) -> None:
        self._connection.close()
        self._process.kill()
        self._process.join()


@contextmanager
def _signals_held_back() -> Iterator[None]:
    """A child started herein holds back Ctrl-C until it can say that it wants none; this thread only meanwhile."""
    held = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, held)


def _child(connection: Connection, settings: DetectorSettings) -> None:
    """Runs in the child: answers until the parent is gone."""
    for each in (signal.SIGINT, signal.SIGTERM):  # the parent decides when recording ends
        signal.signal(each, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT, signal.SIGTERM})
    with suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, 0)  # the recorder goes first, also where it is allowed to be in a hurry
    # A detection that hangs would not notice that its parent was killed.
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, int(signal.SIGKILL), 0, 0, 0)
    import cv2

    cv2.setNumThreads(1)
    try:
        detector = settings.make()
    except OnboardError as error:
        connection.send(str(error))
        return
    connection.send((detector.library, detector.settings))
    while True:
        try:
            picture, want_jpeg = connection.recv()
            connection.send(_detect(detector, picture, want_jpeg, settings.jpeg_quality))
        except (EOFError, OSError):
            return


def _detect(detector: TagDetector, picture: Picture, want_jpeg: bool, quality: int) -> DetectionResult:
    try:
        if isinstance(picture, bytes):
            picture = decode(picture) if want_jpeg else decode_grey(picture)
        grey = to_grey(picture)
        jpeg = encode_jpeg(picture, quality) if want_jpeg else None
        return DetectionResult(detector.detect(grey), (grey.shape[1], grey.shape[0]), jpeg, None)
    except OnboardError as error:
        return DetectionResult([], (0, 0), None, str(error))
