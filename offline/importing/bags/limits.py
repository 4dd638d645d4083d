"""Limits on memory and messages while an untrusted bag is read: a small file can expand to gigabytes, or never end.

The library that reads bags decompresses whole chunks, and runs whatever queries an SQLite file defines. The limits grow
with the bag's size and are far above what real drives need, because sensor noise is incompressible.
"""

import resource
import sqlite3
from collections.abc import Iterable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Final, TypeVar

from groundsbot.offline.errors import OfflineError

_FREE_BYTES: Final = 112 << 20
_BYTES_PER_BYTE: Final = 128  # nearly constant odometry compresses to 60 bytes a message, and takes 3 kB in memory
_FREE_MESSAGES: Final = 100_000
_BYTES_A_MESSAGE: Final = 8
_MOST_METADATA_BYTES: Final = 1 << 18  # about 1,000 per topic; parsing a megabyte of YAML takes half a minute
_STATUS: Final = Path("/proc/self/status")
_SQLITE: Final = ".db3"
METADATA: Final = "metadata.yaml"
MOST_DEFINITION_CHARS: Final = 1 << 16  # those of ROS have up to 10,000, nested types included


_Message = TypeVar("_Message")


class BagLimits:
    """Limits for one bag."""

    def __init__(self, path: Path) -> None:
        """Set the limits from the bag's size, and check its SQLite tables.

        Raises:
            OfflineError: its metadata is far too long, or its SQLite files hold what no recorder writes.
        """
        files = [path] if path.is_file() else [each for each in path.iterdir() if each.is_file()]
        size = sum(each.stat().st_size for each in files)
        self._path = path
        self._bytes = _FREE_BYTES + _BYTES_PER_BYTE * size
        taken = _data_bytes()
        self._most_bytes = taken + self._bytes if taken else resource.RLIM_INFINITY
        self._messages_left = _FREE_MESSAGES + size / _BYTES_A_MESSAGE
        for each in files:
            if each.suffix == _SQLITE:
                _check_sqlite(each)
            elif each.name == METADATA and each.stat().st_size > _MOST_METADATA_BYTES:
                raise OfflineError(
                    f"{each}: has {each.stat().st_size} bytes, limit {_MOST_METADATA_BYTES}; run `ros2 bag reindex`"
                )

    @contextmanager
    def memory(self) -> Iterator[None]:
        """Limit this process's memory inside the block to its initial size plus the allowance for the bag.

        Raises:
            OfflineError: the block needs more.
        """
        soft, hard = resource.getrlimit(resource.RLIMIT_DATA)
        if self._most_bytes != resource.RLIM_INFINITY:
            most = self._most_bytes if soft == resource.RLIM_INFINITY else min(soft, self._most_bytes)
            resource.setrlimit(resource.RLIMIT_DATA, (most, hard))
        try:
            yield
        except MemoryError as error:
            raise OfflineError(
                f"{self._path}: expands to more than {self._bytes >> 20} MiB, the limit for a bag of its size; is it "
                "damaged? record it again"
            ) from error
        finally:
            resource.setrlimit(resource.RLIMIT_DATA, (soft, hard))

    def count(self, messages: Iterable[_Message]) -> Iterator[_Message]:
        """Yield the same messages.

        Raises:
            OfflineError: there are more than a bag of its size can hold.
        """
        iterator = iter(messages)
        while True:
            with self.memory():
                each = next(iterator, None)
            if each is None:
                return
            self._messages_left -= 1
            if self._messages_left < 0:
                raise OfflineError(
                    f"{self._path}: holds more messages than a bag of its size can hold; is it damaged? record it again"
                )
            yield each


def _data_bytes() -> int:
    """Return this process's data size as RLIMIT_DATA counts it; 0 if the system does not report it."""
    try:
        lines = _STATUS.read_text(encoding="ascii").splitlines()
    except OSError:
        return 0
    return next((int(line.split()[1]) << 10 for line in lines if line.startswith("VmData:")), 0)


def _check_sqlite(path: Path) -> None:
    """Refuse a file with views, triggers or generated columns, or with shared pages: reading one may never end.

    Raises:
        OfflineError: the file is one of these, or not SQLite.
    """
    try:
        with closing(sqlite3.connect(f"{path.resolve().as_uri()}?immutable=1", uri=True)) as database:
            made_up = database.execute("SELECT name FROM sqlite_master WHERE type NOT IN ('table', 'index')").fetchone()
            tables = [name for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")]
            for name in tables if made_up is None else []:
                columns = database.execute("SELECT name, hidden FROM pragma_table_xinfo(?)", (name,))
                made_up = made_up or next((column for column in columns if column[1]), None)
            (found,) = ("ok",) if made_up else database.execute("PRAGMA quick_check(1)").fetchone()
    except sqlite3.Error as error:
        raise OfflineError(f"{path}: cannot be read as a bag: {error}; run `ros2 bag reindex`") from error
    if made_up is not None:
        raise OfflineError(f"{path}: its {made_up[0]} is computed by a query, not recorded; record it again")
    if found != "ok":
        raise OfflineError(f"{path}: is damaged ({' '.join(str(found).split())[:200]}); run `ros2 bag reindex`")
