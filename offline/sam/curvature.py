"""Choice of the matrix of a step: between iteratively reweighted least squares and the second derivative of the loss.

Reweighting converges from afar. Near the optimum it is slow if many observations lie beyond Huber's threshold: where
all observations of a tag do, the cost is linear in its position, and each step lowers it by nearly as much as the one
before. The second derivative converges at once there, and overshoots where a step takes residuals across the
threshold. So the curvature of the loss along residuals beyond the threshold is controlled as the damping of a
Levenberg-Marquardt method is: lowered from that of reweighting while steps are slow although they lower the cost as
predicted, raised after others.
"""

from dataclasses import dataclass, field
from typing import Final

import numpy as np

from groundsbot.offline.sam.linearisation.robust_losses import SQUARES, Loss

_NEAR: Final = 0.01  # decrease relative to the cost, beyond which only reweighting is used
_SLOW: Final = 0.2  # decrease relative to that of the step before
_GOOD_GAIN: Final = 0.75
_BAD_GAIN: Final = 0.25
_LOWERED: Final = 0.25
_RAISED: Final = 10.0
_LEAST: Final = 1e-3  # at zero, a tag with all observations beyond the threshold would be unobservable


@dataclass
class Curvature:
    """The choice of the matrix of each step.

    Attributes:
        given: losses of odometry and observations, for reweighting.
        losses: losses of the next step.
    """

    given: tuple[Loss, Loss]
    losses: tuple[Loss, Loss] = field(init=False)
    _last: float = field(init=False, default=np.inf)

    def __post_init__(self) -> None:
        self.losses = self.given

    def accept_step(self, gain: float, decrease: float, cost: float) -> bool:
        """Update the curvature after a step that lowered the cost; return whether it changed.

        Args:
            gain: decrease of the cost over that predicted for the full step.
            decrease: decrease of the cost.
            cost: cost after the step.
        """
        is_slow = _SLOW * self._last < decrease < _NEAR * cost
        self._last = decrease
        if gain < _BAD_GAIN:
            return self._multiply(_RAISED)
        return is_slow and gain > _GOOD_GAIN and self._multiply(_LOWERED)

    def reject_step(self) -> bool:
        """Raise the curvature after a step that did not lower the cost; return whether it changed."""
        return self._multiply(_RAISED)

    def _multiply(self, factor: float) -> bool:
        odometry, observations = self.losses
        least_curvature = min(max(factor * observations.least_curvature, _LEAST), 1.0)
        if least_curvature == observations.least_curvature or observations.form == SQUARES.form:
            return False
        self.losses = odometry, observations._replace(least_curvature=least_curvature)
        return True
