"""What a person measured with a tape: where a run started, and distances between starts or tags."""

from dataclasses import dataclass

from calib import se2
from calib.arrays import FloatArray


@dataclass(frozen=True)
class Placement:
    """A measured pose of frame b in frame a.

    Attributes:
        T_a_b: (3,)
        covariance: (3, 3) of its right tangent.
    """

    T_a_b: FloatArray
    covariance: FloatArray

    def inverse(self) -> "Placement":
        """Frame a in frame b."""
        turned = se2.adjoint(self.T_a_b)
        return Placement(se2.inverse(self.T_a_b), turned @ self.covariance @ turned.T)
