"""A progress bar for a person at a terminal."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager

from groundsbot.calib.foundation import printable
from groundsbot.offline.foundation import Progress


@contextmanager
def progress_bar() -> Iterator[Progress]:
    """Yield a progress function: a bar on a terminal, removed when done; nothing elsewhere."""
    if not sys.stderr.isatty():
        yield lambda _what, _done, _total: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bar

    columns = (TextColumn("{task.description}", markup=False), BarColumn(), TimeElapsedColumn())
    with Bar(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("starting", total=None)
        current = ""

        def show(what: str, done: int, total: int) -> None:
            nonlocal current
            what = printable(what)
            if what != current:
                bar.reset(task)
                current = what
            if total == 1:
                bar.update(task, description=what, total=None)  # a moving bar without a fraction
            else:
                bar.update(task, description=f"{what} {done}/{total}", completed=done, total=total)

        yield show
