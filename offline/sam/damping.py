"""Levenberg-Marquardt damping that starts at zero.

After Madsen, Nielsen and Tingleff, "Methods for non-linear least squares problems" (2004).
"""

from dataclasses import dataclass
from typing import Final

# Relative to the diagonal. Between keyframes a few centimetres apart the diagonal is a million times the information
# about the far end of a drive, so the first damping must be tiny to leave such modes free. The least is as tiny: along
# a weakly determined direction a step with 1e-10 may be far shorter, and an undamped one far longer, than the best.
_FIRST: Final = 1e-12
_LEAST: Final = 1e-14  # below it the damping is zero
_MAX_REJECTED: Final = 12


@dataclass
class Damping:
    """The damping of the next step, relative to the diagonal of H.

    Attributes:
        floor: least damping at which H is positive definite in double precision.
    """

    floor: float = 0.0
    _raised: float = 0.0
    _growth: float = 2.0
    _n_rejected: int = 0

    @property
    def share(self) -> float:
        """Damping relative to the diagonal."""
        return max(self._raised, self.floor)

    @property
    def is_least(self) -> bool:
        """Whether steps are undamped, except for `floor`."""
        return self._raised <= self.floor

    @property
    def is_exhausted(self) -> bool:
        """Whether more steps in a row were rejected than are allowed."""
        return self._n_rejected > _MAX_REJECTED

    def require(self, share: float) -> None:
        """Raise the floor to the damping at which H was positive definite."""
        if share > self.share:
            self._raised = self.floor = share

    def accept_step(self, gain: float) -> None:
        """Update the damping by the gain ratio: actual decrease of the cost over predicted decrease."""
        lowered = self._raised * max(0.1, 1.0 - (2.0 * gain - 1.0) ** 3)
        self._raised = lowered if lowered > _LEAST else 0.0
        self._growth, self._n_rejected = 2.0, 0

    def reject_step(self) -> None:
        """Raise the damping, by a factor that doubles with each consecutive rejection."""
        self._raised = max(self.share * self._growth, _FIRST)
        self._growth *= 2.0
        self._n_rejected += 1
