"""A Dask cluster of processes on this computer."""

import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Final

import dask
from distributed import LocalCluster, Nanny

from groundsbot.offline.foundation.cluster import ClusterWorkers, cluster_workers

LIMIT_S: Final = 600.0  # only what hangs comes near


@contextmanager
def local_cluster(n: int = 2, threads: int = 1, *, processes: bool = True) -> Iterator[Any]:
    """A cluster of worker processes, which start again when they are killed; or one in this process."""
    # A LocalCluster drops workers that need longer to start again, which those of `dask worker` may take.
    settings = {"distributed.deploy.lost-worker-timeout": "1 hour"}
    with (
        dask.config.set(settings),
        LocalCluster(
            n_workers=n,
            threads_per_worker=threads,
            processes=processes,
            protocol="tcp",
            dashboard_address=":0",
            memory_limit=0,
        ) as cluster,
    ):
        yield cluster


def wait_for_workers(cluster: Any, n: int = 2) -> None:
    """Wait until a cluster has its workers again."""
    wait_until(lambda: len(cluster.scheduler.workers) == n)


def kill_workers(cluster: Any) -> None:
    """Kill all worker processes, and with them every result; their nannies start others."""
    for nanny in list(cluster.workers.values()):
        kill_worker(nanny)


def kill_worker_with_results(cluster: Any) -> None:
    """Kill the worker process that has the most results."""
    address = max(cluster.scheduler.workers.values(), key=lambda worker: len(worker.has_what)).address
    kill_worker(next(each for each in cluster.workers.values() if each.worker_address == address))


def kill_worker(nanny: Nanny) -> None:
    """Kill the process of one worker, if it is there."""
    if nanny.pid is not None:
        os.kill(nanny.pid, signal.SIGKILL)


def wait_until(condition: Callable[[], object]) -> None:
    """Wait for a condition, which is a failure if it takes longer than anything that does not hang."""
    end_s = time.monotonic() + LIMIT_S
    while not condition():
        assert time.monotonic() < end_s
        time.sleep(0.02)


@contextmanager
def limit_time() -> Iterator[None]:
    """Fail what hangs in the block."""

    def fail(_number: int, _frame: object) -> None:
        raise AssertionError(f"not done after {LIMIT_S:.0f} s")

    before = signal.signal(signal.SIGALRM, fail)
    signal.setitimer(signal.ITIMER_REAL, LIMIT_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


@contextmanager
def workers_of(cluster: Any) -> Iterator[ClusterWorkers]:
    """Yield the workers of a cluster once all are there, and fail what hangs in the block."""
    wait_for_workers(cluster)
    with limit_time(), cluster_workers(cluster.scheduler_address) as workers:
        yield workers
