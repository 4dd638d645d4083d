from .left_open import start_left_open
from .option import AUTO, Calibrate, parse_calibrate
from .robot import Learnt, Owned, corrected
from .robot_table import verdict_lines, verdicts
from .self_calibration import TIMES_MAPPED, Freed, about_the_files, free_what_is_told, put_right, refocused
from .time_offset_search import TimeOffsetSearch
from .words import choice_words, learnt_lines, refused_lines

__all__ = [
    "AUTO",
    "TIMES_MAPPED",
    "Calibrate",
    "Freed",
    "Learnt",
    "Owned",
    "TimeOffsetSearch",
    "about_the_files",
    "choice_words",
    "corrected",
    "free_what_is_told",
    "learnt_lines",
    "parse_calibrate",
    "put_right",
    "refocused",
    "refused_lines",
    "start_left_open",
    "verdict_lines",
    "verdicts",
]
