"""Work budget for aligning drives, so that small crafted files cannot take minutes.

Each pair of drives that share tags is a search of its own. It is short where most tags fit together; where none do,
each pair of tags may be a hypothesis. The budget of a map for all its pairs grows with the square of the recorded
bytes, as the number of pairs does. Units are those of `sam.budget`: about 10^10 take a second.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

# Ten drives past eighty tags each need a small part of it, and the budget of their logs is a hundred times as large.
_FREE_WORK: Final = 30e9
_WORK_AT_A_MIB: Final = 10e9
# A pair takes at least 10 ms, whatever its tags.
_A_PAIR: Final = 100e6
# Overhead of Python for each fit and for each linearisation.
_A_FIT: Final = 5e6
_A_LINEARISATION: Final = 5e6
# Times the cube of the number of tags: (2 n)^3 / 2 to factorise and substitute; 2 (2 n) (5 n) (7 n) to propagate both
# maps' covariances, in products of large matrices, which are three times as fast.
_BY_FITTED: Final = 4.0
_BY_TAGS: Final = 50.0


class AlignmentBudgetError(Exception):
    """The budget is exhausted; not a user's mistake, and reported as a warning."""


@dataclass
class AlignmentBudget:
    """Remaining computing budget for the alignment of all pairs of local maps.

    Attributes:
        remaining: work that is left; about 10^10 units take a second.
    """

    remaining: float = np.inf

    @staticmethod
    def for_logs(n_bytes: int) -> "AlignmentBudget":
        """Return the budget for drives whose logs have this many bytes; unlimited if they are from no logs."""
        if not n_bytes:
            return AlignmentBudget()
        return AlignmentBudget(_FREE_WORK + _WORK_AT_A_MIB * (n_bytes / 2**20) ** 2)

    def charge_pair(self) -> None:
        """Charge the fixed cost of a pair.

        Raises:
            AlignmentBudgetError: the budget is exhausted.
        """
        self._charge(_A_PAIR)

    def charge_linearisation(self, n_tags: int) -> None:
        """Charge the linearisation of two maps.

        Raises:
            AlignmentBudgetError: the budget is exhausted.
        """
        self._charge(_A_LINEARISATION + _BY_TAGS * n_tags**3)

    def charge_fit(self, n_tags: int) -> None:
        """Charge a least-squares fit of this many tags, and its predictions.

        Raises:
            AlignmentBudgetError: the budget is exhausted.
        """
        self._charge(_A_FIT + _BY_FITTED * n_tags**3)

    def _charge(self, work: float) -> None:
        self.remaining -= work
        if self.remaining < 0.0:
            raise AlignmentBudgetError


UNLIMITED: Final = AlignmentBudget()
