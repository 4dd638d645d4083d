from .reweighing import fit_and_weigh, in_cell, spread_of_corners, weighed_as

__all__ = [
    "fit_and_weigh",
    "in_cell",
    "spread_of_corners",
    "weighed_as",
]
