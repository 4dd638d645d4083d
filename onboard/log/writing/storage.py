"""The disk as the log writer sees it: the seam at which tests put a disk that fills up, fails, blocks or dies."""

import os
from pathlib import Path
from typing import Final, Protocol

_FILE_MODE: Final = 0o644
_FOLDER_MODE: Final = 0o755


class StoredFile(Protocol):
    """One file that was created and is being written."""

    def write(self, data: bytes | memoryview, offset: int) -> int:
        """Writes at `offset`; returns how many bytes were taken, which may be fewer.

        Raises:
            OSError: none could be written.
        """

    def truncate(self, size_bytes: int) -> None:
        """Cuts the file to a size."""

    def sync(self) -> None:
        """Returns once what was written is on the disk."""

    def close(self) -> None:
        """Lets the file go. A second call does nothing."""


class Storage(Protocol):
    """Where files are made. Every method raises OSError as the kernel does."""

    def make_folder(self, folder: Path) -> None:
        """Makes a folder and those above it, where they are missing."""

    def exists(self, path: Path) -> bool:
        """Whether the name is taken, a dangling link included."""

    def size_bytes(self, path: Path) -> int:
        """Of a file; 0: there is none."""

    def create(self, path: Path) -> StoredFile:
        """A new file; never one that is there, never through a link."""

    def rename(self, old: Path, new: Path) -> None:
        """Gives a file its name."""

    def remove(self, path: Path) -> None:
        """Removes a file; one that is gone already is no error."""

    def sync_folder(self, folder: Path) -> None:
        """Returns once the folder's names are on the disk: without it a new name may be gone after a power cut."""

    def reserve(self, path: Path, size_bytes: int) -> None:
        """A new file that takes up room and holds nothing."""

    def free_bytes(self, folder: Path) -> int:
        """Room left for this user."""


class Disk:
    """The real one."""

    def __init__(self, durable: bool = True) -> None:
        """`durable`: wait for the disk where asked to. A simulator that writes thousands of logs need not."""
        self._durable = durable

    def make_folder(self, folder: Path) -> None:
        """As in Storage; the names of new folders are on the disk too."""
        missing = [each for each in (folder, *folder.parents) if not each.exists()]
        folder.mkdir(mode=_FOLDER_MODE, parents=True, exist_ok=True)
        for each in missing:
            self.sync_folder(each.parent)

    def exists(self, path: Path) -> bool:
        """As in Storage."""
        return os.path.lexists(path)

    def size_bytes(self, path: Path) -> int:
        """As in Storage."""
        return path.lstat().st_size if self.exists(path) else 0

    def create(self, path: Path) -> "StoredFile":
        """As in Storage."""
        return _DiskFile(_create(path), self._durable)

    def rename(self, old: Path, new: Path) -> None:
        """As in Storage."""
        old.rename(new)

    def remove(self, path: Path) -> None:
        """As in Storage."""
        path.unlink(missing_ok=True)

    def sync_folder(self, folder: Path) -> None:
        """As in Storage."""
        if not self._durable:
            return
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)

    def reserve(self, path: Path, size_bytes: int) -> None:
        """As in Storage."""
        descriptor = _create(path)
        try:
            os.posix_fallocate(descriptor, 0, size_bytes)
        except OSError:
            path.unlink(missing_ok=True)
            raise
        finally:
            os.close(descriptor)

    def free_bytes(self, folder: Path) -> int:
        """As in Storage."""
        found = os.statvfs(folder)
        return found.f_bavail * found.f_frsize


class _DiskFile:
    def __init__(self, descriptor: int, durable: bool) -> None:
        self._descriptor: int | None = descriptor
        self._durable = durable

    def write(self, data: bytes | memoryview, offset: int) -> int:
        return os.pwrite(self._open, data, offset)

    def truncate(self, size_bytes: int) -> None:
        os.ftruncate(self._open, size_bytes)

    def sync(self) -> None:
        if self._durable:
            os.fdatasync(self._open)  # the size is among what it puts on the disk

    def close(self) -> None:
        descriptor, self._descriptor = self._descriptor, None
        if descriptor is not None:
            os.close(descriptor)

    @property
    def _open(self) -> int:
        if self._descriptor is None:
            raise OSError("the file is closed")
        return self._descriptor


def _create(path: Path) -> int:
    return os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, _FILE_MODE)
