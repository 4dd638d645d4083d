from .info import describe_log
from .redetection import DetectOptions, detect_again, detect_in_parallel, detectors
from .salvaging import salvage

__all__ = [
    "DetectOptions",
    "describe_log",
    "detect_again",
    "detect_in_parallel",
    "detectors",
    "salvage",
]
