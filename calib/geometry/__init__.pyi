from .se2 import chained, fit_transform

__all__ = [
    "chained",
    "fit_transform",
]
