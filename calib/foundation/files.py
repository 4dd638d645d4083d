"""Files and folders that are there whole or not at all."""

import errno
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from groundsbot.calib.errors import CalibError


@contextmanager
def atomic_write(path: Path, *, durable: bool = True) -> Iterator[Path]:
    """Yields a temporary path beside `path`; renames it over `path` if the block ends well, else removes it.

    Args:
        path: of the file.
        durable: wait for the disk, so that a power cut leaves the old file or the new one. A disk that hangs
            holds this up.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        temporary.unlink(missing_ok=True)  # of a process of the same number that was killed, as in containers
        yield temporary
        if durable:
            sync(temporary)  # else, after a power cut, the final name may hold nothing
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def sync(path: Path) -> None:
    """Returns once a file's content, or the names in a folder, are on the disk."""
    file = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
    try:
        os.fsync(file)
    finally:
        os.close(file)


@contextmanager
def folder_written_whole(folder: Path, *, replace: bool = False) -> Iterator[Path]:
    """Yields an empty folder beside `folder`, which takes its place if the block ends well, once all is on the disk.

    If the block fails, everything is as it was before; folders that were missing on the way to it are not left behind
    either.

    Args:
        folder: missing or empty.
        replace: it may hold something, which is gone then. Else what came into it meanwhile stays, not what the block
            wrote.

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
                    f"{folder}: is where a disk is mounted, and is filled by renaming; name a folder in it"
                )
            _put_back(folder, partial, replaced)  # of a process of the same number that was killed, as in containers
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
    """Leaves neither of the two folders beside `folder`, nor the one missing that was to be replaced."""
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
            raise CalibError(f"{folder}: holds something by now, which stays; name another folder") from error
        raise CalibError(f"{folder}: cannot be written ({error.strerror}); name a folder that you may write") from error
