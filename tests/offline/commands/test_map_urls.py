"""Logs at URLs give the map that they give as paths; what cannot be read is one line, and nothing is left behind."""

import importlib.util
import pickle
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Thread
from typing import Any

import fsspec
import numpy as np
import pytest
from fsspec.implementations.memory import MemoryFileSystem

from groundsbot.offline.errors import OfflineError
from groundsbot.offline.foundation.remote_log import RemoteLog, find_remote_logs, local_copy, log_path
from groundsbot.offline.mapping import inputs
from groundsbot.offline.maps.files import read_map
from tests.support.devices.local_cluster import limit_time, local_cluster
from tests.support.programs import Run


@pytest.fixture(autouse=True)
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Where copies of logs are; none is left in the end."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr(inputs, "TemporaryDirectory", partial(TemporaryDirectory, dir=folder))
    yield folder
    assert list(folder.glob("groundsbot-*")) == []


def below(log: Path) -> str:
    """A run's folder below that of all logs."""
    return f"{log.parent.name}/{log.name}"


@pytest.fixture
def memory(logs: dict[str, Path]) -> Iterator[str]:
    """The URL of a folder with the logs, in the memory of this process."""
    system = fsspec.filesystem("memory")
    for log in logs.values():
        for file in log.iterdir():
            system.pipe_file(f"/bucket/drives/{below(log)}/{file.name}", file.read_bytes())
    system.pipe_file("/bucket/empty/readme.txt", b"nothing")
    yield "memory://bucket/drives"
    system.rm("/bucket", recursive=True)


def assert_same_map(one: Path, other: Path) -> None:
    """But for the names of logs."""
    arrays, others = (np.load(folder / "map.npz") for folder in (one, other))
    assert arrays.files == others.files
    for name in arrays.files:
        if not name.endswith("_log"):
            np.testing.assert_array_equal(arrays[name], others[name], name)
    assert (one / "tags.csv").read_bytes() == (other / "tags.csv").read_bytes()


def map_of_paths(run: Run, logs: dict[str, Path], folder: Path) -> Path:
    outcome = run("map", *logs.values(), "-o", folder / "of_paths", "--workers", 1)
    assert (outcome.code, outcome.err) == (0, "")
    return folder / "of_paths"


def test_logs_in_a_memory_file_system(run: Run, logs: dict[str, Path], memory: str, tmp_path: Path) -> None:
    outcome = run("map", memory, "-o", tmp_path / "map", "--workers", 1)
    assert (outcome.code, outcome.err) == (0, "")
    assert_same_map(tmp_path / "map", map_of_paths(run, logs, tmp_path))
    names = [f"{memory}/{below(log)}" for log in logs.values()]
    result = read_map(tmp_path / "map")
    assert [str(each.log) for each in result.runs] == names
    assert [each.log for each in result.archived_segments] == names
    extended = ("--extend", tmp_path / "one" / "map.json")
    # One run of them, and one file of that; and another added.
    assert run("map", names[0], "-o", tmp_path / "one", "--workers", 1).code == 0
    file = next(logs["a"].iterdir()).name
    assert run("map", f"{names[0]}/{file}", "-o", tmp_path / "file", "--workers", 1).code == 0
    assert_same_map(tmp_path / "one", tmp_path / "file")
    assert run("map", names[1], *extended, "-o", tmp_path / "both", "--workers", 1).code == 0
    assert [str(each.log) for each in read_map(tmp_path / "both").runs] == names


def test_a_drive_at_a_url_is_localised(run: Run, logs: dict[str, Path], memory: str, tmp_path: Path) -> None:
    assert run("map", logs["a"], "-o", tmp_path / "map").code == 0
    for name, log in (("url", f"{memory}/{below(logs['b'])}"), ("path", logs["b"])):
        outcome = run("localize", log, "--map", tmp_path / "map", "-o", tmp_path / name)
        assert (outcome.code, outcome.err) == (0, "")
    for file in (tmp_path / "path").iterdir():
        assert (tmp_path / "url" / file.name).read_bytes() == file.read_bytes()


def test_processes_and_a_cluster_read_urls(run: Run, logs: dict[str, Path], tmp_path: Path) -> None:
    expected = map_of_paths(run, logs, tmp_path)
    urls = [log.as_uri() for log in logs.values()]
    assert run("map", *urls, "-o", tmp_path / "processes", "--workers", 2).code == 0
    assert_same_map(tmp_path / "processes", expected)
    with local_cluster() as cluster, limit_time():
        scheduler = ("--scheduler", cluster.scheduler_address)
        outcome = run("map", *urls, "-o", tmp_path / "cluster", *scheduler)
        assert (outcome.code, outcome.err) == (0, "")
        assert_same_map(tmp_path / "cluster", expected)
        # The memory of this process is not that of workers.
        fsspec.filesystem("memory").pipe_file("/alone/0000.core.mcap", next(logs["a"].iterdir()).read_bytes())
        outcome = run("map", "memory://alone", "-o", tmp_path / "refused", *scheduler)
    assert outcome.code == 1
    assert outcome.err.startswith("error: memory://alone: no such log (worker tcp://")
    assert len(outcome.err.splitlines()) == 1
    assert not (tmp_path / "refused").exists()


class Unreliable(MemoryFileSystem):  # type: ignore[misc]  # fsspec has no types
    """Whose files are listed, and cannot be read."""

    protocol = "unreliable"
    store: dict[str, Any] = {}  # noqa: RUF012 - as in fsspec
    pseudo_dirs = [""]  # noqa: RUF012
    error: Exception | None = None

    @classmethod
    def _strip_protocol(cls, path: str) -> str:
        return str(MemoryFileSystem._strip_protocol(path.removeprefix("unreliable://")))

    def get_file(self, rpath: str, lpath: str, **_options: Any) -> None:
        """As fsspec's, but for what is wrong."""
        Path(lpath).write_bytes(self.cat_file(rpath)[:1000])
        if self.error is not None:
            raise self.error


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (ConnectionResetError("Connection lost\nand more"), "cannot be read (Connection lost)"),
        (PermissionError("403"), "access is refused; give the credentials"),
        (RuntimeError(), "cannot be read (RuntimeError)"),
        (None, "has 1000 bytes instead of"),
    ],
)
def test_a_lost_connection_is_one_line(
    error: Exception | None,
    said: str,
    run: Run,
    logs: dict[str, Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    fsspec.register_implementation("unreliable", Unreliable, clobber=True)
    monkeypatch.setattr(Unreliable, "error", error)
    fsspec.filesystem("unreliable").pipe_file("/a/0000.core.mcap", next(logs["a"].iterdir()).read_bytes())
    outcome = run("map", "unreliable://a", "-o", tmp_path / "map", "--workers", 1)
    assert outcome.code == 1
    assert outcome.err.startswith(f"error: unreliable://a: {said}")
    assert len(outcome.err.splitlines()) == 1
    assert not (tmp_path / "map").exists()


@pytest.mark.parametrize(
    ("url", "said"),
    [
        ("nonsense://bucket/drives", "cannot be read (Protocol not known: nonsense)"),
        ("memory://bucket/nowhere", "no such log; give"),
        ("memory://bucket/drives/nowhere.mcap", "no such log; give"),
        ("memory://bucket/empty", "holds no .mcap file"),
        ("file:///nowhere", "no such log; give"),
        pytest.param(
            "s3://bucket/drives",
            "cannot be read (Install s3fs to access S3)",
            marks=pytest.mark.skipif(importlib.util.find_spec("s3fs") is not None, reason="s3fs is installed"),
        ),
    ],
)
@pytest.mark.parametrize("command", ["map", "calibrate"])
def test_a_url_without_logs_is_one_line(
    command: str, url: str, said: str, run: Run, memory: str, tmp_path: Path
) -> None:
    assert memory
    outcome = run(command, url, "-o", tmp_path / "out")
    assert (outcome.code, len(outcome.err.splitlines())) == (1, 1)
    assert outcome.err.startswith(f"error: {url}: {said}")
    assert not (tmp_path / "out").exists()


def test_without_fsspec_the_extra_is_named(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("groundsbot.offline.foundation.remote_log.find_spec", lambda _name: None)
    outcome = run("map", "s3://bucket/drives", "-o", tmp_path / "out")
    assert outcome.err == (
        "error: s3://bucket/drives: cannot be read (fsspec is not installed; pip install 'groundsbot[cluster]')\n"
    )


def test_an_error_in_a_log_names_its_url(run: Run, memory: str, temporary: Path, tmp_path: Path) -> None:
    fsspec.filesystem("memory").pipe_file("/bucket/drives/c_bad/0000.core.mcap", b"no log at all")
    outcome = run("map", memory, "-o", tmp_path / "map")
    assert outcome.code == 1
    assert outcome.err.startswith(f"error: {memory}/c_bad")
    assert str(temporary) not in outcome.err


def test_a_log_that_grows_is_refused(memory: str) -> None:
    first, _ = find_remote_logs(RemoteLog(memory))
    with local_copy(first, first.n_bytes) as path:
        assert sum(file.stat().st_size for file in path.iterdir()) == first.n_bytes
    with pytest.raises(OfflineError, match="still being written"), local_copy(first, first.n_bytes - 1):
        pass


@pytest.mark.parametrize(
    "url", ["s3://bucket/drives/a", "https://host:8080/a/0000.core.mcap", "file:///drives/a", "memory://a", "gs://b"]
)
def test_a_url_stays_what_it_is(url: str) -> None:
    log = log_path(url)
    assert str(log) == url
    assert str(pickle.loads(pickle.dumps(log))) == url
    assert str(log_path(str(log))) == url
    assert isinstance(log, RemoteLog)
    assert not isinstance(log_path("drives/s3:/x"), RemoteLog)


def test_logs_of_a_web_server(logs: dict[str, Path]) -> None:
    class Handler(SimpleHTTPRequestHandler):
        def __init__(self, *arguments: Any) -> None:
            super().__init__(*arguments, directory=str(logs["a"].parents[1]))

        def log_message(self, *_arguments: object) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        url = f"http://127.0.0.1:{server.server_port}"
        found = find_remote_logs(RemoteLog(url))
        assert [str(log) for log in found] == [f"{url}/{below(log)}" for log in logs.values()]
        for log, original in zip(found, logs.values(), strict=True):
            with local_copy(log, log.n_bytes) as path:
                assert [file.read_bytes() for file in path.iterdir()] == [
                    file.read_bytes() for file in original.iterdir()
                ]
        server.shutdown()
