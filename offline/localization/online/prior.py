"""The prior of an online estimate on its border, from a finished map and robot.yaml: calibration, then observed tags.

It is a square-root information matrix, lower triangular in the order in which tags were first observed. Each tag of the
map is added with its distribution conditional on the calibration and the map's tags that are in use already. The map's
joint covariance thus enters as a sequence of conditionals, two rows for each tag, and tags that are not observed have
no cost. Tags that are not in the map have no prior, so their rows are zero.
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
    """The prior on the calibration.

    Attributes:
        mean: (C,) from the map, or else from robot.yaml.
        covariance: (C, C) of it.
        columns: (C,) column in the border, -1 where a parameter is fixed.
        in_map: (C,) row in the map's covariance, -1 where a parameter is not in the map.
    """

    mean: FloatArray
    covariance: FloatArray
    columns: IntArray
    in_map: IntArray


class OnlinePrior:
    """A prior |root (x - off)|^2 on the offset x of calibration and tags from their linearisation points.

    The border of the matrix is the part behind the poses: calibration parameters, then two columns for each tag.

    Attributes:
        n: number of columns of the border.
        n_tags: number of tags.
        room: capacity of the arrays.
        held: the map's tag for each tag with the map's prior, by index.
        first_tag: column of the first tag.
    """

    def __init__(
        self, known: MapPrior, numbers: CalibrationNumbers, calibration: FloatArray, *, is_flat: bool = False
    ) -> None:
        """Begin without tags.

        Args:
            known: the map.
            numbers: the prior on the calibration.
            calibration: (C,) its linearisation point.
            is_flat: whether the calibration has no prior, so that `root` is zero.
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
        if not is_flat:
            self._root[: self.n, : self.n] = whitening(numbers.covariance[np.ix_(free, free)])
        self._off[: self.n] = (numbers.mean - calibration)[free]

    def about(self, calibration: FloatArray, places_m: FloatArray) -> "OnlinePrior":
        """Return the same prior as an offset from other linearisation points.

        Args:
            calibration: (C,) corrections to robot.yaml.
            places_m: (T, 2) positions of the tags in the map frame; only the first `n_tags` are used.
        """
        prior = OnlinePrior(self._known, self._numbers, calibration)
        prior._grow(self.n)
        n, first, of_map = self.n, self.first_tag, self._in_map[self.first_tag : self.n] >= 0
        prior.n, prior.n_tags, prior.held = n, self.n_tags, dict(self.held)
        prior._root[:n, :n], prior._in_map[:n] = self.root, self._in_map[:n]
        prior._places[: self.n_tags] = places_m[: self.n_tags]
        shift = (prior.places_m - self.places_m).reshape(-1)
        prior._off[first:n] = np.where(of_map, self._off[first:n] - shift, 0.0)
        return prior

    @property
    def root(self) -> FloatArray:
        """(n, n) square-root information."""
        return self._root[: self.n, : self.n]

    @property
    def whole(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """`root`, `off` and `places_m` with their spare capacity, for compiled functions."""
        return self._root, self._off, self._places

    @property
    def off(self) -> FloatArray:
        """(n,) the mean, relative to the linearisation points."""
        return self._off[: self.n]

    @property
    def places_m(self) -> FloatArray:
        """(T, 2) linearisation points of the tags."""
        return self._places[: self.n_tags]

    @property
    def calibration(self) -> FloatArray:
        """(C,) linearisation point of the calibration."""
        return self._calibration

    @property
    def columns(self) -> IntArray:
        """(C,) column of each calibration parameter in the border, -1 where it is fixed."""
        return self._numbers.columns

    def add(self, place_m: FloatArray, of_map: TagKey | None) -> FloatArray:
        """Add a tag and return its rows (2, n), with the new n.

        Args:
            place_m: (2,) its linearisation point.
            of_map: the map's tag; None where it has no prior, whose rows are zero.
        """
        n, t = self.n, self.n_tags
        self._grow(n + 2)
        rows = np.zeros((2, n + 2))
        self._places[t], self._off[n : n + 2], self._in_map[n : n + 2] = place_m, 0.0, -1
        if of_map is not None:
            by, covariance = self.by_others(of_map)
            root = whitening(covariance)
            rows = np.concatenate([-root @ by, root], axis=1)
            self.held[t], self._in_map[n : n + 2] = of_map, self._known.rows([of_map])
            self._off[n : n + 2] = self._known.places_m[self._known.index[of_map]] - place_m
        self._root[n : n + 2, : n + 2] = rows
        self.n, self.n_tags = n + 2, t + 1
        return rows

    def drop_last(self) -> None:
        """Remove the tag that was added last."""
        self.n, self.n_tags = self.n - 2, self.n_tags - 1
        self.held.pop(self.n_tags, None)

    def by_others(self, *of_map: TagKey) -> tuple[FloatArray, FloatArray]:
        """Return the distribution of m tags of the map conditional on the border.

        Returns:
            The Jacobian (2 m, n) of their mean with respect to the border, and their conditional covariance (2 m, 2 m).
        """
        rows, in_map = self._known.rows(of_map), self._in_map[: self.n]
        cross = np.where(in_map[:, None] >= 0, self._known.covariance[in_map[:, None], rows], 0.0)
        whitened = self.root @ cross
        return whitened.T @ self.root, self._known.covariance[np.ix_(rows, rows)] - whitened.T @ whitened

    def predict_m(self, by: FloatArray, moved: FloatArray, *of_map: TagKey) -> FloatArray:
        """Return (2 m,) predicted positions of tags of the map.

        Args:
            by: (2 m, n) their derivative from `by_others`.
            moved: (n,) offset of the border from its linearisation points.
            of_map: the tags.
        """
        places_m = self._known.places_m[[self._known.index[tag] for tag in of_map]]
        return np.asarray(places_m.reshape(-1) + by @ (moved - self.off))

    def _grow(self, n: int) -> None:
        if n <= self.room:
            return
        self.room = max(n, 2 * self.room)
        self._root, self._off = pad(self._root, (self.room, self.room)), pad(self._off, (self.room,))
        self._in_map, self._places = pad(self._in_map, (self.room,)), pad(self._places, (self.room, 2))


def pad(array: Any, shape: tuple[int, ...]) -> Any:  # noqa: ANN401 (of any kind of number)
    """Return a larger array that begins with `array` and is zero elsewhere."""
    larger = np.zeros(shape, dtype=array.dtype)
    larger[tuple(slice(n) for n in array.shape)] = array
    return larger
