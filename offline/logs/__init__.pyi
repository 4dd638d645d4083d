from .info import describe_log
from .redetection import DetectOptions, detect_again, detectors, in_parallel
from .salvaging import salvage

__all__ = [
    "DetectOptions",
    "describe_log",
    "detect_again",
    "detectors",
    "in_parallel",
    "salvage",
]
