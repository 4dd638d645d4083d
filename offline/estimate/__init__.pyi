from .estimate import Estimate, Joint, estimate_jointly
from .findings import FitFindings, find
from .kernels import errors_of_motions, errors_of_readings
from .parameters import DISTANCE, RANGE_SCALE, RATIO, TURN_LEFT, TURN_RIGHT, Owned
from .problem import NU

__all__ = [
    "DISTANCE",
    "NU",
    "RANGE_SCALE",
    "RATIO",
    "TURN_LEFT",
    "TURN_RIGHT",
    "Estimate",
    "FitFindings",
    "Joint",
    "Owned",
    "errors_of_motions",
    "errors_of_readings",
    "estimate_jointly",
    "find",
]
