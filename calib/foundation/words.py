"""Numbers in sentences."""


def plural(number: int, thing: str) -> str:
    """`1 tag`, `2 tags`: a number and what it counts, whose plural ends in s."""
    return f"{number} {thing}" if number == 1 else f"{number} {thing}s"
