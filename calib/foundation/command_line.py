"""Start and end of the command line programs: options, exit codes, errors and signals."""

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
from groundsbot.calib.foundation.help_pages import GroupedCommands
from groundsbot.calib.foundation.words import printable

EXIT_DONE: Final = 0
EXIT_REFUSED: Final = 1
EXIT_WITH_LOSSES: Final = 3

_ENDING_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM)
_EXIT_SIGNALLED: Final = 128  # plus the signal's number, as shells have it


class _Interrupted(BaseException):
    """Exception raised by a signal, so that unfinished work is cleaned up; Typer would swallow a KeyboardInterrupt."""

    newest: ClassVar["weakref.ref[_Interrupted] | None"] = None  # alive while the exception propagates

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number
        _Interrupted.newest = weakref.ref(self)


def new_app(help_text: str) -> typer.Typer:
    """Return a program without commands, with `-h`, `--help` and `--version`; errors are handled by `run`."""
    app = typer.Typer(
        cls=GroupedCommands,
        help=help_text,
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
        context_settings={"help_option_names": ["-h", "--help"]},
    )
    app.callback()(_program)
    return app


def echo(text: str, *, err: bool = False) -> None:
    """Write lines to stdout or stderr, with control characters escaped."""
    typer.echo(printable(text), err=err)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"groundsbot {metadata.version('groundsbot')}")
        raise typer.Exit(EXIT_DONE)


def _program(
    _version: Annotated[
        bool, typer.Option("--version", help="Print the version and exit.", callback=_print_version, is_eager=True)
    ] = False,
) -> None:
    """Options that stand before a command."""


def run(app: typer.Typer) -> NoReturn:
    """Run a program and exit.

    A `GroundsbotError` is printed as one line and exits with 1, and so is a library that is not installed; any other
    exception prints a traceback. SIGINT (Ctrl-C)
    and SIGTERM unwind the program, print one line and exit with 130 or 143, unless the command handles them itself.
    """
    try:
        with _unwound_by_signals():
            app()
    except GroundsbotError as error:
        echo(f"error: {' '.join(str(error).split())}", err=True)
        sys.exit(EXIT_REFUSED)
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package in ("", "groundsbot"):
            raise
        sys.stderr.write(
            f"error: {package} is not installed, which this command needs; it is one for the laptop: "
            "pip install 'groundsbot[laptop]'\n"
        )
        sys.exit(EXIT_REFUSED)
    except _Interrupted as interrupted:
        sys.stderr.write("interrupted\n")
        sys.exit(_EXIT_SIGNALLED + interrupted.number)
    sys.exit(EXIT_DONE)


@contextmanager
def _unwound_by_signals() -> Iterator[None]:
    """Raise `_Interrupted` in the block on SIGINT and SIGTERM, except for signals ignored since the start."""
    before = {each: signal.getsignal(each) for each in _ENDING_SIGNALS}
    taken = [each for each, handler in before.items() if handler is not signal.SIG_IGN]
    for each in taken:
        signal.signal(each, _unwind)
    try:
        yield
    except _Interrupted:
        for each in taken:  # only the final line is still to be printed
            signal.signal(each, signal.SIG_IGN)
        raise
    finally:
        for each in taken:
            if signal.getsignal(each) is _unwind:  # a command may have set its own handler
                signal.signal(each, before[each])


def _unwind(number: int, _frame: FrameType | None) -> None:
    """Raise `_Interrupted`, unless the one of an earlier signal still propagates.

    A second signal must not interrupt the cleanup. One that was swallowed, as in a `__del__`, no longer counts.
    """
    if _Interrupted.newest is None or _Interrupted.newest() is None:
        raise _Interrupted(number)
