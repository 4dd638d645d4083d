"""Writing of one MCAP file. A chunk is written completely or not at all, and the file is finished at most once."""

import errno
from collections import Counter
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, NamedTuple, cast

from mcap.well_known import MessageEncoding
from mcap.writer import CompressionType, IndexType, Writer
from mcap_protobuf.schema import register_schema

from groundsbot.onboard.errors import LogError
from groundsbot.onboard.log.messages import topic_of
from groundsbot.onboard.log.writing.storage import Storage, StoredFile

ACTIVE_SUFFIX: Final = ".active"


class Record(NamedTuple):
    """One message, ready to be written; times in ns on the run's clock."""

    topic: str
    data: bytes
    log_time_ns: int
    publish_time_ns: int


class LogFile:
    """A file that is named `<name>.active` until it is finished, so that unfinished logs are recognised.

    Every method that writes may raise OSError. What was written stays valid then, and the rest stays in memory, so that
    the call can be repeated.

    Attributes:
        path: name of the finished file.
        unsafe: messages that are not on the disk yet.
    """

    def __init__(
        self, storage: Storage, path: Path, topics: Iterable[str], written: Counter[str], *, compressed: bool
    ) -> None:
        """Create the file and declare its topics.

        Args:
            storage: the disk.
            path: name of the finished file.
            topics: all topics of the file. They are declared in the first chunk, so that no chunk depends on any other.
            written: counts of messages on the disk, by topic, to which those of this file are added.
            compressed: compress the chunks; JPEG does not get smaller.

        Raises:
            FileExistsError: a finished or unfinished file of that name exists.
            OSError: the file cannot be created.
        """
        self.path = path
        self.unsafe: list[Record] = []
        self._storage = storage
        self._written = written
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
        """Name of the unfinished file."""
        return self.path.with_name(self.path.name + ACTIVE_SUFFIX)

    @property
    def size_bytes(self) -> int:
        """Size of the file, including data in memory for the next commit."""
        return self._sink.tell()

    def append(self, record: Record) -> None:
        """Append a message to the data in memory; `commit` writes them to the file."""
        self._writer.add_message(self._channels[record.topic], record.log_time_ns, record.data, record.publish_time_ns)
        self.unsafe.append(record)

    def commit(self) -> None:
        """Write all data in memory, in complete chunks."""
        self._writer.flush()  # type: ignore[no-untyped-call]  # mcap leaves it unannotated
        self._sink.settle()

    def sync(self) -> None:
        """Wait until all committed data are on the disk."""
        size = self._sink.settled_bytes
        if size != self._synced_bytes:
            self._sink.file.sync()
            self._synced_bytes = size
        self._written.update(record.topic for record in self.unsafe)
        self.unsafe.clear()

    def finish(self) -> None:
        """Write the index and rename the file. It can be repeated after an error, and does nothing once done."""
        if not self._finished:
            self._finished = True  # a second summary would corrupt the file
            self._writer.finish()  # type: ignore[no-untyped-call]  # mcap leaves it unannotated
        if self._sink.closed:
            return
        self._sink.settle()
        self.sync()
        self._storage.rename(self.active_path, self.path)
        self._sink.close()
        self._storage.sync_folder(self.path.parent)

    def abandon(self) -> None:
        """Close the unfinished file, truncated to the data that are on the disk; an empty file is removed."""
        with suppress(OSError):
            self._sink.file.truncate(self._synced_bytes)
        self._sink.close()
        if not self._synced_bytes:
            with suppress(OSError):
                self._storage.remove(self.active_path)

    def discard(self) -> None:
        """Remove the unfinished file."""
        self._sink.close()
        self._storage.remove(self.active_path)

    def _channel_of(self, name: str) -> int:
        topic = topic_of(name)
        if topic is None:
            raise LogError(f"{name}: no such topic")
        schema = register_schema(self._writer, topic.schema)
        return self._writer.register_channel(name, MessageEncoding.Protobuf, schema)


class _Sink:
    """Stream for the MCAP writer that buffers in memory until all data are written to the file at once."""

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
        """Do nothing; the MCAP writer calls it, but data are written by `settle`."""

    def settle(self) -> None:
        data = memoryview(b"".join(self._waiting))
        done = 0
        try:
            while done < len(data):
                taken = self.file.write(data[done:], self.settled_bytes + done)
                if taken == 0:
                    raise OSError(errno.ENOSPC, "no more data are accepted")
                done += taken
        except OSError:
            with suppress(OSError):  # if it fails, readers skip the torn chunk and the next attempt overwrites it
                self.file.truncate(self.settled_bytes)
            raise
        self.settled_bytes += len(data)
        self._waiting, self._waiting_bytes = [], 0

    def close(self) -> None:
        if not self.closed:
            self.closed = True
            with suppress(OSError):  # some file systems report an earlier failure on closing
                self.file.close()
