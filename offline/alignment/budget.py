"""How much work it is worth to lay drives over each other: small files made for it shall not take minutes.

Each pair of drives that share tags is a search of its own. Which tags fit together is soon found where most do; where
none do, each pair of tags may lead somewhere. What a map may take for all its pairs grows with the square of what was
recorded, as the number of pairs does. Counted is as in `sam.budget`: some ten thousand million take a second.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

# Ten drives past eighty tags each take a small part of it, and their logs are worth a hundred times as much.
_FREE_WORK: Final = 30e9
_WORK_AT_A_MIB: Final = 10e9
# A pair takes 10 ms and more whatever its tags are like.
_A_PAIR: Final = 100e6
# What Python takes beside the multiplications, for each look at a linearisation and for making one.
_A_HOLD: Final = 5e6
_A_LINEARISATION: Final = 5e6
# By the cube of how many tags there are: half of (2 n)^3 to factorise and substitute; twice (2 n) (5 n) (7 n) to carry
# both maps' covariances over, in products of large matrices, which go by three times as quick.
_BY_HELD: Final = 4.0
_BY_TAGS: Final = 50.0


class AlignmentTooLongError(Exception):
    """More than it is worth; no user's mistake, and told of in a sentence."""


@dataclass
class AlignmentBudget:
    """What is left for all pairs of a map.

    Attributes:
        left: work.
    """

    left: float = np.inf

    @staticmethod
    def of_logs(n_bytes: int) -> "AlignmentBudget":
        """What drives are worth whose logs have so many bytes; without end where they are from no logs."""
        if not n_bytes:
            return AlignmentBudget()
        return AlignmentBudget(_FREE_WORK + _WORK_AT_A_MIB * (n_bytes / 2**20) ** 2)

    def begin(self) -> None:
        """Takes off what a pair takes in any case.

        Raises:
            AlignmentTooLongError: nothing is left.
        """
        self._take(_A_PAIR)

    def linearise(self, n_tags: int) -> None:
        """Takes off what linearising two maps about a bend takes.

        Raises:
            AlignmentTooLongError: nothing is left.
        """
        self._take(_A_LINEARISATION + _BY_TAGS * n_tags**3)

    def hold(self, n_tags: int) -> None:
        """Takes off what least squares over so many tags take, and what they foretell.

        Raises:
            AlignmentTooLongError: nothing is left.
        """
        self._take(_A_HOLD + _BY_HELD * n_tags**3)

    def _take(self, work: float) -> None:
        self.left -= work
        if self.left < 0.0:
            raise AlignmentTooLongError


UNLIMITED: Final = AlignmentBudget()
