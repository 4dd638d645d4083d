from .localization import localize
from .online.drive import TagMeasurement
from .online.localizer import OnlineLocalizer, OnlinePose
from .result import Candidate, Localization, LocatedRun, NotLocated

__all__ = [
    "Candidate",
    "Localization",
    "LocatedRun",
    "NotLocated",
    "OnlineLocalizer",
    "OnlinePose",
    "TagMeasurement",
    "localize",
]
