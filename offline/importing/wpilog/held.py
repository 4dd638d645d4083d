"""Values that are logged when they change: what held in between is written out."""

from typing import Final

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray

_LONGEST_PERIOD_NS: Final = 100_000_000  # of a robot's loop
_GAP_PERIODS: Final = 2.0  # a longer time without a record is one in which the value stayed as it was


def hold_between(stamps_ns: IntArray, values: FloatArray) -> tuple[IntArray, FloatArray]:
    """Return stamps (M,) and values (M, K) with a row a period before each one that comes after a gap.

    NetworkTables and DataLog leave out values that did not change. So over a gap the last value holds, and the change
    comes within the one period before the next record.

    Args:
        stamps_ns: (N,) ascending.
        values: (N, K) at them.
    """
    steps = np.diff(stamps_ns)
    if not len(steps):
        return stamps_ns, values
    period = min(int(np.median(steps)), _LONGEST_PERIOD_NS)
    after = np.flatnonzero(steps > _GAP_PERIODS * period) + 1
    filled = np.insert(stamps_ns, after, stamps_ns[after] - period)
    return filled, np.insert(values, after, values[after - 1], axis=0)
