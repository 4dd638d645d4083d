"""Writes docs/commands.md from the programs themselves: `python docs/site/commands.py`, or `make docs`."""

import re
from collections.abc import Iterator
from pathlib import Path

import typer
from typer.testing import CliRunner

from groundsbot.calib.cli import app as calib
from groundsbot.fixtures.__main__ import app as fixtures
from groundsbot.offline.cli import app as offline
from groundsbot.onboard.cli import app as onboard

PAGE = Path(__file__).resolve().parent.parent / "commands.md"
PROGRAMS = {
    "groundsbot-onboard": onboard,
    "groundsbot-offline": offline,
    "groundsbot-calib": calib,
    "python -m groundsbot.fixtures": fixtures,
}
WIDTH = 110
HEAD = """# Commands

What `-h` says of each; this page is made from the programs (`make docs`), and a test holds it to them. Exit codes:
0 done; 1 one line why not; 2 wrong usage; 3 done with losses or in several components, said in words.
"""


def page() -> str:
    """The page as it should be."""
    return HEAD + "".join(part for name, app in PROGRAMS.items() for part in _of_program(name, app))


def _of_program(name: str, app: typer.Typer) -> Iterator[str]:
    yield f"\n## {name}\n\n{app.info.help}\n"
    for command in app.registered_commands:
        word = command.name or getattr(command.callback, "__name__", "")
        told = CliRunner().invoke(app, [word, "-h"], prog_name=name, terminal_width=WIDTH, max_content_width=WIDTH)
        text = re.sub(r"[ ]+$", "", told.output.rstrip(), flags=re.MULTILINE)
        yield f"\n### {name} {word}\n\n```text\n{text}\n```\n"


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
