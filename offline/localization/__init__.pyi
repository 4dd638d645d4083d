from .localization import localize
from .online.drive import TagReading
from .online.localizer import OnlineLocalizer, OnlinePose
from .result import Candidate, Localization, LocatedRun, NotLocated

__all__ = [
    "Candidate",
    "Localization",
    "LocatedRun",
    "NotLocated",
    "OnlineLocalizer",
    "OnlinePose",
    "TagReading",
    "localize",
]
