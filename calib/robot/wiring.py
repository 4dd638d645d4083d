"""The eight ways in which two encoders can be wired: each may count backward, and they may be exchanged."""

from itertools import product
from typing import Final, NamedTuple, TypeVar

_Count = TypeVar("_Count")


class Wiring(NamedTuple):
    """How the controller's two counts belong to the wheels; as the wheel protocol has it where all are False.

    Attributes:
        exchanged: the controller's left count is of the right wheel, and its right count of the left wheel.
        left_reversed, right_reversed: the count of this wheel falls when it rolls forward.
    """

    exchanged: bool = False
    left_reversed: bool = False
    right_reversed: bool = False

    @property
    def signs(self) -> tuple[int, int]:
        """Sign of the count of the left and of the right wheel when it rolls forward."""
        return -1 if self.left_reversed else 1, -1 if self.right_reversed else 1

    def order(self, first: _Count, second: _Count) -> tuple[_Count, _Count]:
        """Return what belongs to the left and to the right wheel, of what belongs to the controller's two counts."""
        return (second, first) if self.exchanged else (first, second)

    def after(self, before: "Wiring") -> "Wiring":
        """Return one wiring that does what `before`, and then this one, do."""
        left, right = self.order(before.left_reversed, before.right_reversed)
        return Wiring(self.exchanged != before.exchanged, self.left_reversed != left, self.right_reversed != right)

    def words(self) -> str:
        """Return how the encoders are wired, other than the protocol has it."""
        reversed_ = {
            (True, True): "both encoders count backward",
            (True, False): "the left wheel's encoder counts backward",
            (False, True): "the right wheel's encoder counts backward",
        }.get((self.left_reversed, self.right_reversed))
        found = ["the encoders of the left and the right wheel are exchanged"] if self.exchanged else []
        return (
            " and ".join([*found, *([reversed_] if reversed_ else [])])
            or "each encoder counts forward, and for its own wheel"
        )

    def settings(self, present: "Wiring") -> str:
        """Return what to set in robot.yaml, which has `present` now; empty if nothing."""
        changed = zip(_FIELDS, self, present, strict=True)
        return " and ".join(f"wheels.{field}: {str(new).lower()}" for field, new, old in changed if new != old)


_FIELDS: Final = ("encoders_exchanged", "left_encoder_reversed", "right_encoder_reversed")
WIRINGS: Final = tuple(Wiring(*each) for each in product((False, True), repeat=3))
