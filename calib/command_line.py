"""How every program of ours starts and ends."""

import sys
from typing import NoReturn

import typer

from calib.errors import GroundsbotError

EXIT_DONE = 0
EXIT_REFUSED = 1
EXIT_USAGE = 2
EXIT_WITH_LOSSES = 3
EXIT_INTERRUPTED = 130


def new_app(help_text: str) -> typer.Typer:
    """An empty program: `-h` as well as `--help`, and known errors left to `run`."""
    return typer.Typer(
        help=help_text,
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
        context_settings={"help_option_names": ["-h", "--help"]},
    )


def run(app: typer.Typer) -> NoReturn:
    """Runs a program: a known error is one line and exit 1, an unknown one a traceback."""
    try:
        app()
    except GroundsbotError as error:
        sys.stderr.write(f"error: {' '.join(str(error).split())}\n")
        sys.exit(EXIT_REFUSED)
    except KeyboardInterrupt:
        sys.stderr.write("interrupted\n")
        sys.exit(EXIT_INTERRUPTED)
    sys.exit(EXIT_DONE)
