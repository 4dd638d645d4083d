from .archive import (
    archive_map,
    check_extendable,
    check_sizes_in_map,
    local_map_of,
    run_without_log,
    segment_from_arrays,
    tags_of,
    tape_options_of,
)
from .goodness_of_fit import FALSE_ALARM, WINDOW_M, GoodnessOfFit, fit_windows, freedom_of
from .local_map import LocalMap, WindowNoise, first_solution, noise_of_windows, solve_local_map, with_goodness_of_fit

__all__ = [
    "FALSE_ALARM",
    "WINDOW_M",
    "GoodnessOfFit",
    "LocalMap",
    "WindowNoise",
    "archive_map",
    "check_extendable",
    "check_sizes_in_map",
    "first_solution",
    "fit_windows",
    "freedom_of",
    "local_map_of",
    "noise_of_windows",
    "run_without_log",
    "segment_from_arrays",
    "solve_local_map",
    "tags_of",
    "tape_options_of",
    "with_goodness_of_fit",
]
