from .left_open import with_start_values
from .option import AUTO, OFF, Calibrate, parse_calibrate
from .robot import Learnt, Owned, corrected
from .self_calibration import TIMES_MAPPED, about_the_files, free_what_is_told, refocused
from .words import choice_words, freed_lines, learnt_lines

__all__ = [
    "AUTO",
    "OFF",
    "TIMES_MAPPED",
    "Calibrate",
    "Learnt",
    "Owned",
    "about_the_files",
    "choice_words",
    "corrected",
    "free_what_is_told",
    "freed_lines",
    "learnt_lines",
    "parse_calibrate",
    "refocused",
    "with_start_values",
]
