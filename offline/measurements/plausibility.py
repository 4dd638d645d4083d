"""Refuses names and wheel readings that no robot can have given, before they become a map of nonsense."""

from collections.abc import Mapping
from typing import Final

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.errors import OfflineError

# Beyond these, numbers come from broken files or wrong units, not from a robot.
_LARGEST: Final = 1e7
_FASTEST_M_S: Final = 100.0
_LONGEST_NAME: Final = 100
_BURST_M: Final = 1.0  # stamps may be crowded where readings came in bursts


def check_file_name(value: str, where: str) -> None:
    """Looks for names that no file could have, or only one somewhere else.

    Raises:
        OfflineError: naming the value and the limit.
    """
    if not value.isprintable() or not 1 <= len(value) <= _LONGEST_NAME or value[0] == "." or set(value) & set("/\\"):
        raise OfflineError(
            f"{where} is {value[: _LONGEST_NAME + 1]!r}, but file names are made of it: 1 to {_LONGEST_NAME} printable "
            "characters without slashes, the first no dot; record or import the run again under another name"
        )


def check_numbers(columns: Mapping[str, FloatArray], where: str) -> None:
    """Looks for what is no number, or out of all proportion.

    Args:
        columns: (N,) values by field.
        where: names file and topic.

    Raises:
        OfflineError: naming field, value and limit.
    """
    for name, values in columns.items():
        wrong = np.flatnonzero(~(np.abs(values) < _LARGEST))
        if len(wrong):
            raise OfflineError(
                f"{where}: {name} is {values[wrong[0]]:g} in reading {wrong[0] + 1}, must be a number below "
                f"{_LARGEST:g}; correct what the log was made from"
            )


def check_stamps(stamps_ns: IntArray, where: str) -> None:
    """Looks for times before any clock's zero, which neither MCAP nor TUM can write.

    Args:
        stamps_ns: (N,).
        where: names file and topic.

    Raises:
        OfflineError: naming the first.
    """
    wrong = np.flatnonzero(stamps_ns < 0)
    if len(wrong):
        raise OfflineError(
            f"{where}: stamp_ns is {stamps_ns[wrong[0]]} in reading {wrong[0] + 1}, must not be below 0; correct what "
            "the log was made from"
        )


def check_speed(stamps_ns: IntArray, wheels_m: FloatArray, where: str) -> None:
    """Looks for steps between readings that no wheel can have rolled.

    Args:
        stamps_ns: (N,) rising.
        wheels_m: (N, 2) cumulative distances.
        where: names file and topic.

    Raises:
        OfflineError: naming the step and the limit.
    """
    steps_m = np.abs(np.diff(wheels_m, axis=0)).max(axis=1, initial=0.0)
    seconds = np.diff(stamps_ns).astype(np.float64) * 1e-9
    wrong = np.flatnonzero(~(steps_m < _FASTEST_M_S * seconds + _BURST_M))
    if len(wrong):
        raise OfflineError(
            f"{where}: a wheel rolls {steps_m[wrong[0]]:.4g} m in the {seconds[wrong[0]]:.3g} s before reading "
            f"{wrong[0] + 2}, faster than {_FASTEST_M_S:g} m/s; correct the counts, or radii and ticks_per_turn with "
            "--robot"
        )
