"""Decides online which tags have the map's prior, by the tests of `solve_in_map` after each round, in slices."""

from collections.abc import Iterable, Iterator
from functools import lru_cache
from typing import Final

from scipy.special import chdtri

from groundsbot.offline.localization.online.information_root import SLICE, OnlineRoot
from groundsbot.offline.localization.online.queries import LeaveOneOut
from groundsbot.offline.measurements import TagKey
from groundsbot.offline.outliers import FALSE_ALARM

CALLED: Final = 150_000  # cost of calling many small functions, in multiplications
# A tag whose assignment changed is not tested again before this many more observations.
_LEAST_MORE: Final = 20
_LEAST_HELD: Final = 3
_LEAST_MAJORITY: Final = 2


class TagTest:
    """The assignment of observed tags, by index, to tags of the map.

    Attributes:
        held: the map's tag for each tag with the map's prior.
        maybe: the map's tags that each other tag may be.
    """

    def __init__(self, held: dict[int, TagKey], maybe: dict[int, tuple[TagKey, ...]]) -> None:
        self.held, self.maybe = held, maybe
        self._in_slice = 0
        self._changed: dict[int, int] = {}  # number of observations when a tag's assignment last changed

    def update(self, root: OnlineRoot, n_observations: int) -> Iterator[None]:
        """Change the assignment of at most one tag, in slices.

        The held tag with the largest significant shift is released. If there is none, the loose tag that fits best is
        held. If none fits, a held tag is released if at least two loose tags would fit without it: in a short drive the
        map's prior on a tag that moved may make the unmoved ones appear to have moved.

        Args:
            root: root with all measurements of a round.
            n_observations: number of observations in the drive.
        """
        bound = _chi_square_bound(root.prior.n_tags, 1)
        recent = {tag for tag, at in self._changed.items() if n_observations < at + _LEAST_MORE}
        loose = self._loose(root, recent)
        distances: dict[int, float] = {}
        for tag in [tag for tag in root.prior.held if tag not in recent]:
            distances[tag] = root.squared_distance(tag)
            yield from self._count_work(6 * root.prior.n**2)
        worst = max(distances, key=lambda tag: distances[tag], default=-1)
        if distances.get(worst, 0.0) > bound:
            self._release(worst, n_observations)
            return
        best: list[tuple[float, int, TagKey]] = []
        for tag, of_map in loose:
            best.append((root.loose_squared_distance([(tag, of_map)]), tag, of_map))
            yield from self._count_work(6 * root.prior.n**2 + CALLED)
        least, tag, of_map = min(best, default=(bound, -1, TagKey("", 0)))
        if least < bound:
            self._hold(tag, of_map, n_observations)
        elif len(self._loose(root, set())) >= _LEAST_MAJORITY:
            yield from self._release_minority(root, distances, bound, n_observations)

    def _release_minority(
        self, root: OnlineRoot, held: Iterable[int], bound: float, n_observations: int
    ) -> Iterator[None]:
        """Release the held tag without which most loose tags fit, each alone and all together."""
        most, outvoted = _LEAST_MAJORITY - 1, -1
        for tag in held:
            without, fitting = root.leave_one_out(tag), dict[int, TagKey]()
            for other, of_map in self._loose(root, set()):
                if len(without.by_shift) != len(root.step):  # a tag was added between slices
                    without = root.leave_one_out(tag)
                if root.loose_squared_distance([(other, of_map)], without) < bound:
                    fitting.setdefault(other, of_map)
                yield from self._count_work(6 * root.prior.n**2 + CALLED)
            if len(fitting) > most and self._fit(root, fitting, root.leave_one_out(tag)):
                most, outvoted = len(fitting), tag
        if outvoted >= 0:
            self._changed = {}  # earlier changes were due to the released tag
            self._release(outvoted, n_observations)

    def _fit(self, root: OnlineRoot, tags: dict[int, TagKey], without: LeaveOneOut) -> bool:
        distance = root.loose_squared_distance(list(tags.items()), without)
        return distance < _chi_square_bound(root.prior.n_tags, len(tags))

    def _release(self, tag: int, n_observations: int) -> None:
        if tag in self.held and len(self.held) >= _LEAST_HELD:
            self.maybe[tag] = (self.held.pop(tag),)
            self._changed[tag] = n_observations

    def _hold(self, tag: int, of_map: TagKey, n_observations: int) -> None:
        self.held[tag] = of_map
        del self.maybe[tag]
        self._changed[tag] = n_observations

    def _count_work(self, multiplications: int) -> Iterator[None]:
        """Yield when the slice has reached its limit."""
        self._in_slice += multiplications
        if self._in_slice > SLICE:
            self._in_slice = 0
            yield

    def _loose(self, root: OnlineRoot, excluded: set[int]) -> list[tuple[int, TagKey]]:
        """Return the tags without the map's prior, each with the map's tags that it may be and that are not held."""
        taken = set(self.held.values())
        may_be = [(tag, of_map) for tag, instances in self.maybe.items() for of_map in instances]
        return [
            (tag, of_map)
            for tag, of_map in may_be
            if tag < root.prior.n_tags and tag not in root.prior.held and tag not in excluded and of_map not in taken
        ]


@lru_cache
def _chi_square_bound(n_tags: int, n_together: int) -> float:
    """Return the squared sigmas that unmoved tags exceed in one of a hundred drives (Bonferroni).

    Args:
        n_tags: tags of the drive.
        n_together: tags that are tested jointly.
    """
    return float(chdtri(2 * n_together, FALSE_ALARM / max(n_tags, 1)))
