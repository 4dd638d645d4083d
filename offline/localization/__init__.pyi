from .localization import localize
from .result import Candidate, Localization, LocatedRun, NotLocated

__all__ = [
    "Candidate",
    "Localization",
    "LocatedRun",
    "NotLocated",
    "localize",
]
