"""Workers of a Dask cluster: results as in this process, also after workers were killed; errors are one line."""

import gc
import os
import signal
import time
import weakref
from collections.abc import Iterator
from pathlib import Path
from threading import Thread
from types import SimpleNamespace
from typing import Any, NamedTuple

import dask
import numpy as np
import pytest
from distributed import KilledWorker
from distributed.core import Status

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.foundation import cluster_connection
from groundsbot.offline.foundation.cluster import ClusterWorkers, cluster_workers
from groundsbot.offline.foundation.stages import Stages
from groundsbot.offline.foundation.workers import Workers
from tests.offline.foundation.test_workers import assert_interrupted, refuse_odd, square
from tests.support.devices.local_cluster import (
    LIMIT_S,
    kill_worker,
    kill_workers,
    limit_time,
    local_cluster,
    wait_for_workers,
    wait_until,
    workers_of,
)

NAMES = ["a", "b", "c"]
N = 10_000


class Drive(NamedTuple):
    """What a stage makes of a drive."""

    name: str
    values: FloatArray
    stamps: FloatArray


def miss_a_file(_item: int, _stages: Stages) -> int:
    raise FileNotFoundError("gone")


def die(item: int, _stages: Stages) -> int:
    if item == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return item


def die_once(item: tuple[Path, int], _stages: Stages) -> int:
    mark, value = item
    if not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return value


def fail_as_killed(_i: int) -> int:
    raise KilledWorker("task", SimpleNamespace(address="tcp://w:1"), 3)


def index(i: int) -> int:
    return i


def make_drive(seed: int, _stages: Stages) -> Drive:
    rng = np.random.default_rng(seed)
    return Drive(str(seed), rng.normal(size=N), np.asfortranarray(rng.normal(size=(3, N))))


def make_other_values(item: int, _stages: Stages) -> Drive:
    return make_drive(os.getpid() + item, _stages)


def add_in_place(drive: Drive, _stages: Stages) -> tuple[Drive, FloatArray]:
    values = drive.values
    values += 1.0
    return drive, drive.stamps.sum(axis=0)


def sum_up(item: tuple[Drive, FloatArray], _stages: Stages) -> tuple[float, bool]:
    drive, sums = item
    return float(drive.values.sum() + drive.stamps.sum() + sums.sum()), drive.stamps.flags.f_contiguous


def append(items: list[int], item: int) -> list[int]:
    items.append(item)
    return items


def work_until_released(item: Path, _stages: Stages) -> None:
    item.touch()
    end_s = time.monotonic() + LIMIT_S
    while not release_of(item).exists() and time.monotonic() < end_s:
        time.sleep(0.02)


def release_of(item: Path) -> Path:
    """The file that ends the work on an item."""
    return item.with_suffix(".release")


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    with local_cluster() as made:
        yield made


@pytest.fixture
def workers(cluster: Any) -> Iterator[ClusterWorkers]:
    with workers_of(cluster) as made:
        yield made


def through_stages(workers: Workers, between: Any = None) -> list[tuple[float, bool]]:
    """Three stages, each with what the one before returned."""
    made = workers.map(make_drive, [1, 2, 3], NAMES, Stages(), "made")
    if between is not None:
        between()
    added = workers.map(add_in_place, made, NAMES, Stages(), "added")
    if between is not None:
        between()
    return workers.map(sum_up, added, NAMES, Stages(), "summed")


def test_results_come_in_order_with_the_time_of_each_stage(workers: ClusterWorkers) -> None:
    news: list[tuple[str, int, int]] = []
    stages = Stages(lambda *each: news.append(each))
    found = workers.map(square, [3, 1, 2], NAMES, stages, "outer")
    assert [value for value, _ in found] == [9, 1, 4]
    assert os.getpid() not in {process for _, process in found}
    assert [each for each in news if each[0] == "outer"] == [("outer", done, 3) for done in range(4)]
    assert {cost.name for cost in stages.costs} == {"outer", "inner"}
    assert workers.map(square, [], [], stages, "outer") == []


def test_what_the_first_of_those_that_fail_raised_is_raised(workers: ClusterWorkers) -> None:
    with pytest.raises(OfflineError, match="1 is odd"):
        workers.map(refuse_odd, [0, 1, 3], NAMES, Stages(), "outer")
    with pytest.raises(FileNotFoundError, match="gone"):  # not an error of the connection
        workers.map(miss_a_file, [1], NAMES[:1], Stages(), "outer")


def test_arrays_that_the_cluster_has_are_not_sent_again(workers: ClusterWorkers) -> None:
    made = workers.map(make_drive, [1, 2, 3], NAMES, Stages(), "made")
    first = workers.traffic
    assert first.received > 3 * 4 * N * 8
    added = workers.map(add_in_place, made, NAMES, Stages(), "added")
    assert workers.traffic.sent - first.sent < 10_000
    # What was changed and what is new comes back, but not the stamps, which are the same.
    assert workers.traffic.received - first.received < 3 * 2 * N * 8 + 10_000
    assert all(after.stamps is before.stamps for before, (after, _) in zip(made, added, strict=True))


def test_arrays_that_this_process_changed_are_sent_as_they_are(workers: ClusterWorkers) -> None:
    made = workers.map(make_drive, [1], NAMES[:1], Stages(), "made")
    made[0].values[:] = 0.0
    ((drive, _),) = workers.map(add_in_place, made, NAMES[:1], Stages(), "added")
    np.testing.assert_array_equal(drive.values, np.ones(N))
    np.testing.assert_array_equal(made[0].values, np.zeros(N))


def test_what_a_task_does_to_its_input_is_not_seen_by_the_next(workers: ClusterWorkers) -> None:
    made = workers.map(make_drive, [1, 2], NAMES[:2], Stages(), "made")
    for _ in range(2):
        added = workers.map(add_in_place, made, NAMES[:2], Stages(), "added")
        for before, (after, _sums) in zip(made, added, strict=True):
            np.testing.assert_array_equal(after.values, before.values + 1.0)


def test_results_lost_with_all_workers_are_computed_again(cluster: Any, workers: ClusterWorkers) -> None:
    assert through_stages(workers, lambda: kill_workers(cluster)) == through_stages(Workers())


def test_a_result_that_is_another_when_computed_again_is_refused(cluster: Any, workers: ClusterWorkers) -> None:
    made = workers.map(make_other_values, [1], NAMES[:1], Stages(), "made")
    kill_workers(cluster)
    with pytest.raises(OfflineError, match=r"^worker tcp://.* computed again with other values; all workers must"):
        workers.map(add_in_place, made, NAMES[:1], Stages(), "added")


def test_a_drive_whose_worker_was_killed_once_is_done_again(workers: ClusterWorkers, tmp_path: Path) -> None:
    items = [(tmp_path / name, i) for i, name in enumerate(NAMES)]
    assert workers.map(die_once, items, NAMES, Stages(), "outer") == [0, 1, 2]


def test_a_drive_that_kills_its_worker_each_time_is_named(
    cluster: Any, workers: ClusterWorkers, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cluster.scheduler, "allowed_failures", 0)
    with pytest.raises(OfflineError, match=r"^b: all workers that had it were killed.*more memory"):
        workers.map(die, [0, 2, 4], NAMES, Stages(), "outer")


def test_a_drive_that_lost_its_worker_by_another_one_is_tried_again_alone(workers: ClusterWorkers) -> None:
    tried: list[int] = []

    def submit(i: int) -> Any:
        tried.append(i)
        return workers.submit("task", fail_as_killed if tried.count(0) == 1 and i == 0 else index, i)

    _, found = workers.results(submit, NAMES, lambda: None)
    assert found == [0, 1, 2]
    assert tried == [0, 1, 2, 0]


def test_items_that_are_held_keep_what_functions_do_to_them(cluster: Any, workers: ClusterWorkers) -> None:
    held = workers.hold([[1], [2], [3]], NAMES)
    assert held.map(append, 7) == [[1, 7], [2, 7], [3, 7]]
    kill_workers(cluster)
    assert held.map(append, 8) == [[1, 7, 8], [2, 7, 8], [3, 7, 8]]
    kill_worker(next(iter(cluster.workers.values())))
    assert held.map(append, 9) == [[1, 7, 8, 9], [2, 7, 8, 9], [3, 7, 8, 9]]
    held.release()


def test_functions_of_results_that_are_on_the_cluster(cluster: Any, workers: ClusterWorkers) -> None:
    squares = [workers.call("square", pow, i, 2) for i in range(3)]
    kill_worker(next(iter(cluster.workers.values())))
    _, found = workers.results(lambda i: workers.call("sum", sum, [*squares, i]), NAMES, lambda: None)
    assert found == [5, 6, 7]


def test_an_array_that_was_sent_is_not_kept(workers: ClusterWorkers) -> None:
    array = np.arange(float(N))
    kept = weakref.ref(array)
    for values in (array, np.zeros(N)):  # the second message replaces the first one where it was written
        future = workers.call("sum", np.sum, values)
        assert future.result() == values.sum()
    del array, values
    gc.collect()
    assert kept() is None


def test_a_function_is_not_called_by_a_worker_of_another_version(
    workers: ClusterWorkers, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("groundsbot.offline.foundation.cluster.installed_versions", lambda: {"groundsbot": "0.0.1"})
    with pytest.raises(OfflineError, match=r"^worker tcp://.*: groundsbot version .*, but 0\.0\.1 here"):
        workers.results(lambda i: workers.call("index", index, i), NAMES, lambda: None)


def test_an_interrupt_cancels_the_tasks(cluster: Any, tmp_path: Path) -> None:
    files = [tmp_path / name for name in NAMES]
    wait_for_workers(cluster)

    def work_until_interrupted() -> None:
        with cluster_workers(cluster.scheduler_address) as workers:
            signal.setitimer(signal.ITIMER_REAL, 0.5)
            workers.map(work_until_released, files, NAMES, Stages(), "outer")

    assert_interrupted(work_until_interrupted)
    wait_until(lambda: not cluster.scheduler.tasks)
    for file in files:
        release_of(file).touch()  # a task that runs is not ended, but its result is dropped


def test_no_worker_left_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster_connection, "_WITHOUT_WORKERS_S", 1.0)
    monkeypatch.setattr(cluster_connection, "_WATCHING_S", 0.1)
    with local_cluster(1, processes=False) as lone, limit_time():
        address = lone.scheduler_address

        def leave(_name: str, _done: int, _total: int) -> None:
            (worker,) = lone.workers.values()
            lone.sync(worker.close)

        line = rf"^--scheduler {address}: for 1 s no worker was left, or all were paused"
        with pytest.raises(OfflineError, match=line), cluster_workers(address) as workers:
            workers.map(work_until_released, [tmp_path / "a"], ["a"], Stages(leave), "outer")


def test_workers_that_are_all_paused_are_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster_connection, "_WITHOUT_WORKERS_S", 1.0)
    monkeypatch.setattr(cluster_connection, "_WATCHING_S", 0.1)
    with local_cluster(1, processes=False) as lone, limit_time():
        (worker,) = lone.workers.values()
        worker.status = Status.paused
        wait_until(lambda: not lone.scheduler.running)
        with pytest.raises(OfflineError, match="all were paused"), cluster_workers(lone.scheduler_address) as workers:
            workers.map(work_until_released, [tmp_path / "a"], ["a"], Stages(), "outer")


def test_a_scheduler_that_is_lost_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster_connection, "_CONNECTING_S", 3.0)
    item = tmp_path / "a"
    settings = dask.config.set({"distributed.comm.timeouts.connect": "1s"})  # for which the worker seeks it
    with settings, local_cluster(1, processes=False) as lone, limit_time():
        address = lone.scheduler_address

        def end() -> None:
            wait_until(item.exists)
            lone.sync(lone.scheduler.close)

        ending = Thread(target=end)
        ending.start()
        line = rf"^--scheduler {address}: the scheduler was lost; see its"
        with pytest.raises(OfflineError, match=line), cluster_workers(address) as workers:
            workers.map(work_until_released, [item], ["a"], Stages(), "outer")
        release_of(item).touch()
        ending.join()
