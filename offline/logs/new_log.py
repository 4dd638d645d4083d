"""New logs made from old ones: they appear complete or not at all."""

import os
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from groundsbot.calib.foundation import folder_written_whole, sync
from groundsbot.offline.errors import OfflineError


@contextmanager
def new_log(output: Path) -> Iterator[Path]:
    """Yield a hidden folder beside `output`, which becomes `output` if the block succeeds, and is removed if not.

    If `output` ends in `.mcap`, it becomes the file of that name in the folder.

    Raises:
        GroundsbotError: `output` exists, or it cannot be written.
    """
    if os.path.lexists(output):
        raise OfflineError(f"{output}: exists already and is not overwritten; give another output")
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
    """Convert errors of writing the output; the caller's block stays outside, as its errors may concern others."""
    try:
        yield
    except OSError as error:
        raise OfflineError(f"{output}: cannot be written: {error.strerror or error}; choose another place") from error
