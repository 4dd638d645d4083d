"""What a program did, as a person meets it."""

import os
import pty
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Outcome:
    code: int
    out: str
    err: str


Run = Callable[..., Outcome]


@contextmanager
def running(
    command: Sequence[object],
    *,
    folder: Path | None = None,
    stdout: int = subprocess.PIPE,
    environment: Mapping[str, str] | None = None,
    own_group: bool = False,
) -> Iterator[subprocess.Popen[str]]:
    """A process that says all it says on one pipe, as text; killed in the end."""
    with subprocess.Popen(
        [str(word) for word in command],
        cwd=folder,
        stdout=stdout,
        stderr=subprocess.STDOUT,
        text=True,
        env=environment,
        start_new_session=own_group,
    ) as process:
        try:
            yield process
        finally:
            process.kill()


def on_terminal(*arguments: object) -> tuple[int, str, str]:
    """Runs a Python process whose standard error is a terminal: exit code, what the terminal got, standard output."""
    outer, inner = pty.openpty()
    environment = os.environ | {"TERM": "xterm", "COLUMNS": "100"}
    command = [sys.executable, *map(str, arguments)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=inner, env=environment) as program:
        os.close(inner)
        shown = b""
        while True:
            try:
                shown += os.read(outer, 1 << 16)
            except OSError:  # the other end is closed
                break
        printed = program.stdout.read() if program.stdout else b""
    os.close(outer)
    return program.returncode, shown.decode(), printed.decode()
