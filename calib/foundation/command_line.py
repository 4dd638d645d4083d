"""How every program of ours starts and ends."""

import signal
import sys
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import metadata
from types import FrameType
from typing import Annotated, ClassVar, Final, NoReturn

import typer

from groundsbot.calib.errors import GroundsbotError

EXIT_DONE: Final = 0
EXIT_REFUSED: Final = 1
EXIT_WITH_LOSSES: Final = 3

_ENDING_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM)
_EXIT_SIGNALLED: Final = 128  # plus the signal's number, as shells have it


class _Interrupted(BaseException):
    """Raised by a signal, so that whatever is half done is cleaned up; Typer would swallow a KeyboardInterrupt."""

    newest: ClassVar["weakref.ref[_Interrupted] | None"] = None  # gives it while it is on its way

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number
        _Interrupted.newest = weakref.ref(self)


def new_app(help_text: str) -> typer.Typer:
    """A program without commands yet: `-h` as well as `--help`, `--version`, and known errors left to `run`."""
    app = typer.Typer(
        help=help_text,
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
        context_settings={"help_option_names": ["-h", "--help"]},
    )
    app.callback()(_program)
    return app


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"groundsbot {metadata.version('groundsbot')}")
        raise typer.Exit(EXIT_DONE)


def _program(
    _version: Annotated[
        bool, typer.Option("--version", help="Print the version and end.", callback=_print_version, is_eager=True)
    ] = False,
) -> None:
    """Options that stand before a command."""


def run(app: typer.Typer) -> NoReturn:
    """Runs a program: a known error is one line and exit 1, an unknown one a traceback.

    SIGINT (Ctrl-C) and SIGTERM unwind it, one line and exit 130 or 143, unless its command handles them itself.
    """
    try:
        with _unwound_by_signals():
            app()
    except GroundsbotError as error:
        sys.stderr.write(f"error: {' '.join(str(error).split())}\n")
        sys.exit(EXIT_REFUSED)
    except _Interrupted as interrupted:
        sys.stderr.write("interrupted\n")
        sys.exit(_EXIT_SIGNALLED + interrupted.number)
    sys.exit(EXIT_DONE)


@contextmanager
def _unwound_by_signals() -> Iterator[None]:
    """Signals that end the program raise in the block; what it was started to ignore stays ignored."""
    before = {each: signal.getsignal(each) for each in _ENDING_SIGNALS}
    taken = [each for each, handler in before.items() if handler is not signal.SIG_IGN]
    for each in taken:
        signal.signal(each, _unwind)
    try:
        yield
    except _Interrupted:
        for each in taken:  # what is left is one line
            signal.signal(each, signal.SIG_IGN)
        raise
    finally:
        for each in taken:
            if signal.getsignal(each) is _unwind:  # not where a command set its own
                signal.signal(each, before[each])


def _unwind(number: int, _frame: FrameType | None) -> None:
    """A second signal must not stop the cleaning up; but the first is gone if it was swallowed, as in a `__del__`."""
    if _Interrupted.newest is None or _Interrupted.newest() is None:
        raise _Interrupted(number)
