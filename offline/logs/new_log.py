"""New logs made of old ones: there whole or not at all."""

import os
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from groundsbot.calib.foundation import folder_written_whole, sync
from groundsbot.offline.errors import OfflineError


@contextmanager
def new_log(output: Path) -> Iterator[Path]:
    """Yields a hidden folder beside `output`, which becomes `output` if the block ends well, else goes.

    If `output` ends in `.mcap`, it becomes the file of that name in the folder.

    Raises:
        GroundsbotError: `output` exists, or it cannot be written.
    """
    if os.path.lexists(output):
        raise OfflineError(f"{output}: exists already; nothing is written over, give another output")
    if output.suffix != ".mcap":
        with folder_written_whole(output) as folder:
            yield folder
        return
    with ExitStack() as stack:
        with _errors_as_offline_error(output):
            made = tempfile.TemporaryDirectory(
                prefix=f".{output.name}.", suffix=".partial", dir=output.parent, ignore_cleanup_errors=True
            )
            folder = Path(stack.enter_context(made))
        yield folder
        with _errors_as_offline_error(output):
            sync(folder / output.name)
            (folder / output.name).rename(output)
            sync(output.parent)


@contextmanager
def _errors_as_offline_error(output: Path) -> Iterator[None]:
    """Only of what is done to the output: what fails in the block may be another file's."""
    try:
        yield
    except OSError as error:
        raise OfflineError(f"{output}: cannot be written: {error.strerror or error}; choose another place") from error
