"""Logs at URLs (S3, GCS, HTTP, whatever fsspec opens), which are copied to be read.

Readers of logs take paths, so a drive is copied as a whole into a temporary folder, and deleted when it is read.
"""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path, PosixPath, PurePosixPath
from tempfile import TemporaryDirectory
from typing import Any, Final

from groundsbot.calib.foundation import StrPath
from groundsbot.offline.errors import OfflineError

_URL: Final = re.compile(r"[a-z][a-z0-9+.-]+://", re.IGNORECASE)
_SUFFIXES: Final = (".mcap", ".mcap.active")
_OF_LOCAL_FILES: Final = ("file:", "local:")  # whose paths begin with a slash


class RemoteLog(PosixPath):
    """A log at a URL: a path that is not on this computer, and whose text is the URL.

    Attributes:
        n_bytes: its size as `find_remote_logs` found it.
    """

    n_bytes: int = 0

    def __str__(self) -> str:
        protocol, *rest = self.parts
        return f"{protocol}//{'/' if protocol in _OF_LOCAL_FILES else ''}{'/'.join(rest)}"


def log_path(text: StrPath) -> Path:
    """Return the path of a log, or its URL as one."""
    return RemoteLog(text) if _URL.match(str(text)) else Path(text)


def log_size(log: Path) -> int:
    """Return the total size of a log's files; zero where there is no such log."""
    from groundsbot.onboard.log import size_bytes  # as below, not needed for arguments of the command line

    return log.n_bytes if isinstance(log, RemoteLog) else size_bytes(log)


def find_remote_logs(url: RemoteLog) -> list[RemoteLog]:
    """Return the logs of a URL: a file, a run folder, or a folder that contains run folders at any depth, sorted.

    Raises:
        OfflineError: there is none, it cannot be read, or packages for it are missing.
    """
    with _errors_of(url):
        system, root = _open(url)
        sizes: dict[str, int] = {}
        if _is_log_file(root):
            sizes[root] = _size(system, root, {})
        else:
            files = {name: entry for name, entry in system.find(root, detail=True).items() if _is_log_file(name)}
            own = [name for name in files if _folder_of(name) == root.rstrip("/")]  # then it is a run's
            for name in own or files:
                sizes[_folder_of(name)] = sizes.get(_folder_of(name), 0) + _size(system, name, files[name])
        if not sizes and not system.exists(root):
            raise FileNotFoundError
        if not sizes:
            raise OfflineError(f"{url}: holds no .mcap file; give a log, a run folder or a folder of runs")
        found = [RemoteLog(system.unstrip_protocol(name)) for name in sorted(sizes)]
        for log, name in zip(found, sorted(sizes), strict=True):
            log.n_bytes = sizes[name]
        return found


@contextmanager
def local_copy(log: Path, n_bytes: int, copies: Path | None = None) -> Iterator[Path]:
    """Yield a path at which a log can be read: the log's own, or that of a copy, deleted with the block.

    Args:
        log: as found.
        n_bytes: size that it has to have.
        copies: folder for the copy; None, or none on this computer: the system's folder for temporary files.

    Raises:
        OfflineError: a remote log cannot be read, or has another size.
    """
    if not isinstance(log, RemoteLog):
        yield log
        return
    is_here = copies is not None and copies.is_dir()
    with TemporaryDirectory(prefix="groundsbot-", dir=copies if is_here else None) as folder:
        with _errors_of(log):
            path = _copy(log, n_bytes, Path(folder))
        yield path


def _open(url: RemoteLog) -> tuple[Any, str]:
    """Return the file system of a URL, and the path in it."""
    if find_spec("fsspec") is None:
        raise ImportError("fsspec is not installed; pip install 'groundsbot[cluster]'")
    from fsspec.core import url_to_fs

    system, root = url_to_fs(str(url))
    system.invalidate_cache()  # a worker may have listed it for an earlier map
    return system, root


def _copy(log: RemoteLog, n_bytes: int, folder: Path) -> Path:
    """Copy a log into a folder, and return its path there."""
    system, root = _open(log)
    path = folder / log.name
    if _is_log_file(root):
        copies = {root: path}
    else:
        path.mkdir()
        names = [name for name in system.ls(root, detail=False) if _is_log_file(name)]
        copies = {name: path / PurePosixPath(name).name for name in names}
    for name, copy in copies.items():
        system.get_file(name, str(copy))
    found = log_size(path)
    if found != n_bytes:
        raise OfflineError(f"{log}: has {found} bytes{_place()} instead of {n_bytes}; is it still being written?")
    return path


def _size(system: Any, name: str, entry: dict[str, Any]) -> int:  # noqa: ANN401 - fsspec has no types
    """Return the size of a file, whose entry in a listing may lack it, as those of web servers do."""
    size: int | None = entry.get("size")
    size = system.info(name).get("size") if size is None else size
    if size is None:
        raise OSError(f"the size of {name} is not stated")
    return size


def _is_log_file(name: str) -> bool:
    # By its name, since asking a web server whether it is a folder would fetch it.
    return name.partition("?")[0].endswith(_SUFFIXES)


def _folder_of(name: str) -> str:
    return name.rpartition("/")[0]


def _place() -> str:
    from groundsbot.offline.foundation.cluster_task import worker_name

    worker = worker_name()
    return "" if worker is None else f" ({worker})"


@contextmanager
def _errors_of(log: RemoteLog) -> Iterator[None]:
    """Raise an error of a file system as an OfflineError of one line, which names the log, and the worker of a cluster.

    Each file system has errors of its own, of libraries that need not be installed, so all are taken.
    """
    try:
        yield
    except OfflineError:
        raise
    except FileNotFoundError as error:
        raise OfflineError(
            f"{log}: no such log{_place()}; give a .mcap file, a run folder or a folder of runs"
        ) from error
    except PermissionError as error:
        raise OfflineError(
            f"{log}: access is refused{_place()}; give the credentials as fsspec's file system for it takes them, "
            "on all computers that read logs"
        ) from error
    except Exception as error:
        lines = str(error).strip().splitlines() or [type(error).__name__]
        raise OfflineError(f"{log}: cannot be read{_place()} ({lines[0].rstrip('.')})") from error
