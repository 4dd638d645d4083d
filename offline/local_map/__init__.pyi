from .adjacent_arrays import with_adjacent_arrays
from .archive import (
    archive_map,
    archived_tag_ids,
    check_extendable,
    check_sizes_in_map,
    restore_local_map,
    run_without_log,
    segment_from_arrays,
    tape_options_of,
)
from .goodness_of_fit import FALSE_ALARM, GoodnessOfFit, degrees_of_freedom, fit_windows
from .incremental_solve import InitialValues
from .local_map import LocalMap, WindowNoise, first_solution, noise_of_windows, solve_local_map, with_goodness_of_fit
from .windows import WINDOW_M

__all__ = [
    "FALSE_ALARM",
    "WINDOW_M",
    "GoodnessOfFit",
    "InitialValues",
    "LocalMap",
    "WindowNoise",
    "archive_map",
    "archived_tag_ids",
    "check_extendable",
    "check_sizes_in_map",
    "degrees_of_freedom",
    "first_solution",
    "fit_windows",
    "noise_of_windows",
    "restore_local_map",
    "run_without_log",
    "segment_from_arrays",
    "solve_local_map",
    "tape_options_of",
    "with_adjacent_arrays",
    "with_goodness_of_fit",
]
