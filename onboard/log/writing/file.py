"""One MCAP file under way: a chunk is written whole or not at all, and the file is finished once or never."""

import errno
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, NamedTuple, cast

from mcap.well_known import MessageEncoding
from mcap.writer import CompressionType, IndexType, Writer
from mcap_protobuf.schema import register_schema

from groundsbot.onboard.log.messages import TOPICS
from groundsbot.onboard.log.writing.storage import Storage, StoredFile

ACTIVE_SUFFIX: Final = ".active"


class Record(NamedTuple):
    """One message, ready to be written; times in ns on the run's clock."""

    topic: str
    data: bytes
    log_time_ns: int
    publish_time_ns: int


class LogFile:
    """One file, called `<name>.active` until it is finished, so that nobody takes half a log for a whole one.

    Every method that writes raises OSError; what had been written stays whole then, and what had not stays in memory,
    so that the same call can be tried again.

    Attributes:
        path: its name once it is finished.
        unsafe: messages that are not on the disk yet.
    """

    def __init__(self, storage: Storage, path: Path, topics: Iterable[str], *, compressed: bool) -> None:
        """Creates the file and declares its topics.

        Args:
            storage: where.
            path: its name once it is finished.
            topics: all that it will ever hold. They are declared at the head, so that no chunk needs another but the
                first.
            compressed: whether chunks are; JPEG does not get smaller.

        Raises:
            FileExistsError: the name is taken, by a finished or an unfinished file.
            OSError: it cannot be created.
        """
        self.path = path
        self.unsafe: list[Record] = []
        self._storage = storage
        if storage.exists(path):
            raise FileExistsError(errno.EEXIST, "exists already", str(path))
        self._sink = _Sink(storage.create(self.active_path))
        self._synced_bytes = 0
        compression = CompressionType.ZSTD if compressed else CompressionType.NONE
        self._writer = Writer(
            cast(Any, self._sink),
            compression=compression,
            index_types=IndexType.ALL,
            enable_crcs=True,
            enable_data_crcs=True,
        )
        self._finished = False
        self._writer.start(profile="", library="groundsbot")
        self._channels = {name: self._channel_of(name) for name in topics}

    @property
    def active_path(self) -> Path:
        """Its name while it is written."""
        return self.path.with_name(self.path.name + ACTIVE_SUFFIX)

    @property
    def size_bytes(self) -> int:
        """Its size, what waits in memory for the next commit included."""
        return self._sink.tell()

    def append(self, record: Record) -> None:
        """Takes a message of one of the topics; writes nothing yet."""
        self._writer.add_message(self._channels[record.topic], record.log_time_ns, record.data, record.publish_time_ns)
        self.unsafe.append(record)

    def commit(self) -> None:
        """Writes all that waits, in whole chunks."""
        self._writer.flush()  # type: ignore[no-untyped-call]  # mcap leaves it unannotated
        self._sink.settle()

    def sync(self) -> None:
        """Returns once all that is committed is on the disk."""
        size = self._sink.settled_bytes
        if size != self._synced_bytes:
            self._sink.file.sync()
            self._synced_bytes = size
        self.unsafe.clear()

    def finish(self) -> None:
        """Writes the index and gives the file its name. Call it again if it raises; once done, it does nothing."""
        if not self._finished:
            self._finished = True  # a second summary would spoil the file
            self._writer.finish()  # type: ignore[no-untyped-call]  # mcap leaves it unannotated
        if self._sink.closed:
            return
        self._sink.settle()
        self.sync()
        self._storage.rename(self.active_path, self.path)
        self._sink.close()
        self._storage.sync_folder(self.path.parent)

    def abandon(self) -> None:
        """Gives the file up as it stands, still called `.active`; what is not safe on the disk is cut off.

        A file of which nothing is safe is removed.
        """
        with suppress(OSError):
            self._sink.file.truncate(self._synced_bytes)
        self._sink.close()
        if not self._synced_bytes:
            with suppress(OSError):
                self._storage.remove(self.active_path)

    def discard(self) -> None:
        """Removes a file that shall not come to be."""
        self._sink.close()
        self._storage.remove(self.active_path)

    def _channel_of(self, name: str) -> int:
        schema = register_schema(self._writer, TOPICS[name].schema)
        return self._writer.register_channel(name, MessageEncoding.Protobuf, schema)


class _Sink:
    """What the MCAP writer writes into: memory, until the whole of it is put into the file at once."""

    def __init__(self, file: StoredFile) -> None:
        self.file = file
        self.settled_bytes = 0
        self.closed = False
        self._waiting: list[bytes] = []
        self._waiting_bytes = 0

    def write(self, data: bytes) -> int:
        self._waiting.append(bytes(data))
        self._waiting_bytes += len(data)
        return len(data)

    def tell(self) -> int:
        return self.settled_bytes + self._waiting_bytes

    def flush(self) -> None:
        """The MCAP writer asks for it; `settle` is when things are written."""

    def settle(self) -> None:
        data = memoryview(b"".join(self._waiting))
        done = 0
        try:
            while done < len(data):
                taken = self.file.write(data[done:], self.settled_bytes + done)
                if taken == 0:
                    raise OSError(errno.ENOSPC, "nothing more is taken")
                done += taken
        except OSError:
            with suppress(OSError):  # else a torn chunk stays, which readers pass over, and the next try overwrites it
                self.file.truncate(self.settled_bytes)
            raise
        self.settled_bytes += len(data)
        self._waiting, self._waiting_bytes = [], 0

    def close(self) -> None:
        if not self.closed:
            self.closed = True
            with suppress(OSError):  # closing is when some file systems tell of an earlier failure
                self.file.close()
