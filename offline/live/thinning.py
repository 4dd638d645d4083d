"""Part of the measurements of long drives, which takes the same time to map however long they are.

What is kept of the beginning of a drive changes only where a step between measurements doubles, so that the solution of
a map initialises that of the next.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from groundsbot.calib.foundation import BoolArray, IntArray
from groundsbot.offline.measurements import Run

# Of all drives together. On one core an update of so many takes less than a second with two drives and a hundred tags.
MOST_OBSERVATIONS: Final = 600
MOST_EMPTY_PICTURES: Final = 400
MOST_WHEEL_READINGS: Final = 20_000


def thin(runs: Sequence[Run]) -> list[Run]:
    """Return the runs with fewer measurements.

    Each tag keeps as many observations of each run as any other one, or all where it has fewer, spread evenly. A
    picture of such an observation is kept with all its tags. Of the other pictures and of the wheel readings every n-th
    is kept.
    """
    counts = np.concatenate([np.bincount(run.detections.tag, minlength=len(run.tags)) for run in runs])
    most = _largest_share(counts, MOST_OBSERVATIONS)
    every = _step(sum(len(run.picture_stamps_ns) for run in runs), MOST_EMPTY_PICTURES)
    wheels_every = _step(sum(len(each.stamps_ns) for run in runs for each in run.wheel_segments), MOST_WHEEL_READINGS)
    return [_thin(run, most, every, wheels_every) for run in runs]


def _thin(run: Run, most: int, every: int, wheels_every: int) -> Run:
    detections, pictures_ns = run.detections, run.picture_stamps_ns
    used_ns = np.unique(detections.stamps_ns[_spread(detections.tag, len(run.tags), most)])
    kept = np.isin(pictures_ns, used_ns)
    kept[::every] = True
    return replace(
        run,
        wheel_segments=tuple(each.every(wheels_every) for each in run.wheel_segments),
        picture_stamps_ns=pictures_ns[kept],
        picture_camera=run.picture_camera[kept],
        detections=detections.where(np.isin(detections.stamps_ns, used_ns)),
    )


def _spread(tag: IntArray, n_tags: int, most: int) -> BoolArray:
    """Return (M,) which observations to keep: of each tag one in a power of two, at most `most`."""
    kept = np.zeros(len(tag), dtype=np.bool_)
    for index in range(n_tags):
        own = np.flatnonzero(tag == index)
        kept[own[:: _step(len(own), most)]] = True
    return kept


def _step(n: int, most: int) -> int:
    """Return the least power of two such that one in so many of `n` is at most `most`."""
    return 1 << max(0, int(-(-n // most) - 1).bit_length())


def _largest_share(counts: IntArray, most: int) -> int:
    """Return the largest number of observations of one tag and run such that all together are at most `most`."""
    low, high = 1, max(1, int(counts.max(initial=1)))
    while low < high:
        middle = (low + high + 1) // 2
        total = sum(-(-n // _step(n, middle)) for n in counts.tolist())
        low, high = (middle, high) if total <= most else (low, middle - 1)
    return low
