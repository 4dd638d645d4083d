"""What studies and benches share: seeds from the command line, and lines to whoever waits."""

import sys


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
