from . import se2, wheels
from .se2 import chained, fit_transform

__all__ = [
    "chained",
    "fit_transform",
    "se2",
    "wheels",
]
