"""Choice of the matrix of a step: iteratively reweighted least squares, or the second derivative of the loss.

Reweighting converges from afar. Near the optimum it is slow if many observations lie beyond Huber's threshold: each
step lowers the cost by nearly as much as the one before. The second derivative converges at once there, and may
diverge elsewhere.
"""

from dataclasses import dataclass, field
from typing import Final

import numpy as np

from groundsbot.offline.sam.linearisation.robust_losses import Loss, with_curvature

_SLOW: Final = 0.3  # decrease of the cost relative to that of the step before
_NEAR: Final = 1.0  # decrease of the cost, in squared sigmas, below which the optimum is near
_MISLEADING: Final = 0.5  # decrease of the cost relative to the predicted one
_NEARER: Final = 0.01


@dataclass
class Curvature:
    """The choice of the matrix of each step.

    Attributes:
        given: losses of odometry and observations, for reweighting.
        losses: losses of the next step.
    """

    given: tuple[Loss, Loss]
    losses: tuple[Loss, Loss] = field(init=False)
    _own: tuple[Loss, Loss] = field(init=False)
    _last: float = field(init=False, default=np.inf)
    _near: float = field(init=False, default=_NEAR)

    def __post_init__(self) -> None:
        self.losses = self.given
        self._own = (self.given[0], with_curvature(self.given[1]))

    def is_due(self, decrease: float) -> bool:
        """Switch to the second derivative if steps are slow near the optimum; return whether the matrix changed."""
        is_slow = _SLOW * self._last < decrease < self._near
        self._last = decrease
        if not is_slow or self.losses == self._own:
            return False
        self.losses = self._own
        return True

    def misleads(self, decrease: float, expected: float) -> bool:
        """Switch back if the second derivative predicted far more than the decrease; return whether it did."""
        if self.losses == self.given or decrease >= _MISLEADING * expected:
            return False
        self.losses = self.given
        self._near *= _NEARER
        return True
