"""A cluster that cannot be used is one line, soon."""

import re
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest

from groundsbot.offline.errors import OfflineError
from groundsbot.offline.foundation import cluster_connection
from groundsbot.offline.foundation.cluster_connection import connect
from groundsbot.offline.foundation.cluster_task import SOURCES, check_versions, installed_versions, sources_hash
from tests.support.devices.local_cluster import LIMIT_S, limit_time, local_cluster, wait_for_workers


def refusal(address: str) -> str:
    """The line by which a scheduler is refused."""
    began_s = time.monotonic()
    with limit_time(), pytest.raises(OfflineError) as refused:
        connect(address)
    assert time.monotonic() - began_s < LIMIT_S
    (line,) = str(refused.value).splitlines()
    assert line.startswith(f"--scheduler {address}: ")
    return line


@contextmanager
def server(banner: bytes) -> Iterator[str]:
    """The address of something that answers with a banner, and with nothing more."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        connections = []

        def answer() -> None:
            while True:
                try:
                    connections.append(listener.accept()[0])
                    connections[-1].sendall(banner)
                except OSError:
                    return

        thread = threading.Thread(target=answer)
        thread.start()
        try:
            yield f"tcp://127.0.0.1:{listener.getsockname()[1]}"
        finally:
            listener.shutdown(socket.SHUT_RDWR)
            thread.join()
            for each in connections:
                each.close()


@contextmanager
def cluster_with(folder: Path) -> Iterator[str]:
    """The address of a cluster whose only worker finds packages in a folder first."""
    with ExitStack() as stack:
        with pytest.MonkeyPatch.context() as patch:
            patch.syspath_prepend(folder)  # which processes inherit
            made = stack.enter_context(local_cluster(1))
            wait_for_workers(made, 1)
        yield made.scheduler_address


@pytest.mark.parametrize(
    "address", ["host:8786", "http://host:8786", "tcp://host", "tcp://host:port", "tcp://:8786", "tcp://a:1/b", ""]
)
def test_what_is_no_address_is_refused_with_an_example(address: str) -> None:
    assert "is no address of a scheduler; give tcp://HOST:PORT" in refusal(address)


def test_where_nothing_listens_no_scheduler_is_awaited() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    line = refusal(f"tcp://127.0.0.1:{port}")
    assert "no scheduler answers there (" in line
    assert "refused" in line
    assert "start `dask scheduler`" in line


@pytest.mark.parametrize("host", ["no-such-host.invalid", "127.0.0.1"])
def test_a_host_or_port_that_cannot_be_is_no_scheduler(host: str) -> None:
    assert "no scheduler answers there (" in refusal(f"tcp://{host}:99999")


@pytest.mark.parametrize("banner", [b"", b"SSH-2.0-OpenSSH_9.2\r\n", b"HTTP/1.1 400 Bad Request\r\n\r\n"])
def test_what_is_no_dask_scheduler_is_refused(banner: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster_connection, "_CONNECTING_S", 1.0)
    with server(banner) as address:
        assert "what answers there is no Dask scheduler but no server of Dask (" in refusal(address)


def test_a_worker_is_no_scheduler() -> None:
    with local_cluster(1, processes=False) as made:
        (worker,) = made.scheduler.workers
        assert "no Dask scheduler but Worker; give the address" in refusal(worker)


def test_a_cluster_without_workers_is_refused() -> None:
    with local_cluster(0, processes=False) as empty:
        line = refusal(empty.scheduler_address)
    assert "the scheduler has no workers; start some with `dask worker tcp://" in line


def test_a_worker_with_several_threads_is_refused() -> None:
    with local_cluster(1, threads=3, processes=False) as made:
        line = refusal(made.scheduler_address)
    assert re.search(r"worker tcp://\S+ has 3 threads, must have 1; .* --nthreads 1`, and `--nworkers 3`", line)


def test_a_worker_with_another_version_is_refused(tmp_path: Path) -> None:
    other = tmp_path / "groundsbot-9.8.7.dist-info"
    other.mkdir()
    (other / "METADATA").write_text("Metadata-Version: 2.1\nName: groundsbot\nVersion: 9.8.7\n")
    own = installed_versions()["groundsbot"]
    with cluster_with(tmp_path) as address:
        line = refusal(address)
    assert re.search(rf"worker tcp://\S+: groundsbot version 9\.8\.7, but {own} here; install the same", line)


@pytest.mark.parametrize(
    ("package", "named"),
    [
        ("python", r"scheduler: python version \S+, but 9\.8\.7 here"),
        ("distributed", r"scheduler: distributed version \S+, but 9\.8\.7 here"),
        ("numpy", r"scheduler: numpy version \S+, but 9\.8\.7 here"),
        (SOURCES, rf"worker tcp://\S+: {SOURCES} {sources_hash()}, but 9\.8\.7 here"),
    ],
    ids=["python", "distributed", "numpy", "sources"],
)
def test_a_process_of_other_versions_is_refused(package: str, named: str, monkeypatch: pytest.MonkeyPatch) -> None:
    versions = installed_versions() | {package: "9.8.7"}
    monkeypatch.setattr(cluster_connection, "installed_versions", VersionsOf(versions))
    with local_cluster(1, processes=False) as made:
        assert re.search(named, refusal(made.scheduler_address))


class VersionsOf:
    """Versions that this process says it has; on a worker, those that are there."""

    def __init__(self, versions: dict[str, str]) -> None:
        self._versions = versions

    def __call__(self) -> dict[str, str]:
        return self._versions

    def __reduce__(self) -> tuple[Any, ...]:
        return getattr, (_Module(), "installed_versions")


class _Module:
    installed_versions = staticmethod(installed_versions)


def test_a_python_that_is_another_is_named() -> None:
    with pytest.raises(OfflineError, match=r"^worker w: python version 3\.9\.1, but 3\.11\.0 here; install"):
        check_versions({"python": "3.11.0"}, {"python": "3.9.1"}, "worker w")
    with pytest.raises(OfflineError, match=r"^worker w: numba version none, but 0\.60 here"):
        check_versions({"numba": "0.60"}, {"numba": None}, "worker w")


def test_the_hash_of_sources_changes_with_each_package(tmp_path: Path) -> None:
    found = {sources_hash()}
    for package in ("calib", "onboard", "offline"):
        file = tmp_path / package / "room" / "file.py"
        file.parent.mkdir(parents=True)
        for text in ("a = 1", "a = 2"):
            file.write_text(text)
            found.add(sources_hash(tmp_path))
    assert len(found) == 7
    assert sources_hash(tmp_path) in found
