"""Connection to the scheduler of a Dask cluster: what is wrong with it is one line, and so is its loss."""

import asyncio
import logging
import re
import socket
import threading
import time
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from typing import Any, Final

import dask
from distributed import Client, rpc
from distributed.client import CancelledError, ClosedClientError

from groundsbot.offline.errors import OfflineError
from groundsbot.offline.foundation.cluster_task import PACKAGES, SOURCES, check_versions, installed_versions

_ADDRESS: Final = re.compile(r"tcp://(?P<host>[^/\[\]:]+|\[[^\]]+\]):(?P<port>\d{1,5})")
_CONNECTING_S: Final = 10.0
# A worker that was killed starts again within seconds under its nanny.
_WITHOUT_WORKERS_S: Final = 60.0
_WATCHING_S: Final = 2.0


def connect(address: str) -> Client:
    """Return a client of the scheduler at an address, all of whose workers have the versions of this process.

    Raises:
        OfflineError: the address is none, no scheduler is there, it has no workers, or one cannot be used.
    """
    option = f"--scheduler {address}"
    found = _ADDRESS.fullmatch(address)
    if found is None:
        raise OfflineError(f"{option}: is no address of a scheduler; give tcp://HOST:PORT, as `dask scheduler` prints")
    for name in ("distributed", "distributed.client", "distributed.comm"):
        logging.getLogger(name).setLevel(logging.CRITICAL)  # what it says is said by our errors
    _check_scheduler(address, option, found["host"].strip("[]"), int(found["port"]))
    # Else a client keeps its last 1,000 messages, with the values of all variables that it sent to a fleet's parts.
    without_log = dask.config.set({"distributed.admin.low-level-log-length": 0})
    with warnings.catch_warnings(), without_log:
        warnings.simplefilter("ignore")  # versions are checked below
        client = Client(address, timeout=_CONNECTING_S, set_as_default=False)
    try:
        _check(client, option)
    except BaseException:
        client.close()
        raise
    return client


def _check_scheduler(address: str, option: str, host: str, port: int) -> None:
    """Check that a scheduler answers, since a client waits without end for some that are none.

    Raises:
        OfflineError: nothing answers, or something else.
    """
    try:
        socket.create_connection((host, port), _CONNECTING_S).close()
    except (OSError, OverflowError) as error:
        raise OfflineError(
            f"{option}: no scheduler answers there ({error}); start `dask scheduler`, or correct the address"
        ) from error
    try:
        kind = asyncio.run(asyncio.wait_for(_kind_of_server(address), _CONNECTING_S))
    except Exception as error:  # of any kind, for what answers may be anything
        kind = f"no server of Dask ({type(error).__name__})"
    if kind != "Scheduler":
        raise OfflineError(
            f"{option}: what answers there is no Dask scheduler but {kind}; give the address that `dask scheduler` "
            "prints"
        )


async def _kind_of_server(address: str) -> str:
    async with rpc(address, timeout=_CONNECTING_S) as server:
        return str((await server.identity())["type"])


def _check(client: Client, option: str) -> None:
    """Check versions and threads of scheduler and workers.

    Raises:
        OfflineError: naming the first that cannot be used.
    """
    here = installed_versions()
    versions = client.get_versions(packages=PACKAGES)
    check_versions(here, _packages(versions["scheduler"]), f"{option}: scheduler")
    threads: dict[str, int] = client.nthreads()
    if not threads:
        raise OfflineError(
            f"{option}: the scheduler has no workers; start some with `dask worker {option.split()[-1]} --nthreads 1`"
        )
    for worker, own in sorted(versions["workers"].items()):
        check_versions(here, _packages(own), f"{option}: worker {worker}")
    for worker, own in sorted(client.run(installed_versions, on_error="return").items()):
        if isinstance(own, (ImportError, AttributeError)):  # a revision without this function
            own = {SOURCES: None}
        if not isinstance(own, BaseException):  # lost meanwhile
            check_versions(here, own, f"{option}: worker {worker}")
    for worker, n in sorted(threads.items()):
        if n != 1:
            raise OfflineError(
                f"{option}: worker {worker} has {n} threads, must have 1; start it with `dask worker --nthreads 1`, "
                f"and `--nworkers {n}` for as many processes"
            )


def _packages(versions: Mapping[str, Any]) -> dict[str, str | None]:
    """Return the versions that Dask states of a process, in the form of `installed_versions`."""
    found: dict[str, str | None] = dict(versions["packages"])
    python = str(found.pop("python", ""))
    return {
        **{name: each or "not installed" for name, each in found.items() if name in installed_versions()},
        "python": ".".join(python.split(".")[:3]),
    }


def _is_working(worker: Mapping[str, Any]) -> bool:
    """Return whether a worker takes tasks, or is paused by Dask for lack of memory but still has one."""
    return bool(worker["status"] == "running" or worker["metrics"].get("executing"))


class Watch(threading.Thread):
    """A thread that cancels all tasks once there are no workers left that do them: Dask itself waits without end."""

    def __init__(self, client: Client, address: str) -> None:
        """Watch the cluster of a client, whose address is named in errors."""
        super().__init__(daemon=True)
        self._client, self._option = client, f"--scheduler {address}"
        self._ended = threading.Event()
        self._reason: str | None = None

    def run(self) -> None:
        """Look at the workers until stopped."""
        since_s = time.monotonic()
        while not self._ended.wait(_WATCHING_S):
            with suppress(Exception):  # the scheduler is lost, of which the client tells by itself
                if any(map(_is_working, self._client.scheduler_info()["workers"].values())):
                    since_s = time.monotonic()
            if time.monotonic() - since_s > _WITHOUT_WORKERS_S:
                self._reason = (
                    f"for {_WITHOUT_WORKERS_S:.0f} s no worker was left, or all were paused for lack of memory; start "
                    "others, and run it again"
                )
                self._client.close(_WATCHING_S)
                return

    def stop(self) -> None:
        """End the thread."""
        self._ended.set()

    @contextmanager
    def explain(self) -> Iterator[None]:
        """Raise an OfflineError where tasks in the block were cancelled, or the scheduler does not answer."""
        try:
            yield
        except (CancelledError, ClosedClientError, OSError, TimeoutError) as error:
            reason = self._reason or "the scheduler was lost; see its own output, and run it again"
            raise OfflineError(f"{self._option}: {reason}") from error
