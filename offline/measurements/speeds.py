"""Speed of a drive over time and gaps between its wheel readings, which reports show."""

from typing import Final, NamedTuple

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.measurements.motion_model.motion_model import GAP_NS
from groundsbot.offline.measurements.run import Run

# Times of a timeline, about the width of a screen in pixels; fewer where all runs together have more than the last.
MOST_TIMES: Final = 800
_LEAST_TIMES: Final = 50
_MOST_TIMES_OF_ALL: Final = 40_000
# Speeds are means over this time at least, in which an encoder's tick is a few millimetres a second.
_LEAST_STEP_S: Final = 0.2
_S: Final = 1e-9


class SpeedProfile(NamedTuple):
    """Mean speeds of equal steps of time, and gaps between wheel readings that are longer than allowed.

    Attributes:
        step_s: length of a step.
        m_s: (n,) mean speeds; none in a segment of a single keyframe.
        gaps_ns: (G, 2) stamps of the readings before and after each gap.
    """

    step_s: float
    m_s: FloatArray
    gaps_ns: IntArray


def most_times(n_segments: int) -> int:
    """Return the largest number of times in the timeline of a segment of a map of so many."""
    return min(MOST_TIMES, max(_LEAST_TIMES, _MOST_TIMES_OF_ALL // n_segments))


def speed_profile(run: Run, stamps_ns: IntArray, along_m: FloatArray, most: int) -> SpeedProfile:
    """Return the speeds of a segment of a run, in at most `most` steps.

    Keyframes are joined through stops, so the wheels' readings tell when the robot stood. An archived map has its
    keyframes alone.

    Args:
        run: the run.
        stamps_ns: (K,) of the segment's keyframes.
        along_m: (K,) distance driven until each keyframe.
        most: see `most_times`.
    """
    first_ns, last_ns = int(stamps_ns[0]), int(stamps_ns[-1])
    seconds = (last_ns - first_ns) * _S
    n = int(np.clip(seconds / _LEAST_STEP_S, 1, most))
    at_ns = np.linspace(first_ns, last_ns, n + 1).astype(np.int64)
    for wheels in run.wheel_segments:
        if wheels.stamps_ns[0] <= first_ns <= wheels.stamps_ns[-1]:
            left_m, right_m = wheels.at(at_ns)
            step_m = np.hypot(0.5 * np.diff(left_m + right_m), np.diff(wheels.lateral_at(at_ns)))
            break
    else:
        step_m = np.diff(np.interp(at_ns - first_ns, stamps_ns - first_ns, along_m))
    speeds = step_m * n / seconds if seconds > 0.0 else np.zeros(0)
    return SpeedProfile(seconds / n, speeds, _gaps_ns(run, first_ns, last_ns))


def _gaps_ns(run: Run, first_ns: int, last_ns: int) -> IntArray:
    if not run.wheel_segments:  # from an archived map: only its log has them
        return np.zeros((0, 2), dtype=np.int64)
    stamps_ns = np.concatenate([each.stamps_ns for each in run.wheel_segments])
    stamps_ns = stamps_ns[(stamps_ns >= first_ns) & (stamps_ns <= last_ns)]
    before = np.flatnonzero(np.diff(stamps_ns) > GAP_NS)
    return np.column_stack([stamps_ns[before], stamps_ns[before + 1]])
