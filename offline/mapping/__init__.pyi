from .inputs import check_robots, read_runs
from .pipeline import build_map
from .workings import Solved, Workings

__all__ = [
    "Solved",
    "Workings",
    "build_map",
    "check_robots",
    "read_runs",
]
