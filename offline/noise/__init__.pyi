from .reweighing import fit_and_weigh, weighed_as
from .shared_errors import in_cell, spread_of_corners

__all__ = [
    "fit_and_weigh",
    "in_cell",
    "spread_of_corners",
    "weighed_as",
]
