"""How much the steps of a solve are damped: Levenberg-Marquardt's rule, beginning with none.

After Madsen, Nielsen and Tingleff, "Methods for non-linear least squares problems" (2004).
"""

from dataclasses import dataclass
from typing import Final

# Shares of the diagonal. Between keyframes a few centimetres apart that is a million times what holds the far end of a
# drive, so the first damping must be tiny to leave such modes free.
_FIRST: Final = 1e-9
_LEAST: Final = 1e-10  # below it a step is Gauss-Newton's
_MAX_REJECTED: Final = 12


@dataclass
class Damping:
    """By what share H's diagonal is raised for the next step.

    Attributes:
        floor: what rounding needs in any case, so that H has a square root.
    """

    floor: float = 0.0
    _raised: float = 0.0
    _growth: float = 2.0
    _n_rejected: int = 0

    @property
    def share(self) -> float:
        """Of the diagonal."""
        return max(self._raised, self.floor)

    @property
    def is_least(self) -> bool:
        """Whether steps are Gauss-Newton's as far as rounding lets them."""
        return self._raised <= self.floor

    @property
    def is_exhausted(self) -> bool:
        """Whether it was raised so often in a row, without any gain, that no step will do."""
        return self._n_rejected > _MAX_REJECTED

    def require(self, share: float) -> None:
        """Only with so much H had a square root."""
        if share > self.share:
            self._raised = self.floor = share

    def accept_step(self, gain: float) -> None:
        """Lowers it, or raises it where the gain, what the step brought as a share of what it promised, is poor."""
        lowered = self._raised * max(0.1, 1.0 - (2.0 * gain - 1.0) ** 3)
        self._raised = lowered if lowered > _LEAST else 0.0
        self._growth, self._n_rejected = 2.0, 0

    def reject_step(self) -> None:
        """Raises it, faster each time in a row."""
        self._raised = max(self._raised * self._growth, _FIRST)
        self._growth *= 2.0
        self._n_rejected += 1
