"""What a recorder says to people: in order, and never at the cost of the recording."""

import fcntl
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

from groundsbot.onboard.process.console_lines import ConsoleLines

LIMIT_S = 60.0  # only what hangs comes near


@contextmanager
def small_pipe() -> Iterator[tuple[int, TextIO]]:
    """A pipe of one page: its end to read, and a stream to write."""
    read_fd, write_fd = os.pipe()
    fcntl.fcntl(write_fd, fcntl.F_SETPIPE_SZ, 4096)
    with os.fdopen(write_fd, "w", encoding="utf-8") as stream:
        yield read_fd, stream
    os.close(read_fd)


def say_all(console: ConsoleLines, lines: list[str]) -> None:
    """In a thread, so that a call that never returns fails the test."""

    def say() -> None:
        for line in lines:
            console.say(line)

    thread = threading.Thread(target=say, daemon=True)
    thread.start()
    thread.join(LIMIT_S)
    assert not thread.is_alive()


def read_until(file: int, end: str) -> list[str]:
    data = b""
    while not data.endswith(f"{end}\n".encode()):
        got = os.read(file, 1 << 16)
        assert got, "all ends are closed"
        data += got
    return data.decode().splitlines()


def test_lines_that_are_read_come_all_and_in_their_order() -> None:
    lines = [f"line {index} \u00fc" for index in range(900)]
    with small_pipe() as (file, stream), ConsoleLines(stream) as console:
        say_all(console, lines)
        assert read_until(file, lines[-1]) == lines


def test_unread_lines_block_nothing_and_are_counted() -> None:
    lines = [f"{index:0100d}" for index in range(5000)]
    with small_pipe() as (file, stream):
        console = ConsoleLines(stream)
        say_all(console, lines)
        console.close(limit_s=0.0)  # does not wait either
        got = read_until(file, "in time")
        console.close(LIMIT_S)
    said = [line for line in got if line.isdigit()]
    n_dropped = sum(int(line.split()[0]) for line in got if not line.isdigit())
    assert said == sorted(said)
    assert set(said) < set(lines)
    assert n_dropped == len(lines) - len(said)


def test_a_reader_that_ended_and_one_that_never_was(tmp_path: Path) -> None:
    read_fd, write_fd = os.pipe()
    os.close(read_fd)
    with os.fdopen(write_fd, "w") as stream, ConsoleLines(stream) as console:
        console.say("a")
        console.say("b")
    with ConsoleLines(None) as console:
        console.say("a")
    with (tmp_path / "said").open("w", encoding="ascii") as stream, ConsoleLines(stream) as console:
        console.say("\u00fc")
    assert (tmp_path / "said").read_text() == "\\xfc\n"


def test_a_reader_that_reads_on_after_the_end_finds_nothing_in_other_files(tmp_path: Path) -> None:
    lines = [f"{index:0100d}" for index in range(200)]
    with small_pipe() as (file, stream):
        console = ConsoleLines(stream)
        say_all(console, lines)
        console.close(limit_s=0.0)
        number = stream.fileno()
        stream.close()
        with (tmp_path / "other").open("w+") as other:
            assert other.fileno() == number
            assert read_until(file, lines[-1]) == lines
            console.close(LIMIT_S)
            assert other.read() == ""


def test_control_characters_are_escaped() -> None:
    with small_pipe() as (read_fd, stream):
        with ConsoleLines(stream) as console:
            console.say("a file named \x1b[2J")
        assert os.read(read_fd, 100) == b"a file named \\x1b[2J\n"
