"""Refuses names and readings that a robot cannot have produced, before a map is made from them."""

from collections.abc import Mapping
from typing import Final

import numpy as np

from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray, plural
from groundsbot.offline.errors import OfflineError

# Larger values come from damaged files or wrong units.
_LARGEST: Final = 1e7
_FASTEST_M_S: Final = 100.0
_LONGEST_NAME: Final = 100
_BURST_M: Final = 1.0  # allowed at any speed, because readings that arrive in bursts have stamps too close together


def check_file_name(value: str, where: str) -> None:
    """Refuse a name that cannot be part of a file name, or that would lead to another folder.

    Raises:
        OfflineError: the name is empty, too long, or has characters that are not allowed.
    """
    if not value.isprintable() or not 1 <= len(value) <= _LONGEST_NAME or value[0] == "." or set(value) & set("/\\"):
        raise OfflineError(
            f"{where} is {value[: _LONGEST_NAME + 1]!r}, but it is used in file names and must have 1 to "
            f"{_LONGEST_NAME} printable characters, no slash and no dot at the start; record or import the run again "
            "under another name"
        )


def check_numbers(columns: Mapping[str, FloatArray], where: str) -> None:
    """Refuse values that are not finite, or too large for any unit that is meant.

    Args:
        columns: (N,) values of each field.
        where: file and topic, for the error.

    Raises:
        OfflineError: a value is not a number below the limit.
    """
    for name, values in columns.items():
        wrong = np.flatnonzero(~(np.abs(values) < _LARGEST))
        if len(wrong):
            raise OfflineError(
                f"{where}: {name} is {values[wrong[0]]:g} in reading {wrong[0] + 1}, must be a number below "
                f"{_LARGEST:g}; correct the source of the log"
            )


def check_stamps(stamps_ns: IntArray, where: str) -> None:
    """Refuse negative times, which MCAP and TUM files cannot hold.

    Args:
        stamps_ns: (N,).
        where: file and topic, for the error.

    Raises:
        OfflineError: a stamp is negative.
    """
    wrong = np.flatnonzero(stamps_ns < 0)
    if len(wrong):
        raise OfflineError(
            f"{where}: stamp_ns is {stamps_ns[wrong[0]]} in reading {wrong[0] + 1}, must not be below 0; correct the "
            "source of the log"
        )


def find_repeated(stamps_ns: IntArray, what: str) -> tuple[BoolArray, list[str]]:
    """Find readings that are not later than all before them, which are left out.

    Args:
        stamps_ns: (N,), N at least one.
        what: a reading, for the warning.

    Returns:
        (N,) the readings to keep, and a warning where some are not.
    """
    keep = stamps_ns > np.concatenate([[stamps_ns[0] - 1], np.maximum.accumulate(stamps_ns)[:-1]])
    n = int((~keep).sum())
    return keep, [f"{plural(n, what)} not later than the one before; left out"] if n else []


def check_speed(stamps_ns: IntArray, wheels_m: FloatArray, where: str) -> None:
    """Refuse steps between readings that are faster than any wheel.

    Args:
        stamps_ns: (N,) increasing.
        wheels_m: (N, 2) cumulative distances; (N, 3) with the lateral one.
        where: file and topic, for the error.

    Raises:
        OfflineError: a step exceeds the highest speed.
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
