"""Which tags of a finished map hold the robot, and what the map makes of its other tags from them."""

import numpy as np
from scipy import linalg

from calib.arrays import FloatArray, IntArray
from offline.known_map import KnownMap
from offline.run import TagKey


class HeldTags:
    """The tags of the map that are in the state, with calibration numbers that the map knows."""

    def __init__(self, known: KnownMap, numbers: list[int]) -> None:
        self._known = known
        self.numbers = numbers
        self._of_map: list[TagKey] = []
        self.own: dict[TagKey, TagKey] = {}  # by the id that was seen
        self._root = self._rooted()

    @property
    def places(self) -> list[int]:
        """Indices in the map of the tags, in the order of `own`."""
        return [self._known.index[tag] for tag in self._of_map]

    def add(self, of_map: list[TagKey], own: list[TagKey]) -> None:
        """More tags of the map, by the ids that were seen."""
        self._of_map += of_map
        self.own |= dict(zip(own, of_map, strict=True))
        self._root = self._rooted()

    def set_to(self, own: dict[TagKey, TagKey]) -> None:
        """These, by the ids that were seen."""
        self.own, self._of_map = dict(own), list(own.values())
        self._root = self._rooted()

    def drop(self, own: TagKey) -> None:
        """Not this one any more."""
        self._of_map.remove(self.own.pop(own))
        self._root = self._rooted()

    def foretold(self, tags: list[TagKey]) -> tuple[FloatArray, FloatArray]:
        """Derivative (2 k, C + 2 h) of tags by the calibration and the tags that hold, and the covariance left."""
        known, rows = self._known, self._known.rows(tags)
        across = linalg.solve_triangular(self._root, known.covariance[np.ix_(self._rows(), rows)], lower=True)
        by = linalg.solve_triangular(self._root, across, lower=True, trans=1).T
        return by, known.covariance[np.ix_(rows, rows)] - across.T @ across

    def _rooted(self) -> FloatArray:
        rows = self._rows()
        root: FloatArray = linalg.cholesky(self._known.covariance[np.ix_(rows, rows)], lower=True)
        return root

    def _rows(self) -> IntArray:
        return np.concatenate([self._known.rows([], self.numbers), self._known.rows(self._of_map)])
