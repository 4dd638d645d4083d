"""Interface of the log writer to the disk, which tests replace by disks that fill up, fail or block."""

import os
from pathlib import Path
from typing import Final, Protocol

_FILE_MODE: Final = 0o640  # readable by the group only: pictures show where and when the robot was
FOLDER_MODE: Final = 0o750


class StoredFile(Protocol):
    """A new file that is being written."""

    def write(self, data: bytes | memoryview, offset: int) -> int:
        """Write at `offset`, and return the number of bytes written, which may be smaller than the data.

        Raises:
            OSError: no byte could be written.
        """

    def truncate(self, size_bytes: int) -> None:
        """Truncate the file to a size."""

    def sync(self) -> None:
        """Wait until the written data are on the disk."""

    def close(self) -> None:
        """Close the file. A second call does nothing."""


class Storage(Protocol):
    """A file system. Every method raises the kernel's OSError."""

    def make_folder(self, folder: Path) -> None:
        """Make a folder and its missing parents."""

    def exists(self, path: Path) -> bool:
        """Return whether the name exists, including dangling links."""

    def size_bytes(self, path: Path) -> int:
        """Return the size of a file, or 0 if there is none."""

    def create(self, path: Path) -> StoredFile:
        """Create a new file. It never opens an existing file or follows a link."""

    def rename(self, old: Path, new: Path) -> None:
        """Rename a file."""

    def remove(self, path: Path) -> None:
        """Remove a file; a missing file is no error."""

    def sync_folder(self, folder: Path) -> None:
        """Wait until the entries of a folder are on the disk; else a new name may be lost in a power cut."""

    def reserve(self, path: Path, size_bytes: int) -> None:
        """Create a file with allocated space and without content."""

    def free_bytes(self, folder: Path) -> int:
        """Return the free space for this user."""


class Disk:
    """The file system of the computer."""

    def __init__(self, durable: bool = True) -> None:
        """Use the file system; without `durable` the sync methods do nothing, as for simulators with many logs."""
        self._durable = durable

    def make_folder(self, folder: Path) -> None:
        """As in Storage; the names of new folders are made durable as well."""
        missing = [each for each in (folder, *folder.parents) if not each.exists()]
        folder.mkdir(mode=FOLDER_MODE, parents=True, exist_ok=True)
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
            os.fdatasync(self._open)  # includes the size of the file

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
