"""Which of the map's tags hold a robot online: judged again at each round as `solve_in_map` does, in slices."""

from collections.abc import Iterable, Iterator
from functools import lru_cache
from typing import Final

from scipy.stats import chi2

from groundsbot.offline.localization.online.information_root import SLICE, LeaveOneOut, OnlineRoot
from groundsbot.offline.measurements import TagKey
from groundsbot.offline.outliers import FALSE_ALARM

CALLED: Final = 150_000  # what calling many small functions costs, in multiplications
# A tag that was judged otherwise is not judged again before so many more observations have come.
_LEAST_MORE: Final = 20
_LEAST_HELD: Final = 3
_OUTVOTE: Final = 2


class TagJudge:
    """Tags by index: of the map, or what they may be.

    Attributes:
        held: the map's tag of each that holds the robot.
        maybe: the map's tags that each other one may be.
    """

    def __init__(self, held: dict[int, TagKey], maybe: dict[int, tuple[TagKey, ...]]) -> None:
        self.held, self.maybe = held, maybe
        self._in_slice = 0
        self._changed: dict[int, int] = {}  # number of observations when a tag was last judged otherwise

    def judge(self, root: OnlineRoot, n_observations: int) -> Iterator[None]:
        """Lets go of the tag that all else contradicts most, or holds the one that fits after all.

        Or lets go of one that two others contradict, which would both fit if it did not hold: in a short drive a tag
        that was moved may be believed, and those that stayed be doubted one by one.
        """
        bound = _chi_square_bound(root.prior.n_tags, 1)
        settled = {tag for tag, at in self._changed.items() if n_observations < at + _LEAST_MORE}
        others = self._others(root, settled)
        squares: dict[int, float] = {}
        for tag in [tag for tag in root.prior.held if tag not in settled]:
            squares[tag] = root.squared_distance(tag)
            yield from self._count_work(6 * root.prior.n**2)
        worst = max(squares, key=lambda tag: squares[tag], default=-1)
        if squares.get(worst, 0.0) > bound:
            self._let_go(worst, n_observations)
            return
        best: list[tuple[float, int, TagKey]] = []
        for tag, of_map in others:
            best.append((root.free_squares([(tag, of_map)]), tag, of_map))
            yield from self._count_work(6 * root.prior.n**2 + CALLED)
        least, tag, of_map = min(best, default=(bound, -1, TagKey("", 0)))
        if least < bound:
            self._hold(tag, of_map, n_observations)
        elif len(self._others(root, set())) >= _OUTVOTE:
            yield from self._release_minority(root, squares, bound, n_observations)

    def _release_minority(
        self, root: OnlineRoot, held: Iterable[int], bound: float, n_observations: int
    ) -> Iterator[None]:
        """Lets go of the tag without which most others fit, each and all together."""
        most, outvoted = _OUTVOTE - 1, -1
        for tag in held:
            lifted, fitting = root.leave_one_out(tag), dict[int, TagKey]()
            for other, of_map in self._others(root, set()):
                if len(lifted.by_shift) != len(root.step):  # a tag was seen meanwhile
                    lifted = root.leave_one_out(tag)
                if root.free_squares([(other, of_map)], lifted) < bound:
                    fitting.setdefault(other, of_map)
                yield from self._count_work(6 * root.prior.n**2 + CALLED)
            if len(fitting) > most and self._fit(root, fitting, root.leave_one_out(tag)):
                most, outvoted = len(fitting), tag
        if outvoted >= 0:
            self._changed = {}  # by a tag that did not stay
            self._let_go(outvoted, n_observations)

    def _fit(self, root: OnlineRoot, tags: dict[int, TagKey], lifted: LeaveOneOut) -> bool:
        squares = root.free_squares(list(tags.items()), lifted)
        return squares < _chi_square_bound(root.prior.n_tags, len(tags))

    def _let_go(self, tag: int, n_observations: int) -> None:
        if tag in self.held and len(self.held) >= _LEAST_HELD:
            self.maybe[tag] = (self.held.pop(tag),)
            self._changed[tag] = n_observations

    def _hold(self, tag: int, of_map: TagKey, n_observations: int) -> None:
        self.held[tag] = of_map
        del self.maybe[tag]
        self._changed[tag] = n_observations

    def _count_work(self, multiplications: int) -> Iterator[None]:
        """Ends the slice when it is full."""
        self._in_slice += multiplications
        if self._in_slice > SLICE:
            self._in_slice = 0
            yield

    def _others(self, root: OnlineRoot, settled: set[int]) -> list[tuple[int, TagKey]]:
        """Tags that do not hold, each with what it may be that no other is."""
        taken = set(self.held.values())
        may_be = [(tag, of_map) for tag, instances in self.maybe.items() for of_map in instances]
        return [
            (tag, of_map)
            for tag, of_map in may_be
            if tag < root.prior.n_tags and tag not in root.prior.held and tag not in settled and of_map not in taken
        ]


@lru_cache
def _chi_square_bound(n_tags: int, n_together: int) -> float:
    """Squared sigmas that tags reach together, where they hang as in the map, once in a hundred drives."""
    return float(chi2.isf(FALSE_ALARM / max(n_tags, 1), 2 * n_together))
