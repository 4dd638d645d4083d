from .earlier import EarlierMap
from .frame import FrameChoice, in_frame, parse_frame
from .inputs import check_distinct, read_runs
from .pipeline import build_map
from .workings import Diagnostics, SolvedGroup

__all__ = [
    "Diagnostics",
    "EarlierMap",
    "FrameChoice",
    "SolvedGroup",
    "build_map",
    "check_distinct",
    "in_frame",
    "parse_frame",
    "read_runs",
]
