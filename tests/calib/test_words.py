"""Numbers in sentences, and texts of others."""

import sys

import pytest

from groundsbot.calib.errors import CalibError
from groundsbot.calib.foundation.command_line import echo, new_app, run
from groundsbot.calib.foundation.words import plural, printable


def test_one_is_no_plural() -> None:
    assert [plural(n, "tag") for n in (0, 1, 2)] == ["0 tags", "1 tag", "2 tags"]


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("3 m, 2.5 °, Größe, 車輪, 🤖\n", "3 m, 2.5 °, Größe, 車輪, 🤖\n"),
        ("a\x1b[2Jb", "a\\x1b[2Jb"),
        ("\x1b]0;title\x07", "\\x1b]0;title\\x07"),
        ("line\rover\tit\x7f", "line\\rover\\tit\\x7f"),
        ("c1 \x9b31m", "c1 \\x9b31m"),
        ("right to left \u202egpj.exe", "right to left \\u202egpj.exe"),
        ("two\u2028lines", "two\\u2028lines"),
        ("no UTF-8 \udcff", "no UTF-8 \\udcff"),
    ],
)
def test_what_a_terminal_would_obey_is_escaped(text: str, shown: str) -> None:
    assert printable(text) == shown


def test_errors_and_lines_are_escaped(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    program = new_app("A program.")

    @program.command()
    def lines() -> None:
        echo("line \x1b[31m")

    @program.command()
    def error() -> None:
        raise CalibError("bad\x1b[2J file\nof two lines")

    for command in ("lines", "error"):
        monkeypatch.setattr(sys, "argv", ["program", command])
        with pytest.raises(SystemExit):
            run(program)
    said = capsys.readouterr()
    assert said.out == "line \\x1b[31m\n"
    assert said.err == "error: bad\\x1b[2J file of two lines\n"
