from . import se2, wheels
from .se2 import chain_motions, fit_transform

__all__ = [
    "chain_motions",
    "fit_transform",
    "se2",
    "wheels",
]
