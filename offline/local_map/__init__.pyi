from .archive import (
    check_can_be_extended,
    check_sizes_in_map,
    kept_of,
    local_map_of,
    measured_chain,
    run_without_log,
    tags_of,
    tape_of,
)
from .goodness_of_fit import FALSE_ALARM, WINDOW_M, Goodness, fitted_windows, freedom_of
from .local_map import LocalMap, ShownNoise, first_solution, judged, shown_noise, solve_local_map

__all__ = [
    "FALSE_ALARM",
    "WINDOW_M",
    "Goodness",
    "LocalMap",
    "ShownNoise",
    "check_can_be_extended",
    "check_sizes_in_map",
    "first_solution",
    "fitted_windows",
    "freedom_of",
    "judged",
    "kept_of",
    "local_map_of",
    "measured_chain",
    "run_without_log",
    "shown_noise",
    "solve_local_map",
    "tags_of",
    "tape_of",
]
