"""New logs made of old ones: there whole or not at all."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from offline.errors import OfflineError


@contextmanager
def new_log(output: Path) -> Iterator[Path]:
    """Yields a hidden folder beside `output`, which becomes `output` if the block ends well, else goes.

    If `output` ends in `.mcap`, it becomes the file of that name in the folder.

    Raises:
        OfflineError: `output` exists, or it cannot be written.
    """
    if os.path.lexists(output):
        raise OfflineError(f"{output}: exists already; nothing is written over, give another output")
    folder = output.with_name(f".{output.name}.{os.getpid()}.partial")
    try:
        folder.mkdir(parents=True)
        try:
            yield folder
            made = folder / output.name if output.suffix == ".mcap" else folder
            synced(folder)
            made.rename(output)
            synced(output.parent)
        finally:
            shutil.rmtree(folder, ignore_errors=True)
    except OSError as error:
        raise OfflineError(f"{output}: cannot be written: {error.strerror or error}; choose another place") from error


def synced(path: Path) -> None:
    """Returns once a file or a folder's names are on the disk."""
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
