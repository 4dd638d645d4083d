"""A detection's process that starts late, answers wrongly, takes nothing, or is started as the recording ends."""

import gc
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from pathlib import Path

import cv2
import numpy as np
import pytest

from groundsbot.onboard.detection import child_process
from groundsbot.onboard.detection.child_process import ChildDetector, DetectionResult, DetectorSettings
from groundsbot.onboard.detection.tag_detector import TagDetector
from tests.support.devices.live_recording import has_ended, tag_jpeg, until

LIMIT_S = 60.0  # only what hangs comes near
BLANK = cv2.imencode(".jpg", np.full((120, 160), 200, np.uint8))[1].tobytes()


@contextmanager
def child_detector(settings: DetectorSettings, job_limit_s: float = LIMIT_S) -> Iterator[ChildDetector]:
    child = ChildDetector(settings, job_limit_s=job_limit_s)
    try:
        yield child
    finally:
        child.close()


def in_time(act: Callable[[], object]) -> object:
    """The result, or the error; in a thread, so that a call that hangs fails too."""
    results: list[object] = []

    def run() -> None:
        try:
            results.append(act())
        except Exception as error:
            results.append(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    thread.join(LIMIT_S)
    assert results, "hangs"
    return results[0]


@dataclass(frozen=True)
class LateSettings(DetectorSettings):
    """Takes until the file is gone to be ready."""

    file: Path = Path()

    def make(self) -> TagDetector:
        while self.file.exists():
            time.sleep(0.01)
        return super().make()


def test_a_child_that_starts_too_late_is_ended_and_its_greeting_taken_for_no_answer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with child_detector(LateSettings(file=tmp_path / "wait")) as child:
        assert len(child.detect(tag_jpeg()).detections) == 1
        (tmp_path / "wait").touch()
        monkeypatch.setattr(child_process, "_START_LIMIT_S", 0.05)
        os.kill(child._process.pid or 0, signal.SIGKILL)
        told = child.detect(tag_jpeg()).error
        assert told is not None
        assert "did not start within" in told
        assert has_ended(child)
        monkeypatch.setattr(child_process, "_START_LIMIT_S", LIMIT_S)
        (tmp_path / "wait").unlink()
        assert child.detect(tag_jpeg()).error is not None  # this one finds no child, and starts one
        found = [len(child.detect(picture).detections) for picture in (tag_jpeg(), BLANK, tag_jpeg(), BLANK)]
    assert found == [1, 0, 1, 0]


def answers_another(connection: Connection, _settings: DetectorSettings) -> None:
    """A child whose answers belong to the picture before."""
    connection.send(("library", "settings"))
    while True:
        number, *_ = connection.recv()
        connection.send((number - 1, DetectionResult([], (160, 120), None, None)))


def answers_rubbish(connection: Connection, _settings: DetectorSettings) -> None:
    """A child whose answers cannot be read."""
    connection.send(("library", "settings"))
    while True:
        connection.recv()
        connection.send_bytes(b"rubbish")


@pytest.mark.parametrize("child_like_that", [answers_another, answers_rubbish])
def test_an_answer_that_is_none_costs_its_picture_and_not_those_after_it(
    monkeypatch: pytest.MonkeyPatch, child_like_that: Callable[[Connection, DetectorSettings], None]
) -> None:
    with monkeypatch.context() as patched:
        patched.setattr(child_process, "_child", child_like_that)
        child = ChildDetector(DetectorSettings())
    try:
        result = in_time(lambda: child.detect(tag_jpeg()))
        assert isinstance(result, DetectionResult)
        assert result.error is not None
        assert "detection failed" in result.error
        assert child.restarts == 1
        assert len(child.detect(tag_jpeg()).detections) == 1
    finally:
        child.close()


def test_a_child_that_was_stopped_takes_no_picture_and_is_replaced() -> None:
    large = np.zeros((1080, 1920), np.uint8)  # more than a pipe holds
    with child_detector(DetectorSettings(), job_limit_s=2.0) as child:
        os.kill(child._process.pid or 0, signal.SIGSTOP)
        result = in_time(lambda: child.detect(large))
        assert isinstance(result, DetectionResult)
        assert result.error is not None
        assert "no answer for 2 s" in result.error
        assert child.restarts == 1


def test_closing_while_a_child_is_being_started(monkeypatch: pytest.MonkeyPatch) -> None:
    starting, may_start, start = threading.Event(), threading.Event(), SpawnProcess.start

    def held_up(process: SpawnProcess) -> None:
        starting.set()
        may_start.wait()
        start(process)

    monkeypatch.setattr(child_process, "_END_LIMIT_S", 0.0)
    child = ChildDetector(DetectorSettings())
    monkeypatch.setattr(SpawnProcess, "start", held_up)
    os.kill(child._process.pid or 0, signal.SIGKILL)
    child.submit(tag_jpeg(), False, lambda _: None)
    assert starting.wait(LIMIT_S)
    closed: list[object] = []
    closing = threading.Thread(target=lambda: closed.append(in_time(child.close)), daemon=True)
    closing.start()
    closing.join(0.3)  # it waits for the child, or has failed
    may_start.set()
    closing.join(LIMIT_S)
    assert closed == [None]
    until(lambda: has_ended(child), "the end of the child")


def test_what_a_child_had_open_is_closed_when_it_is_ended() -> None:
    with child_detector(DetectorSettings()) as first:  # whatever multiprocessing keeps for good is there now
        first.detect(BLANK)
    gc.collect()
    gc.disable()
    try:
        before = sorted(Path("/proc/self/fd").iterdir())
        child = ChildDetector(DetectorSettings())
        os.kill(child._process.pid or 0, signal.SIGKILL)
        assert child.detect(BLANK).error is not None  # another one was started
        child.close()
        child.close()
        assert sorted(Path("/proc/self/fd").iterdir()) == before
    finally:
        gc.enable()


def test_a_picture_takes_the_memory_that_the_one_before_gave_back() -> None:
    noise = np.random.default_rng(0).integers(0, 256, (720, 1280)).astype(np.uint8)
    jpeg = cv2.imencode(".jpg", cv2.GaussianBlur(noise, (0, 0), 3.0))[1].tobytes()
    with child_detector(DetectorSettings()) as child:
        (pid,) = {each.pid for each in multiprocessing.active_children()}

        def page_faults() -> int:
            return int(Path(f"/proc/{pid}/stat").read_text().rpartition(") ")[2].split()[7])

        for _ in range(3):
            child.detect(jpeg)
        before = page_faults()
        for _ in range(10):
            child.detect(jpeg)
        assert page_faults() - before < 10 * 100  # about a thousand a picture else
