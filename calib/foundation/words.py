"""Numbers in messages, and texts of others on a terminal."""

import unicodedata
from typing import Final

_LINE_SEPARATORS: Final = ("Zl", "Zp")  # categories of Unicode; those of control and format characters begin with C


def plural(number: int, thing: str) -> str:
    """Return `1 tag` or `2 tags`: a number and a noun whose plural ends in s."""
    return f"{number} {thing}" if number == 1 else f"{number} {thing}s"


def printable(text: str) -> str:
    r"""Return a text with control and format characters escaped, as in `\x1b[2J`; ends of lines stay.

    Logs, robot.yaml, status files and names of files may come from others, and a terminal obeys such characters.
    """
    if text.isascii() and text.isprintable():
        return text
    return "".join(each if each == "\n" or not _is_control(each) else _escape(each) for each in text)


def _is_control(character: str) -> bool:
    category = unicodedata.category(character)
    return category.startswith("C") or category in _LINE_SEPARATORS


def _escape(character: str) -> str:
    return character.encode("unicode_escape").decode("ascii")
