"""Of which matrix the steps of a solve are: of weighted squares, or of the loss's own second derivative.

Weighted squares lead down surely from afar. Near the end, where many observations lie beyond Huber's threshold, they
creep: each step brings nearly as much as the one before. The second derivative brings all of it at once, but only
there.
"""

from dataclasses import dataclass, field
from typing import Final

import numpy as np

from groundsbot.offline.sam.linearisation.robust_losses import Loss, with_curvature

# A step that brings so large a share of what the last one brought is one of many; in squared sigmas, what it may bring
# for the end to be near.
_CREEPING: Final = 0.3
_NEAR: Final = 1.0
_MISLEADING: Final = 0.5  # share of what a step promised
_NEARER: Final = 0.01


@dataclass
class Curvature:
    """Chooses the matrix of each step.

    Attributes:
        given: losses of motions and of observations, with the weights of squares.
        losses: of the next step.
    """

    given: tuple[Loss, Loss]
    losses: tuple[Loss, Loss] = field(init=False)
    _own: tuple[Loss, Loss] = field(init=False)
    _last: float = field(init=False, default=np.inf)
    _near: float = field(init=False, default=_NEAR)

    def __post_init__(self) -> None:
        self.losses = self.given
        self._own = (self.given[0], with_curvature(self.given[1]))

    def is_due(self, brought: float) -> bool:
        """Whether the matrix is another from here on, after a step that lowered the cost by so much."""
        creeps = _CREEPING * self._last < brought < self._near
        self._last = brought
        if not creeps or self.losses == self._own:
            return False
        self.losses = self._own
        return True

    def misleads(self, brought: float, expected: float) -> bool:
        """Whether a step by the second derivative brought far less than promised: weighted squares until nearer."""
        if self.losses == self.given or brought >= _MISLEADING * expected:
            return False
        self.losses = self.given
        self._near *= _NEARER
        return True
