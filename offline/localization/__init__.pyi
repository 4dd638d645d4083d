from .localization import localize
from .online.drive import GyroDifference, TagMeasurement
from .online.localizer import OnlineLocalizer, OnlinePose
from .result import Candidate, Localization, LocatedRun, NotLocated

__all__ = [
    "Candidate",
    "GyroDifference",
    "Localization",
    "LocatedRun",
    "NotLocated",
    "OnlineLocalizer",
    "OnlinePose",
    "TagMeasurement",
    "localize",
]
