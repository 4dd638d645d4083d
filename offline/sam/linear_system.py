"""What a solve needs of its normal equations: an arrowhead system in this process, or one shared out to workers."""

from typing import Protocol, TypeVar

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.sam.factors.odometry_and_observations import State
from groundsbot.offline.sam.linearisation.robust_losses import Loss

Blocks = TypeVar("Blocks")  # normal equations, as in `NormalEquations`
Rows = TypeVar("Rows")  # work arrays of a factorisation, as in `SquareRootFactor`
Factor = TypeVar("Factor", bound="StepFactorisation", covariant=True)


class StepFactorisation(Protocol):
    """A factorisation of H + damping diag(H)."""

    def step(self, damping: float) -> tuple[FloatArray, float]:
        """Return the step -(H + damping diag(H))^-1 g, in the system's order, and its predicted decrease."""
        ...


class LinearSystem(Protocol[Blocks, Rows, Factor]):
    """The normal equations of a problem; methods are those of `arrowhead.system.Arrowhead`."""

    @property
    def scratch(self) -> tuple[Blocks, Blocks, Rows]:
        """Blocks and work arrays of a solve."""
        ...

    def linearise(
        self, state: State, odometry_loss: Loss, observation_loss: Loss, out: Blocks | None = None
    ) -> tuple[Blocks, float]:
        """Return normal equations and cost."""
        ...

    def factorise(self, system: Blocks, damping: float, out: Rows | None = None) -> Factor:
        """Factorise H + damping diag(H).

        Raises:
            UnderDeterminedError: the matrix is not positive definite.
        """
        ...

    def retract(self, state: State, step: FloatArray, anchor: IntArray) -> State:
        """Return the state after a step, pose by pose."""
        ...

    def retract_relative(self, before: State, step: FloatArray, anchor: IntArray, moved: State) -> State:
        """Return the state after the same step as `moved`, motion by motion."""
        ...
