"""Numbers in messages."""


def plural(number: int, thing: str) -> str:
    """Return `1 tag` or `2 tags`: a number and a noun whose plural ends in s."""
    return f"{number} {thing}" if number == 1 else f"{number} {thing}s"
