from .frame import parse_frame
from .inputs import check_robots, read_runs
from .pipeline import build_map
from .workings import Diagnostics, SolvedGroup

__all__ = [
    "Diagnostics",
    "SolvedGroup",
    "build_map",
    "check_robots",
    "parse_frame",
    "read_runs",
]
