"""Tag detection in a child process; in the recorder's process it would delay wheel readings by tens of ms."""

import multiprocessing
import queue
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Final, NamedTuple

from groundsbot.calib.camera import CameraModel
from groundsbot.calib.foundation import is_jpeg
from groundsbot.onboard.detection.tag_detector import Detection, TagDetector
from groundsbot.onboard.errors import OnboardError
from groundsbot.onboard.log import Picture, decode, decode_grey, encode_jpeg, to_grey
from groundsbot.onboard.process import keep_memory, kill_child, settle_child, signals_held_back

_START_LIMIT_S: Final = 30.0
_JOB_LIMIT_S: Final = 5.0
_END_LIMIT_S: Final = 0.5
_NICE: Final = 0
_KEPT_BYTES: Final = 64 << 20  # free memory that the child keeps; enough for pictures of 1920x1080 px


@dataclass(frozen=True)
class DetectorSettings:
    """Arguments of a `TagDetector`, and the quality of JPEGs."""

    families: Sequence[str] = ("tag36h11",)
    library: str = "pupil-apriltags"
    quad_decimate: float = 2.0
    jpeg_quality: int = 90
    camera: CameraModel | None = None
    threads: int = 1

    def make(self) -> TagDetector:
        """Return the detector, in this process."""
        return TagDetector(self.families, self.library, self.quad_decimate, self.threads, camera=self.camera)


class DetectionResult(NamedTuple):
    """Result for one picture."""

    detections: list[Detection]
    size_px: tuple[int, int]  # width, height
    jpeg: bytes | None  # if requested
    error: str | None  # why the picture could not be used; the other fields are then empty


class _Job(NamedTuple):
    """A picture in work at the child."""

    begun_s: float  # monotonic
    process: BaseProcess


class ChildDetector:
    """Detector in a child process, which processes pictures one by one in order.

    A child that crashes or does not respond is replaced, and its picture is reported with an error.

    Attributes:
        library: name and version of the library in use.
        settings: settings of the detector, as text for the log.
        restarts: number of children replaced.
    """

    def __init__(
        self,
        settings: DetectorSettings,
        on_restart: Callable[[str], None] | None = None,
        job_limit_s: float = _JOB_LIMIT_S,
    ) -> None:
        """Start the child and wait until it is ready. The child ends with the thread that calls this.

        Args:
            settings: settings of the detector.
            on_restart: called from another thread, with the reason, after a child was replaced.
            job_limit_s: a child that takes longer than this for one picture is replaced.

        Raises:
            OnboardError: the child cannot be started, or no detector is installed.
        """
        self.restarts = 0
        self._settings = settings
        self._on_restart = on_restart
        self._job_limit_s = job_limit_s
        self._closing = threading.Event()
        self._lock = threading.Lock()  # held while a child is started or ended
        self._n_jobs = 0
        self._busy: _Job | None = None
        self._overdue: _Job | None = None
        self._jobs: queue.SimpleQueue[tuple[Picture, bool, Callable[[DetectionResult], None]] | None]
        self._jobs = queue.SimpleQueue()
        self._start_child()
        self._thread = threading.Thread(target=self._serve, name="detection", daemon=True)
        self._thread.start()
        self._watchdog = threading.Thread(target=self._watch, name="detection watchdog", daemon=True)
        self._watchdog.start()

    def submit(self, picture: Picture, want_jpeg: bool, on_result: Callable[[DetectionResult], None]) -> None:
        """Queue a picture; `on_result` is called from another thread. The caller limits the length of the queue."""
        self._jobs.put((picture, want_jpeg, on_result))

    def detect(self, picture: Picture, want_jpeg: bool = False) -> DetectionResult:
        """Return the result for one picture, waiting for it."""
        results: queue.SimpleQueue[DetectionResult] = queue.SimpleQueue()
        self.submit(picture, want_jpeg, results.put)
        return results.get()

    def close(self) -> None:
        """End the child. Pictures still queued after half a second get no result."""
        self._jobs.put(None)
        self._thread.join(_END_LIMIT_S)
        with self._lock:
            self._closing.set()  # prevents the start of another child
            kill_child(self._process)
        self._thread.join()
        self._watchdog.join()
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
        self._busy = job = _Job(time.monotonic(), self._process)
        try:
            return self._answer(picture, want_jpeg)
        except (OSError, EOFError):
            reason = (
                f"detection gave no answer for {self._job_limit_s:g} s" if self._overdue is job else "detection crashed"
            )
        except Exception as error:  # an unexpected error must cost this picture only
            reason = f"detection failed: {error!r}"
        finally:
            self._busy = None
        return DetectionResult([], (0, 0), None, self._replace_child(reason))

    def _watch(self) -> None:
        """Kill a child that takes too long, also while it receives a picture: `send` to a stopped child blocks."""
        wait_s = self._job_limit_s
        while not self._closing.wait(wait_s):
            job, wait_s = self._busy, self._job_limit_s
            if job is None or job is self._overdue:
                continue
            wait_s -= time.monotonic() - job.begun_s
            if wait_s <= 0.0:
                self._overdue, wait_s = job, self._job_limit_s
                kill_child(job.process)

    def _answer(self, picture: Picture, want_jpeg: bool) -> DetectionResult:
        self._n_jobs += 1
        self._connection.send((self._n_jobs, picture, want_jpeg))
        number, result = self._connection.recv()
        if number != self._n_jobs or not isinstance(result, DetectionResult):
            raise OnboardError(f"an answer to picture {number} came for picture {self._n_jobs}")
        return result

    def _replace_child(self, reason: str) -> str:
        """Replace the child, and return the reason with the outcome."""
        if self._closing.is_set():
            return f"{reason}; the recording is at its end"
        self.restarts += 1
        try:
            self._stop_child()
            self._start_child()
        except Exception as error:  # the next picture tries again
            reason = f"{reason}; {error}"
        else:
            reason = f"{reason}; its process was started again"
        if self._on_restart is not None:
            self._on_restart(reason)
        return reason

    def _start_child(self) -> None:
        context = multiprocessing.get_context("spawn")
        ours, theirs = context.Pipe()
        process = context.Process(
            target=_child, args=(theirs, self._settings), name="groundsbot-detection", daemon=True
        )
        with self._lock:
            if self._closing.is_set():
                raise OnboardError("the recording is at its end")
            with signals_held_back():
                process.start()
            self._connection, self._process = ours, process
        theirs.close()
        try:
            self.library, self.settings = self._greeting()
        except BaseException:
            self._stop_child()  # a late greeting must not be taken as a result
            raise

    def _greeting(self) -> tuple[str, str]:
        """Wait until the child is ready, and return the name of its library and its settings."""
        try:
            if not self._connection.poll(_START_LIMIT_S):
                raise OnboardError(f"detection process did not start within {_START_LIMIT_S:g} s; try again")
            greeting: tuple[str, str] | str = self._connection.recv()
        except (OSError, EOFError) as error:
            raise OnboardError("detection process died at its start; try the other recorder.detector") from error
        if isinstance(greeting, str):
            raise OnboardError(greeting)
        return greeting

    def _stop_child(self) -> None:
        """End the child and close its pipes at once, not by garbage collection; a second call does nothing."""
        self._connection.close()
        kill_child(self._process)
        with suppress(ValueError):
            self._process.join()
            self._process.close()


def _child(connection: Connection, settings: DetectorSettings) -> None:
    """Run in the child: return results until the parent is gone."""
    settle_child(_NICE)
    import cv2

    cv2.setNumThreads(1)
    try:
        detector = settings.make()
    except OnboardError as error:
        connection.send(str(error))
        return
    keep_memory(_KEPT_BYTES)
    connection.send((detector.library, detector.settings))
    while True:
        try:
            number, picture, want_jpeg = connection.recv()
            connection.send((number, _detect(detector, picture, want_jpeg, settings.jpeg_quality)))
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
