"""What studies and benches share: seeds from the command line, progress lines, reports."""

import json
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from groundsbot.calib.foundation.files import atomic_write


def seeds_of(text: str) -> range:
    """Of FIRST-LAST, or of one seed.

    Raises:
        ValueError: neither.
    """
    first, _, last = text.partition("-")
    return range(int(first), int(last or first) + 1)


def say(text: str) -> None:
    """To standard output, at once."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def exit_code(missed: Sequence[str]) -> int:
    """Says each promise that was missed; 1 where there is any."""
    for sentence in missed:
        say(f"missed: {sentence}")
    return 1 if missed else 0


def write_report(path: Path, lines: Iterable[Mapping[str, object]]) -> None:
    """A line of JSON each, in place of what was there."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as partial:
        partial.write_text("".join(json.dumps(line) + "\n" for line in lines), encoding="utf-8")
