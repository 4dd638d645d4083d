from .edges import moved_out, outward
from .family import families, family_size, tag_bits
from .ids import parse_tag_ids

__all__ = [
    "families",
    "family_size",
    "moved_out",
    "outward",
    "parse_tag_ids",
    "tag_bits",
]
