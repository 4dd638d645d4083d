"""Reduced systems of parts: Schur complements on the variables of the top, and their sums in a tree."""

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Final, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from groundsbot.calib.foundation import FloatArray, IntArray

# More members in a sum move each matrix fewer times, fewer ones share the work among more workers.
_MEMBERS: Final = 8

ColumnArray = NDArray[np.int32]
_Sum = TypeVar("_Sum")


class Reduced(NamedTuple):
    """What the elimination of one or more parts leaves in the n columns of the top.

    The upper triangle of the Schur complement is sparse, row by row (CSR). Dask knows the size of such
    arrays when it chooses where to add.

    Attributes:
        values: (m,) entries.
        columns: (m,) int32, column of each entry.
        start: (n + 1,) int32, first entry of each row, then the number of entries.
        gradient: (n,) reduced gradient.
    """

    values: FloatArray
    columns: ColumnArray
    start: ColumnArray
    gradient: FloatArray


def reduction_of(columns: IntArray, complement: FloatArray, gradient: FloatArray, n_top: int) -> Reduced:
    """Return the reduced system of one part.

    Args:
        columns: (k,) columns in the top, in ascending order.
        complement: (k, k) its Schur complement, of which the upper triangle is used.
        gradient: (k,) reduced gradient.
        n_top: number of columns of the top.
    """
    k = len(columns)
    row, column = np.triu_indices(k)
    n_in_row = np.zeros(n_top + 1, dtype=np.int32)
    n_in_row[columns + 1] = np.arange(k, 0, -1)
    start = np.cumsum(n_in_row, dtype=np.int32)
    of_top = np.zeros(n_top)
    of_top[columns] = gradient
    return Reduced(complement[row, column], columns[column].astype(np.int32), start, of_top)


def add(members: Sequence[Reduced]) -> Reduced:
    """Return the sum of reduced systems, in their order."""
    n = len(members[0].gradient)
    upper, gradient = sparse.csr_array((n, n)), np.zeros(n)
    for member in members:
        upper = upper + sparse.csr_array((member.values, member.columns, member.start), shape=(n, n))
        gradient = gradient + member.gradient
    return Reduced(upper.data, upper.indices, upper.indptr, gradient)


def sum_in_tree(members: Sequence[_Sum], add_some: Callable[[Sequence[_Sum]], _Sum]) -> _Sum:
    """Return the sum of members, one or more, by sums of a few, in an order that depends on their number alone."""
    while len(members) > 1:
        members = [add_some(members[i : i + _MEMBERS]) for i in range(0, len(members), _MEMBERS)]
    return members[0]


def add_to_front(reduced: Reduced, front: FloatArray) -> None:
    """Add a reduced system to the upper triangle of the top's front (n, n)."""
    for row, (begin, end) in enumerate(pairwise(reduced.start.tolist())):
        front[row, reduced.columns[begin:end]] += reduced.values[begin:end]
