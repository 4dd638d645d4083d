from .left_open import initialise_open_robots
from .option import AUTO, Calibrate, parse_calibrate
from .robot import Correction, OwnedParameter, correct_robot
from .robot_table import ESTIMATED, NOT_OBSERVABLE, compare_with_files, verdict_lines
from .self_calibration import (
    N_MAPPINGS,
    FreedRobots,
    applied_corrections,
    correct_focal_lengths,
    free_as_before,
    free_parameters,
    relative_to_files,
)
from .time_offset_search import TimeOffsetSearch
from .wiring_test import check_wiring
from .words import choice_words, refusal_lines

__all__ = [
    "AUTO",
    "ESTIMATED",
    "NOT_OBSERVABLE",
    "N_MAPPINGS",
    "Calibrate",
    "Correction",
    "FreedRobots",
    "OwnedParameter",
    "TimeOffsetSearch",
    "applied_corrections",
    "check_wiring",
    "choice_words",
    "compare_with_files",
    "correct_focal_lengths",
    "correct_robot",
    "free_as_before",
    "free_parameters",
    "initialise_open_robots",
    "parse_calibrate",
    "refusal_lines",
    "relative_to_files",
    "verdict_lines",
]
