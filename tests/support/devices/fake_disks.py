"""Disks that fill up, fail, block and lose power, behind the seam of `groundsbot.onboard.log.writing.storage`."""

import errno
import os
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from groundsbot.onboard.log.writing.storage import Disk, StoredFile
from groundsbot.onboard.recorder.disk.room import BALLAST_BYTES

PAGE_BYTES = 4096


class TroubledDisk(Disk):
    """The real disk, with troubles that a test sets.

    Attributes:
        capacity_bytes: room for all files created here; a write that does not fit is cut short, as the kernel does.
        fails: asked before every act ("create", "write", "sync", "rename", ...) for the number of an error, or 0.
        may_sync: syncs wait for it.
    """

    def __init__(self, capacity_bytes: int = 1 << 60) -> None:
        super().__init__(durable=False)
        self.capacity_bytes = capacity_bytes
        self.fails: Callable[[str, Path], int] = lambda act, path: 0
        self.may_sync = threading.Event()
        self.may_sync.set()
        self.syncing = threading.Event()
        self._used: dict[Path, int] = {}

    def check(self, act: str, path: Path) -> None:
        number = self.fails(act, path)
        if number:
            raise OSError(number, os.strerror(number), str(path))

    def used(self) -> int:
        return sum(self._used.values())

    def take(self, path: Path, size_bytes: int) -> int:
        """Lets a file grow to a size, as far as there is room; returns the size it got."""
        room = self.capacity_bytes - self.used() + self._used[path]
        if room <= self._used[path] < size_bytes:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        self._used[path] = max(self._used[path], min(size_bytes, room))
        return min(size_bytes, room)

    def size_bytes(self, path: Path) -> int:
        return self._used.get(path, 0)

    def create(self, path: Path) -> StoredFile:
        self.check("create", path)
        file = super().create(path)
        self._used[path] = 0
        return _TroubledFile(self, path, file)

    def rename(self, old: Path, new: Path) -> None:
        self.check("rename", old)
        super().rename(old, new)
        self._used[new] = self._used.pop(old)

    def remove(self, path: Path) -> None:
        super().remove(path)
        self._used.pop(path, None)

    def reserve(self, path: Path, size_bytes: int) -> None:
        self._used[path] = 0
        if self.take(path, size_bytes) < size_bytes:
            del self._used[path]
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        path.touch(exist_ok=False)

    def free_bytes(self, folder: Path) -> int:
        return max(0, self.capacity_bytes - self.used())

    def set_used(self, path: Path, size_bytes: int) -> None:
        self._used[path] = size_bytes


class _TroubledFile:
    def __init__(self, disk: TroubledDisk, path: Path, file: StoredFile) -> None:
        self._disk, self._path, self._file = disk, path, file

    def write(self, data: bytes | memoryview, offset: int) -> int:
        self._disk.check("write", self._path)
        size = self._disk.take(self._path, offset + len(data))
        return self._file.write(data[: size - offset], offset)

    def truncate(self, size_bytes: int) -> None:
        self._disk.check("truncate", self._path)
        self._file.truncate(size_bytes)
        self._disk.set_used(self._path, size_bytes)

    def sync(self) -> None:
        self._disk.check("sync", self._path)
        self._disk.syncing.set()
        self._disk.may_sync.wait()
        self._file.sync()

    def close(self) -> None:
        self._file.close()


class Act(NamedTuple):
    """One thing done to a disk that loses power."""

    what: str
    inode: int
    path: Path
    offset: int = 0
    data: bytes = b""
    new_path: Path = Path()


@dataclass
class MortalDisk:
    """Keeps what is done to it in memory, to compute what a power cut at any point may leave.

    Attributes:
        acts: in order.
    """

    acts: list[Act] = field(default_factory=list)
    _names: dict[Path, int] = field(default_factory=dict)
    _count: int = 0

    def make_folder(self, folder: Path) -> None:
        pass

    def exists(self, path: Path) -> bool:
        return path in self._names

    def size_bytes(self, path: Path) -> int:
        return BALLAST_BYTES if path in self._names else 0  # of no other file is it asked

    def create(self, path: Path) -> "StoredFile":
        if path in self._names:
            raise FileExistsError(errno.EEXIST, "exists", str(path))
        self._count += 1
        self._names[path] = self._count
        self.acts.append(Act("create", self._count, path))
        return _MortalFile(self, self._count, path)

    def rename(self, old: Path, new: Path) -> None:
        self._names[new] = self._names.pop(old)
        self.acts.append(Act("rename", self._names[new], old, new_path=new))

    def remove(self, path: Path) -> None:
        inode = self._names.pop(path, 0)
        self.acts.append(Act("remove", inode, path))

    def sync_folder(self, folder: Path) -> None:
        self.acts.append(Act("sync folder", 0, folder))

    def reserve(self, path: Path, size_bytes: int) -> None:
        self.create(path).close()

    def free_bytes(self, folder: Path) -> int:
        return 1 << 40

    def after_power_cut(self, n_acts: int, rng: np.random.Generator) -> dict[Path, bytes]:
        """The files after the first `n_acts` acts: what was synced, and any torn part of the rest."""
        names = self._names_left(n_acts, rng)
        return {path: self._content_left(inode, n_acts, rng) for path, inode in names.items()}

    def _names_left(self, n_acts: int, rng: np.random.Generator) -> dict[Path, int]:
        """Names synced, and of the later changes the first few: journals keep their order."""
        done = self.acts[:n_acts]
        synced = max((index for index, act in enumerate(done) if act.what == "sync folder"), default=-1)
        changes = [index for index, act in enumerate(done) if act.what in ("create", "rename", "remove")]
        sure = sum(index <= synced for index in changes)
        kept = changes[: int(rng.integers(sure, len(changes) + 1))]
        names: dict[Path, int] = {}
        for act in (done[index] for index in kept):
            if act.what == "create":
                names[act.path] = act.inode
            elif act.what == "rename":
                names[act.new_path] = names.pop(act.path)
            else:
                names.pop(act.path, None)
        return names

    def _content_left(self, inode: int, n_acts: int, rng: np.random.Generator) -> bytes:
        done = [act for act in self.acts[:n_acts] if act.inode == inode and act.what in ("write", "truncate", "sync")]
        synced = max((index for index, act in enumerate(done) if act.what == "sync"), default=-1)
        content = bytearray()
        for index, act in enumerate(done):
            if act.what == "truncate" and (index <= synced or rng.random() < 0.5):
                del content[act.offset :]
            elif act.what == "write":
                _write(content, act, None if index <= synced else rng)
        return bytes(content)


def _write(content: bytearray, act: Act, rng: np.random.Generator | None) -> None:
    """A write whole; or, with `rng`, page by page: there, not there, or rubbish."""
    end = act.offset + len(act.data)
    if rng is not None and rng.random() < 0.5:
        end = int(rng.integers(act.offset, end + 1))
    content.extend(b"\0" * max(0, end - len(content)))
    start = act.offset
    while start < end:
        stop = min(end, (start // PAGE_BYTES + 1) * PAGE_BYTES)
        fate = 1.0 if rng is None else rng.random()
        if fate > 0.4:
            content[start:stop] = act.data[start - act.offset : stop - act.offset]
        elif fate > 0.3 and rng is not None:
            content[start:stop] = rng.bytes(stop - start)
        start = stop


class _MortalFile:
    def __init__(self, disk: MortalDisk, inode: int, path: Path) -> None:
        self._disk, self._inode, self._path = disk, inode, path

    def write(self, data: bytes | memoryview, offset: int) -> int:
        self._disk.acts.append(Act("write", self._inode, self._path, offset, bytes(data)))
        return len(data)

    def truncate(self, size_bytes: int) -> None:
        self._disk.acts.append(Act("truncate", self._inode, self._path, size_bytes))

    def sync(self) -> None:
        self._disk.acts.append(Act("sync", self._inode, self._path))

    def close(self) -> None:
        pass
