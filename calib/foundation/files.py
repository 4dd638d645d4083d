"""Atomic writing of files and folders, and reading of regular files only."""

import errno
import os
import shutil
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from groundsbot.calib.errors import CalibError

StrPath = str | os.PathLike[str]  # what public functions take as a path

_KINDS: Final = {stat.S_IFLNK: "a link", stat.S_IFDIR: "a folder", stat.S_IFIFO: "a FIFO", stat.S_IFSOCK: "a socket"}


def read_regular(path: Path, most_bytes: int, *, follow_links: bool = True) -> bytes:
    """Return the content of a regular file; a device or FIFO is never opened, as that may block or have no end.

    Args:
        path: the file.
        most_bytes: limit of its size.
        follow_links: accept a link to a regular file.

    Raises:
        OSError: the file cannot be read.
        CalibError: it is not a regular file, or is too large.
    """
    _check_regular(path, path.stat(follow_symlinks=follow_links), most_bytes)
    flags = os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC | (0 if follow_links else os.O_NOFOLLOW)
    with os.fdopen(os.open(path, flags), "rb") as file:
        _check_regular(path, os.fstat(file.fileno()), most_bytes)  # it may have been replaced
        data = file.read(most_bytes + 1)
    if len(data) > most_bytes:
        raise CalibError(f"{path}: has more than {most_bytes} bytes; is this the right file?")
    return data


def _check_regular(path: Path, found: os.stat_result, most_bytes: int) -> None:
    if not stat.S_ISREG(found.st_mode):
        kind = _KINDS.get(stat.S_IFMT(found.st_mode), "a device")
        raise CalibError(f"{path}: is {kind}; give a regular file")
    if found.st_size > most_bytes:
        raise CalibError(f"{path}: has {found.st_size} bytes, limit {most_bytes}; is this the right file?")


@contextmanager
def atomic_write(path: Path, *, durable: bool = True) -> Iterator[Path]:
    """Yield a temporary path beside `path`, and rename it over `path` if the block succeeds, else remove it.

    Args:
        path: the file to write.
        durable: wait until the content is on the disk, so that a power cut leaves either the old or the new file. A
            disk that does not respond blocks this call.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        temporary.unlink(missing_ok=True)  # may remain from a killed process with the same id, as in containers
        yield temporary
        if durable:
            sync(temporary)  # without it the renamed file may be empty after a power cut
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def sync(path: Path) -> None:
    """Wait until the content of a file, or the entries of a folder, are on the disk."""
    file = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
    try:
        os.fsync(file)
    finally:
        os.close(file)


@contextmanager
def folder_written_whole(folder: Path, *, replace: bool = False) -> Iterator[Path]:
    """Yield an empty folder beside `folder`, and rename it to `folder` if the block succeeds.

    All content is on the disk before the renaming. If the block fails, `folder` is unchanged, and parent folders that
    were created are removed.

    Args:
        folder: the folder to write, missing or empty.
        replace: accept a folder with content and delete that content. Without it, content that appears during the block
            is kept, and what the block wrote is discarded.

    Raises:
        CalibError: the folder cannot be made or replaced.
    """
    folder = folder.resolve()
    made = [each for each in folder.parents if not each.exists()]
    partial, replaced = (folder.with_name(f".{folder.name}.{os.getpid()}.{word}") for word in ("partial", "replaced"))
    try:
        with _errors_as_calib_error(folder):
            if folder.is_mount():
                raise CalibError(
                    f"{folder}: is a mount point, which cannot be replaced by renaming; name a folder in it"
                )
            _put_back(folder, partial, replaced)  # may remain from a killed process with the same id, as in containers
            partial.mkdir(parents=True)
        yield partial
        with _errors_as_calib_error(folder):
            for each in (*partial.rglob("*"), partial):
                sync(each)
            if replace and folder.exists():
                folder.rename(replaced)
            partial.rename(folder)
            sync(folder.parent)
    finally:
        _put_back(folder, partial, replaced)
        for parent in made:
            if parent.is_dir() and not any(parent.iterdir()):
                parent.rmdir()


def _put_back(folder: Path, partial: Path, replaced: Path) -> None:
    """Restore the replaced folder if `folder` is missing, and remove both temporary folders."""
    if replaced.exists() and not folder.exists():
        replaced.rename(folder)
    shutil.rmtree(partial, ignore_errors=True)
    shutil.rmtree(replaced, ignore_errors=True)


@contextmanager
def _errors_as_calib_error(folder: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        if error.errno in (errno.ENOTEMPTY, errno.EEXIST):
            raise CalibError(
                f"{folder}: is not empty any more, and its content is kept; name another folder"
            ) from error
        raise CalibError(f"{folder}: cannot be written ({error.strerror}); name a folder that you may write") from error
