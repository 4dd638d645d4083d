"""Worker processes: the same results whatever their number, errors that name the drive, no process left."""

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from groundsbot.offline.errors import OfflineError
from groundsbot.offline.foundation import workers as workers_module
from groundsbot.offline.foundation.process_start import METHOD
from groundsbot.offline.foundation.stages import Stages
from groundsbot.offline.foundation.workers import Workers, default_workers, equal_shares, worker_processes

NAMES = ["a", "b", "c"]
LIMIT_S = 120.0


def square(item: int, stages: Stages) -> tuple[int, int]:
    with stages.stage("inner"):
        return item**2, os.getpid()


def refuse_odd(item: int, _stages: Stages) -> int:
    if item % 2:
        raise OfflineError(f"{item} is odd")
    return item


def die_at_2(item: int, _stages: Stages) -> int:
    if item == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return item


def die() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def sleep_long(_item: Path, _stages: Stages) -> None:
    _item.write_text(str(os.getpid()))
    time.sleep(10 * LIMIT_S)


def append(items: list[int], item: int) -> list[int]:
    items.append(item)
    return items


@pytest.mark.parametrize("n", [1, 2])
def test_results_come_in_order_with_the_time_of_each_stage(n: int) -> None:
    news: list[tuple[str, int, int]] = []
    stages = Stages(lambda *each: news.append(each))
    with worker_processes(n) as workers:
        found = workers.map(square, [3, 1, 2], NAMES, stages, "outer")
    assert [value for value, _ in found] == [9, 1, 4]
    assert len({process for _, process in found} - {os.getpid()}) == (0 if n == 1 else 2)
    assert [each for each in news if each[0] == "outer"] == [("outer", done, 3) for done in range(4)]
    assert {cost.name for cost in stages.costs} == {"outer", "inner"}


@pytest.mark.parametrize("n", [1, 2])
def test_what_the_first_of_those_that_fail_raised_is_raised(n: int) -> None:
    with pytest.raises(OfflineError, match="1 is odd"), worker_processes(n) as workers:
        workers.map(refuse_odd, [0, 1, 3], NAMES, Stages(), "outer")


def process_of(_item: None) -> int:
    return os.getpid()


def has_loaded(module: str, _stages: Stages) -> bool:
    return module in sys.modules


@pytest.mark.parametrize("method", sorted({METHOD, "spawn"}))
def test_processes_load_a_module_before_their_first_item(method: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers_module, "METHOD", method)
    with worker_processes(2) as workers:
        workers.load_ahead("xmlrpc.client", 2)
        assert workers.map(has_loaded, ["xmlrpc.client"] * 2, NAMES[:2], Stages(), "outer") == [True, True]


@pytest.mark.parametrize("n", [1, 2])
def test_what_is_begun_beside_this_process_is_done_in_another_if_there_is_one(n: int) -> None:
    with worker_processes(n) as workers:
        workers.map(square, [1, 2], NAMES[:2], Stages(), "outer")
        process = workers.begin_beside(process_of, None, "it")
        assert (process() == os.getpid()) == (n == 1)


def test_processes_take_what_is_begun_beside_this_one_in_turn() -> None:
    with worker_processes(2) as workers:
        workers.map(square, [1, 2], NAMES[:2], Stages(), "outer")
        waits = [workers.begin_beside(process_of, None, name) for name in NAMES]
        first, second, third = [wait() for wait in waits]
    assert first == third != second


def test_a_killed_process_is_reported_with_its_drive_and_a_way_out() -> None:
    expected = pytest.raises(OfflineError, match=r"^b: its process was killed.*--workers")
    with expected, worker_processes(2) as workers:
        workers.map(die_at_2, [0, 2, 4], NAMES, Stages(), "outer")


def test_a_process_killed_at_its_start_is_reported_with_a_way_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers_module, "begin_worker", die)
    expected = pytest.raises(OfflineError, match=r"^a worker process was killed.*--workers")
    with expected, worker_processes(2) as workers:
        workers.map(square, [0, 1], NAMES[:2], Stages(), "outer")


DYING_SERVER = """
import sys
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.foundation import worker_processes
if __name__ == "__main__":
    try:
        with worker_processes(2) as workers:
            workers.load_ahead("dying", 2)
            workers.hold([1, 2], ["a", "b"])
    except OfflineError as error:
        print(error)
"""


def test_processes_whose_server_was_killed_are_reported_with_a_way_out(tmp_path: Path) -> None:
    (tmp_path / "dying.py").write_text("import os, signal\nos.kill(os.getpid(), signal.SIGKILL)\n")
    (tmp_path / "program.py").write_text(DYING_SERVER)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path])}
    program = [sys.executable, str(tmp_path / "program.py")]
    done = subprocess.run(program, env=environment, capture_output=True, check=True, timeout=LIMIT_S)
    assert re.match("a worker process was killed.*--workers", done.stdout.decode())


SLEEPING = """
import os, sys, time
from groundsbot.offline.foundation import Stages, worker_processes
def sleep_long(_item, _stages):
    os.write(1, b"%d\\n" % os.getpid())
    time.sleep(1000.0)
if __name__ == "__main__":
    with worker_processes(2) as workers:
        workers.map(sleep_long, [1, 2], ["a", "b"], Stages(), "outer")
"""


def test_processes_end_when_their_parent_is_killed(tmp_path: Path) -> None:
    (tmp_path / "program.py").write_text(SLEEPING)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    with subprocess.Popen([sys.executable, str(tmp_path / "program.py")], env=environment, stdout=-1) as program:
        assert program.stdout is not None
        for _ in range(2):
            assert int(program.stdout.readline()) != program.pid
        program.kill()
        assert program.communicate(timeout=LIMIT_S)[0] == b""  # ends when all that could write to it have ended


def assert_interrupted(work: Callable[[], None]) -> None:
    """Work that sets a timer ends with Ctrl-C's exception when that fires, and soon."""

    def interrupt(_number: int, _frame: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGALRM, interrupt)
    began_s = time.monotonic()
    try:
        with pytest.raises(KeyboardInterrupt):
            work()
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
    assert time.monotonic() - began_s < LIMIT_S


def test_an_interrupt_ends_processes_at_once(tmp_path: Path) -> None:
    files = [tmp_path / name for name in NAMES[:2]]

    def work_until_interrupted() -> None:
        with worker_processes(2) as workers:
            workers.map(square, [1, 2], NAMES[:2], Stages(), "started")
            signal.setitimer(signal.ITIMER_REAL, 0.5)
            workers.map(sleep_long, files, NAMES[:2], Stages(), "outer")

    assert_interrupted(work_until_interrupted)
    for file in files:
        with pytest.raises(ProcessLookupError):
            os.kill(int(file.read_text()), 0)


@pytest.mark.parametrize("n", [1, 2])
def test_items_that_are_held_keep_what_functions_do_to_them(n: int) -> None:
    with worker_processes(n) as workers:
        held = workers.hold([[1], [2], [3]], NAMES)
        held.map(append, 7)
        assert held.map(append, 8) == [[1, 7, 8], [2, 7, 8], [3, 7, 8]]
        held.release()


def test_items_are_shared_equally_by_their_sizes() -> None:
    assert equal_shares([5, 4, 3, 3, 3], 2) == [0, 1, 1, 0, 1]
    assert equal_shares([1, 1, 1, 1], 3) == [0, 1, 2, 0]
    assert equal_shares([1, 9], 2) == [1, 0]


def test_as_many_workers_as_cores_drives_and_memory_allow(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(workers_module, "_n_cores", lambda: 8)
    memory = tmp_path / "meminfo"
    monkeypatch.setattr(workers_module, "_MEMORY", memory)  # where there is none, memory is no limit
    log = 8 << 20
    assert default_workers([log] * 20) == 8
    assert default_workers([log] * 3) == 3
    assert default_workers([1000] * 20) == 1  # starting processes would take longer
    memory.write_text(f"MemTotal: 99 kB\nMemAvailable: {4 << 20} kB\n")
    assert default_workers([log] * 20) == 2
    memory.write_text("MemAvailable: 1000 kB\n")
    assert default_workers([log] * 20) == 1


def test_this_process_does_all_by_default() -> None:
    assert Workers().map(square, [3], ["a"], Stages(), "outer") == [(9, os.getpid())]
