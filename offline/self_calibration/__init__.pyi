from .left_open import start_left_open
from .option import AUTO, Calibrate, parse_calibrate
from .robot import Correction, OwnedParameter, correct_robot
from .robot_table import verdict_lines, verdicts
from .self_calibration import TIMES_MAPPED, FreedRobots, about_the_files, free_parameters, put_right, with_focal_lengths
from .time_offset_search import TimeOffsetSearch
from .words import choice_words, learnt_lines, refusal_lines

__all__ = [
    "AUTO",
    "TIMES_MAPPED",
    "Calibrate",
    "Correction",
    "FreedRobots",
    "OwnedParameter",
    "TimeOffsetSearch",
    "about_the_files",
    "choice_words",
    "correct_robot",
    "free_parameters",
    "learnt_lines",
    "parse_calibrate",
    "put_right",
    "refusal_lines",
    "start_left_open",
    "verdict_lines",
    "verdicts",
    "with_focal_lengths",
]
