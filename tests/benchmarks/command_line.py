"""What studies and benches share: seeds from the command line, and lines to whoever waits."""

import sys
from collections.abc import Sequence


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
