from .edges import outward, shift_edges
from .family import families, family_size, tag_bits
from .ids import parse_tag_ids

__all__ = [
    "families",
    "family_size",
    "outward",
    "parse_tag_ids",
    "shift_edges",
    "tag_bits",
]
