from .reweighing import fit_and_weigh, with_noise_of_map
from .shared_errors import in_cell, inflation_of_corners

__all__ = [
    "fit_and_weigh",
    "in_cell",
    "inflation_of_corners",
    "with_noise_of_map",
]
