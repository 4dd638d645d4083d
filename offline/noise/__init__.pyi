from .reweighing import NoiseOfMaps, fit_noise_of, with_noise_of_map
from .shared_errors import in_cell, inflation_of_corners

__all__ = [
    "NoiseOfMaps",
    "fit_noise_of",
    "in_cell",
    "inflation_of_corners",
    "with_noise_of_map",
]
