"""What a finished map and robot.yaml tell of calibration and the tags seen so far: the border of an online estimate.

A square root information matrix, lower triangular in the order in which tags were seen: each tag of the map comes in
where the map foretells it from the calibration and those of its tags that hold the robot already, with what is left of
the map's covariance. So the map's joint covariance enters as a segment of conditionals, two rows for each tag, and tags
not yet seen cost nothing. Of other tags nothing is known beforehand: their rows are empty.
"""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.localization.map_prior import MapPrior
from groundsbot.offline.measurements import TagKey
from groundsbot.offline.sam import whitening

_ROOM: Final = 64


@dataclass(frozen=True)
class CalibrationNumbers:
    """The calibration.

    Attributes:
        mean: (C,) and covariance (C, C), as the map and robot.yaml have it.
        columns: (C,) in the border, -1 where held.
        in_map: (C,) row in the map's covariance, -1 where the map does not know it.
    """

    mean: FloatArray
    covariance: FloatArray
    columns: IntArray
    in_map: IntArray


class OnlinePrior:
    """Calibration, then tags, about fixed points: rows (root - off) for what is known of their errors.

    Attributes:
        n: length of the border.
        n_tags: of them.
        held: the map's tag of each that holds the robot, by index.
        first_tag: column of the first tag.
    """

    def __init__(self, known: MapPrior, numbers: CalibrationNumbers, calibration: FloatArray) -> None:
        """Without tags.

        Args:
            known: the map.
            numbers: what is known of calibration.
            calibration: (C,) about which it is linearised.
        """
        free = numbers.columns >= 0
        self.n = self.first_tag = int(free.sum())
        self.n_tags, self.room = 0, _ROOM
        self.held: dict[int, TagKey] = {}
        self._known, self._numbers = known, numbers
        self._calibration, self._places = calibration.copy(), np.zeros((_ROOM, 2))
        self._root, self._off = np.zeros((_ROOM, _ROOM)), np.zeros(_ROOM)
        self._in_map: IntArray = np.full(_ROOM, -1, dtype=np.int64)
        self._in_map[: self.n] = numbers.in_map[free]
        self._root[: self.n, : self.n] = whitening(numbers.covariance[np.ix_(free, free)])
        self._off[: self.n] = (numbers.mean - calibration)[free]

    def about(self, calibration: FloatArray, places_m: FloatArray) -> "OnlinePrior":
        """The same about other points, tags (>= n_tags, 2)."""
        found = OnlinePrior(self._known, self._numbers, calibration)
        found._grow(self.n)
        n, first, of_map = self.n, self.first_tag, self._in_map[self.first_tag : self.n] >= 0
        found.n, found.n_tags, found.held = n, self.n_tags, dict(self.held)
        found._root[:n, :n], found._in_map[:n] = self.root, self._in_map[:n]
        found._places[: self.n_tags] = places_m[: self.n_tags]
        shift = (found.places_m - self.places_m).reshape(-1)
        found._off[first:n] = np.where(of_map, self._off[first:n] - shift, 0.0)
        return found

    @property
    def root(self) -> FloatArray:
        """(n, n)"""  # noqa: D415 (a shape)
        return self._root[: self.n, : self.n]

    @property
    def whole(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """`root`, `off` and `places_m` with the room that is left, as compiled functions read them quickest."""
        return self._root, self._off, self._places

    @property
    def off(self) -> FloatArray:
        """(n,) of what is known from the points."""
        return self._off[: self.n]

    @property
    def places_m(self) -> FloatArray:
        """(T, 2) of the points."""
        return self._places[: self.n_tags]

    @property
    def calibration(self) -> FloatArray:
        """(C,) of the points."""
        return self._calibration

    @property
    def columns(self) -> IntArray:
        """(C,) of calibration in the border, -1 where held."""
        return self._numbers.columns

    def add(self, place_m: FloatArray, of_map: TagKey | None) -> FloatArray:
        """One more tag about a place: its rows (2, n), all zero where nothing is known of it beforehand."""
        n, t = self.n, self.n_tags
        self._grow(n + 2)
        rows = np.zeros((2, n + 2))
        self._places[t], self._off[n : n + 2], self._in_map[n : n + 2] = place_m, 0.0, -1
        if of_map is not None:
            by, covariance = self.by_others(of_map)
            own = whitening(covariance)
            rows = np.concatenate([-own @ by, own], axis=1)
            self.held[t], self._in_map[n : n + 2] = of_map, self._known.rows([of_map])
            self._off[n : n + 2] = self._known.places_m[self._known.index[of_map]] - place_m
        self._root[n : n + 2, : n + 2] = rows
        self.n, self.n_tags = n + 2, t + 1
        return rows

    def drop_last(self) -> None:
        """Forgets the tag that was added last."""
        self.n, self.n_tags = self.n - 2, self.n_tags - 1
        self.held.pop(self.n_tags, None)

    def by_others(self, *of_map: TagKey) -> tuple[FloatArray, FloatArray]:
        """Derivative (2 m, n) of tags of the map by those that hold and the calibration, and the covariance left."""
        rows, in_map = self._known.rows(of_map), self._in_map[: self.n]
        across = np.where(in_map[:, None] >= 0, self._known.covariance[in_map[:, None], rows], 0.0)
        whitened = self.root @ across
        return whitened.T @ self.root, self._known.covariance[np.ix_(rows, rows)] - whitened.T @ whitened

    def predict_m(self, by: FloatArray, moved: FloatArray, *of_map: TagKey) -> FloatArray:
        """(2 m,) where the map has tags, by their `by_others` and how far all else is from its points (n,)."""
        places_m = self._known.places_m[[self._known.index[tag] for tag in of_map]]
        return np.asarray(places_m.reshape(-1) + by @ (moved - self.off))

    def _grow(self, n: int) -> None:
        if n <= self.room:
            return
        self.room = max(n, 2 * self.room)
        self._root, self._off = pad(self._root, (self.room, self.room)), pad(self._off, (self.room,))
        self._in_map, self._places = pad(self._in_map, (self.room,)), pad(self._places, (self.room, 2))


def pad(array: Any, shape: tuple[int, ...]) -> Any:  # noqa: ANN401 (of any kind of number)
    """The array at the beginning of a larger one, which is zero else."""
    larger = np.zeros(shape, dtype=array.dtype)
    larger[tuple(slice(n) for n in array.shape)] = array
    return larger
