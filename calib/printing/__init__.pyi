from .board import print_board
from .tags import print_tags

__all__ = [
    "print_board",
    "print_tags",
]
